"""Compute torque errors and simulation errors of an identified arm on motion that was not fitted."""

import numpy as np

from r2s.identification.parameters import parameter_space
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.residuals.windows import replay, windows_or_none
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.physics.simulator import Simulator
from r2s.recordings.parts import spread
from r2s.recordings.recording import Recording

HORIZONS = (0.1, 0.5, 2.0)  # s, horizons of open-loop prediction
SCORED_S, SCORED_EACH_S = 300.0, 30.0  # s, most that is compared in torque: in total; in each part of a recording
REPLAYED_S = 240.0  # s, most that is replayed of a recording
MAX_WINDOWS = 100  # per horizon


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
    """Return the errors of the identified and the nominal arm on a recording, as an entry of summary.json.

    The entry of summary.json contains the torque RMSE of each joint. For commanded torque, the entry also contains
    position_rmse_mrad from replays of `window_s` s, and ee_error_mm from `open_loop_error`. HORIZONS longer than all
    trajectories are omitted. Of a long recording, r2s evaluates parts spread over the whole length.
    """
    space = parameter_space(robot, identified, {"offset": [-1.0, 1.0]})
    scored, sides = spread(recording, SCORED_S, SCORED_EACH_S), {"": identified, "nominal_": nominal}
    torque = TorqueResidual(space, scored, cutoff_hz=cutoff_hz)
    out: dict = {"rows": len(recording.t), "seconds": recording.duration}
    for name, dynamics in sides.items():
        out[f"{name}torque_rmse_Nm"] = np.sqrt((torque.error(dynamics) ** 2).mean(0)).tolist()
    if recording.torque != "commanded":
        return out
    recording = spread(recording, REPLAYED_S)
    windows = windows_or_none(recording, window_s)
    for name, dynamics in sides.items():
        if windows is not None:
            error = replay(robot, dynamics, windows, nthread) - windows.q
            out[f"{name}position_rmse_mrad"] = (1e3 * np.sqrt((error**2).mean((0, 1)))).tolist()
        out[f"{name}ee_error_mm"] = open_loop_error(robot, dynamics, recording, nthread)
    return out


def open_loop_error(robot: Robot, dynamics: Dynamics, recording: Recording, nthread: int) -> dict[str, float]:
    """Return {horizon in s: mean distance in mm between simulated and recorded end effector after this horizon}."""
    errors = {}
    for horizon in HORIZONS:
        if (windows := windows_or_none(recording, horizon, MAX_WINDOWS)) is None:
            continue
        sim = Simulator(robot, dynamics, len(windows.q0), nthread)
        places = []
        for state in (replay(robot, dynamics, windows, nthread)[:, -1], windows.q[:, -1]):
            sim.reset(state, np.zeros_like(state))
            places.append(sim.ee.copy())
        errors[f"{horizon:g}"] = float(1e3 * np.linalg.norm(places[0] - places[1], axis=-1).mean())
    return errors
