"""What a model predicts of motion that it was not fitted to: torque, and open-loop motion."""

import numpy as np

from r2s.errors import UserError
from r2s.identification.parameters import parameter_space
from r2s.identification.torque_residual import TorqueResidual
from r2s.identification.windows import cut_windows, replay
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.physics.simulator import Simulator
from r2s.recordings.recording import Recording

HORIZONS = (0.1, 0.5, 2.0)  # s, open-loop prediction


def prediction_errors(
    robot: Robot,
    nominal: Dynamics,
    identified: Dynamics,
    recording: Recording,
    *,
    window_s: float,
    cutoff_hz: float,
    nthread: int = 0,
) -> dict:
    """Return one side of summary.json: torque RMSE per joint and, for commanded torque, open-loop errors.

    position_rmse_mrad is over replays of `window_s`; ee_error_mm is the mean end-effector distance after 0.1, 0.5
    and 2 s open loop (horizons that no trajectory reaches are left out).
    """
    space = parameter_space(robot, nominal, {"offset": [-1.0, 1.0]})
    torque = TorqueResidual(robot, space, recording, cutoff_hz=cutoff_hz)
    out: dict = {"rows": len(recording.t), "seconds": recording.duration}
    for name, dynamics in (("", identified), ("nominal_", nominal)):
        error = torque.off(dynamics)
        out[f"{name}torque_rmse_Nm"] = np.sqrt((error**2).mean(0)).tolist()
    if recording.torque != "commanded":
        return out
    windows = cut_windows(recording, window_s)
    for name, dynamics in (("", identified), ("nominal_", nominal)):
        error = replay(robot, dynamics, windows, nthread) - windows.q
        out[f"{name}position_rmse_mrad"] = (1e3 * np.sqrt((error**2).mean((0, 1)))).tolist()
        out[f"{name}ee_error_mm"] = _open_loop_ee(robot, dynamics, recording, nthread)
    return out


def _open_loop_ee(robot: Robot, dynamics: Dynamics, recording: Recording, nthread: int) -> dict[str, float]:
    """Return {"0.1": mm, ...}: mean distance between simulated and recorded end effector after each horizon."""
    errors = {}
    for horizon in HORIZONS:
        try:
            windows = cut_windows(recording, horizon, limit=100)
        except UserError:
            continue
        sim = Simulator(robot, dynamics, len(windows.q0), nthread)
        q = replay(robot, dynamics, windows, nthread)[:, -1]
        places = []
        for state in (q, windows.q[:, -1]):
            sim.reset(state, np.zeros_like(state))
            places.append(sim.ee.copy())
        errors[f"{horizon:g}"] = float(1e3 * np.linalg.norm(places[0] - places[1], axis=-1).mean())
    return errors
