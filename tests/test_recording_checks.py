"""The torque tells how an arm is mounted and in which order its joints are; a wrong model alone is no mistake."""

# ruff: noqa: F811 (the arguments are fixtures of made_logs.py)

from dataclasses import replace

import numpy as np
import pytest
from made_logs import ALPHABET, moved, ur  # noqa: F401 (ur is a fixture)

from r2s.errors import UserError
from r2s.identification.checks import check_recording
from r2s.physics.rigid_body import mujoco_inverse_dynamics
from r2s.recordings.recording import Recording


@pytest.mark.long
@pytest.mark.parametrize(
    ("source", "gravity", "said"),
    [
        ("frankarobotics/libfranka#118", [9.81, 0, 0], "is mounted on a wall: set robot.gravity=[9.81, 0, 0]"),
        ("Kinovarobotics/kinova-ros#413", [0, 9.81, 0], "is mounted on a wall: set robot.gravity=[0, 9.81, 0]"),
        ("roboticslibrary/rl#64", [0, 0, 9.81], "hangs: set robot.gravity=[0, 0, 9.81]"),
        ("frankarobotics/franka_ros#338", [0, 6.94, -6.94], "is mounted at an angle: set robot.gravity=["),
    ],
)
def test_a_mounting_is_found_from_the_torque(ur, source, gravity, said):
    """The direction of gravity is fitted; no joint is said to have the other sign."""
    with pytest.raises(UserError, match="fits ur10e only if it ") as caught:
        check_recording(ur, moved(ur, gravity=gravity))
    assert said in str(caught.value)
    check_recording(replace(ur, gravity=np.array(gravity)), moved(ur, gravity=gravity))


@pytest.mark.parametrize("torque", ["measured", "commanded", "motor"])
def test_alphabetical_order_is_seen_in_each_kind_of_torque(ur, torque):
    """Also without gravity; the right order passes."""
    r = moved(ur, torque)
    check_recording(ur, r)
    with pytest.raises(UserError, match=r"columns 3 2 1 4 5 6 \(the log has them in alphabetical order\)"):
        check_recording(ur, replace(r, **{k: getattr(r, k)[:, ALPHABET] for k in ("q", "dq", "tau")}))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("torque", ["measured", "commanded", "motor"])
def test_an_arm_that_is_only_wrongly_modelled_passes(ur, seed, torque):
    """Masses of 0.6 to 1.7 times, shifted centres, friction, offsets, rotors and sensor gains are no mistake."""
    rng, t, n = np.random.default_rng(seed), np.arange(0, 4.0 + 2 * seed, 4e-3), ur.n
    w, a = rng.uniform(0.4, 2.5, n), rng.uniform(0.1, 0.7, n)
    phase = np.outer(t, w) + rng.uniform(0, 6, n)
    q, dq, ddq = ur.q_home + a * np.sin(phase), a * w * np.cos(phase), -a * w**2 * np.sin(phase)
    model = ur.model(gravity=torque != "commanded")
    links, scale = model.jnt_bodyid, rng.uniform(0.6, 1.7, n)
    model.body_mass[links] *= scale
    model.body_inertia[links] *= (scale * rng.uniform(0.4, 2.5, n))[:, None]
    model.body_ipos[links] += rng.normal(0, 0.02, (n, 3))
    tau = mujoco_inverse_dynamics(model, q, dq, ddq)
    tau += ur.tau_max * (rng.uniform(0.003, 0.08, n) * (np.tanh(dq / 0.02) + dq) + rng.normal(0, 0.02, n))
    if torque == "motor":
        tau += 0.01 * ur.tau_max * ddq
    if torque != "commanded":
        tau *= rng.uniform(0.7, 1.1, n)
    tau += 0.003 * ur.tau_max * rng.standard_normal(tau.shape)
    check_recording(ur, Recording(t, q, dq, tau, torque))
