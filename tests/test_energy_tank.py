"""The energy tank of impedance control: a stiffness that changes adds no more energy than the tank holds."""

import numpy as np
import pytest
from test_impedance import FRICTIONLESS, PANDA, REACH, N, place_of, simulate

from r2s.control.impedance import cartesian_impedance, joint_impedance
from r2s.physics import impedance as law
from r2s.tasks.track import TrackTask


def energy(control, K, error):
    """Return the energy, J, of clipped springs with stiffness K; see `spring`."""
    p = control.parameters
    if control.name == "joint_impedance":
        limit, s = p[law.HEAD :].reshape(-1, law.ROW)[:, law.JOINT_LIMIT], 0.5 * K * error**2
    else:
        limit, s = p[law.FORCE_LIMIT], 0.5 * (K[:3] * error**2).sum()
    return np.where(s <= limit, s, 2 * np.sqrt(np.maximum(s * limit, 0)) - limit).sum()


def hostile_stiffness(control, rng, cycles):
    """Return stiffnesses (cycles, s) between their bounds that jump in every fifth cycle."""
    low, high = control.action_offset - control.action_scale, control.action_offset + control.action_scale
    rows = np.where(rng.random((cycles // 5, len(low))) < 0.5, low, high)
    return np.repeat(rows, 5, axis=0)


@pytest.mark.parametrize("kind", ["cartesian", "joint"])
def test_the_tank_pays_for_what_stiffness_adds(kind):
    """Over random postures at rest, where damping refills nothing: net energy out of the tank is at most its fill.

    1e-9 J: sums of thousands of terms of 10 J, each to 1e-16.
    """
    rng, fill = np.random.default_rng(1), 1.5
    if kind == "joint":
        control = joint_impedance(PANDA, TrackTask(pool=2), FRICTIONLESS, action="stiffness", tank=[fill, fill])
    else:
        control = cartesian_impedance(PANDA, REACH, FRICTIONLESS, action="stiffness", tank=[fill, fill])
    memory, out, s = np.zeros(control.memory_size), np.empty(N), N if kind == "joint" else law.SPRINGS
    net, worst, before, asked = 0.0, -np.inf, None, 0.0
    for K in hostile_stiffness(control, rng, 4000):
        q, target = PANDA.q_home + rng.uniform(-0.4, 0.4, N), np.array([0.4, 0.1, 0.5])
        command = np.concatenate([K, PANDA.q_home, np.zeros(N)] if kind == "joint" else [K, target])
        control.law(q, np.zeros(N), command, control.parameters, memory, out)
        error = PANDA.q_home - q if kind == "joint" else target - place_of(control, q)[0]
        K_now = memory[law.STIFFNESS : law.STIFFNESS + s].copy()
        if before is not None:
            change = energy(control, K_now, error) - energy(control, before, error)
            net, asked = net + change, asked + max(energy(control, K, error) - energy(control, before, error), 0.0)
        before, worst = K_now, max(worst, net)
        assert 0.0 <= memory[law.LEVEL] <= fill
    assert worst <= fill + 1e-9
    assert asked > 10 * fill  # what was asked for would have been much more


@pytest.mark.parametrize(("fill", "grows"), [(0.5, False), (1e3, True)])
def test_hostile_switching_cannot_pump_energy(fill, grows):
    """Stiff while the joints approach their targets, soft while they leave: energy and tank together never rise.

    With an endless tank the same switching makes the arm's own energy grow. Damping is a hundredth of critical. A
    torque that is held for 1 ms adds up to K dq^2 dt / 2 per s and joint: 5 % of the energy at 60 Nm/rad and 1 rad/s.
    """
    control = joint_impedance(
        PANDA, TrackTask(pool=2), FRICTIONLESS, action="stiffness", damping=0.01, tank=[fill, fill], softest=0.3
    )
    low, high = control.action_offset - control.action_scale, control.action_offset + control.action_scale
    goal, last = PANDA.q_home, [PANDA.q_home]

    def switch(k, q, memory):
        nearer = np.abs(goal - q) < np.abs(goal - last[0])
        last[0] = q
        return np.concatenate([np.where(nearer, high, low), goal, np.zeros(N)])

    own, tank = [], []
    for q, dq, memory, mass in simulate(control, switch, goal + np.array([0, 0.2, 0, 0.2, 0, 0.2, 0]), 1500):
        own.append(0.5 * dq @ mass @ dq + energy(control, memory[law.STIFFNESS : law.STIFFNESS + N], goal - q))
        tank.append(memory[law.LEVEL])
    total = np.array(own) + tank
    assert min(tank) >= 0.0
    if grows:
        assert max(own) > 2 * own[0]
    else:
        assert total.max() <= 1.05 * total[0]
        assert max(own) <= own[0] + fill + 0.05 * total[0]


def test_an_empty_tank_lets_the_stiffness_fall_but_not_rise():
    control = cartesian_impedance(PANDA, REACH, FRICTIONLESS, action="stiffness", tank=[0.0, 1.0])
    K_low, K_high = (control.action_offset + side * control.action_scale for side in (-1, 1))
    memory, out, start = np.zeros(control.memory_size), np.empty(N), place_of(control, PANDA.q_home)[0]
    seen = []
    for K, off in ((K_high, 0.02), (K_low, 0.02), (K_high, 0.02), (K_high, 0.0)):
        memory[law.LEVEL] = 0.0
        command = np.concatenate([K, start + np.array([off, 0, 0])])
        control.law(PANDA.q_home, np.zeros(N), command, control.parameters, memory, out)
        seen.append(memory[law.STIFFNESS])
    np.testing.assert_allclose(seen, [K_high[0], K_low[0], K_low[0], K_high[0]])  # without error a rise is free
