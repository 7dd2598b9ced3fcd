"""Hybrid control: it pushes along the normal with its force, and moves across it to its target."""

import numpy as np
import pytest
from test_impedance import DT, FRICTIONLESS, PANDA, REACH, N, place_of, settled

from r2s.control.impedance import cartesian_impedance
from r2s.physics import impedance as law


def wall(stiffness, height):
    """Return the force (3,) N of an elastic floor."""
    return lambda place: np.array([0.0, 0.0, stiffness * max(height - place[2], 0.0)])


@pytest.mark.parametrize("measured", [False, True])
def test_hybrid_control_pushes_with_its_force(measured):
    """On an elastic floor the force is the reference, and across it the tip moves to its target.

    With a measured force the integral removes a load of 2 N that the model does not know; without one it stays.
    """
    control = cartesian_impedance(
        PANDA, REACH, FRICTIONLESS, hybrid=True, normal=[0, 0, 2], force=8.0, integral_rate=5.0
    )
    start = place_of(control, PANDA.q_home)[0]
    floor, goal = wall(5e3, start[2] + 0.001), start + np.array([0.03, 0.0, 0.2])
    command = control.command(np.zeros((1, 3)), REACH, np.zeros(1), goal[None])
    load = np.array([0.0, 0.0, -2.0])

    def now(k, q, memory):
        force = floor(place_of(control, q)[0])[2]
        return control.with_force(command, np.array([force]))[0] if measured else command[0]

    q = settled(control, now, PANDA.q_home, 2500, lambda place: floor(place) + load)
    place = place_of(control, q)[0]
    assert floor(place)[2] == pytest.approx(8.0 if measured else 10.0, abs=0.05)
    np.testing.assert_allclose(place[:2], goal[:2], atol=5e-4)


def test_the_integral_does_not_wind_up():
    """A force that never arrives fills the integral to its clamp; the force stays below force_clip."""
    control = cartesian_impedance(
        PANDA, REACH, FRICTIONLESS, hybrid=True, normal=[0, 0, 1], force=25.0, force_clip=26.0
    )
    start, jacobian = place_of(control, PANDA.q_home)
    command = control.command(np.zeros((1, 3)), REACH, np.zeros(1), start[None])
    memory, out = np.zeros(control.memory_size), np.empty(N)
    for _ in range(5000):
        control.law(
            PANDA.q_home, np.zeros(N), control.with_force(command, np.zeros(1))[0], control.parameters, memory, out
        )
    np.testing.assert_allclose(out, jacobian[:3].T @ [0, 0, -26.0], atol=1e-9)
    assert memory[law.INTEGRAL] <= 1.0 + 25.0 * 5.0 * DT  # it stops where the force saturates


def test_a_displacement_against_the_normal_adds_force():
    control = cartesian_impedance(
        PANDA, REACH, FRICTIONLESS, hybrid=True, normal=[0, 0, 1], force=5.0, displacement=0.02
    )
    start, jacobian = place_of(control, PANDA.q_home)
    command = control.command(np.array([[0, 0, -0.5]]), REACH, np.zeros(1), start[None])
    tau = control.torque(PANDA.q_home[None], np.zeros((1, N)), command)[0]
    force = 5.0 + 0.01 * control.parameters[law.K_DEFAULT]
    np.testing.assert_allclose(tau, jacobian[:3].T @ [0, 0, -force], atol=1e-9)
