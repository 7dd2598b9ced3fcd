"""Apply the recursive estimator to a recording: causally, cycle by cycle, as on a working arm."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd

from r2s.adaptation.arm_model import make_arm_model
from r2s.adaptation.estimator import Estimate, Estimator
from r2s.adaptation.kalman import Noise
from r2s.adaptation.model_correction import ModelCorrection
from r2s.adaptation.noise_model import default_noise, fit_noise, momentum_residuals, prior_of
from r2s.errors import UserError
from r2s.identification.parameters import ParameterSpace
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording

LEAST_HZ = 200.0  # Hz, r2s's choice: four rows per 20 ms span of the estimator
UNKNOWN_PAUSE_S = 60.0  # s, assumed for a pause of unknown length: enough time to change the payload


def fit_correction(
    robot: Robot,
    dynamics: Dynamics,
    posterior: tuple[ParameterSpace, np.ndarray] | None = None,
    unloaded: tuple[Recording, Recording] | None = None,
) -> tuple[ModelCorrection, Noise]:
    """Return the model correction from recordings without a payload, and the uncertainty of the corrected model.

    Args:
        robot, dynamics: the identified arm.
        posterior: parameter space and posterior samples, for the uncertainty of friction and offsets.
        unloaded: two recordings with commanded torque and without a payload, for example those of the identification.
            Without recordings (None), the correction is zero, and the model error is a tenth of the friction level.
    """
    arm = make_arm_model(robot, replace(dynamics, declared_payload=np.zeros(4)))  # identification declares none
    prior = prior_of(*posterior) if posterior is not None else None
    if unloaded is None:
        return ModelCorrection.none(robot.n), default_noise(arm, prior)
    train, other = (momentum_residuals(arm, at_rate(robot, r)) for r in unloaded)
    return fit_noise(robot, arm, prior, train, other)


def at_rate(robot: Robot, recording: Recording) -> Recording:
    """Return the recording, resampled to one row per millisecond.

    Raises:
        UserError: the recording has a wrong number of joints, no commanded torque, or a rate below 200 Hz.
    """
    if recording.n_joints != robot.n:
        raise UserError(f"data: expected {robot.n} joints of {robot.name}, got {recording.n_joints}")
    if recording.torque != "commanded":
        raise UserError(f"data.torque: expected commanded, got {recording.torque}")
    if recording.rate_hz < LEAST_HZ:
        raise UserError(f"data: expected at least {LEAST_HZ:g} Hz, got {recording.rate_hz:.0f} Hz")
    steps = np.diff(recording.t)[np.diff(recording.trajectory) == 0]
    return recording if np.allclose(steps, SIM_DT, atol=1e-6) else recording.resample(SIM_DT)


def estimate_recording(
    robot: Robot, estimator: Estimator, recording: Recording, report: Callable[[Estimate], None] | None = None
) -> list[Estimate]:
    """Return the estimates at the end of each 20 ms of a recording; call `report` with each new estimate."""
    recording, out = at_rate(robot, recording), []
    for stretch, pause_s in zip(recording.stretches, pauses(recording), strict=True):
        estimator.begin(pause_s)
        for k in range(stretch.start, stretch.stop):
            if estimator(recording.q[k], recording.dq[k], recording.tau[k]):
                out.append(estimator.now)
                if report is not None:
                    report(estimator.now)
    return out


def pauses(recording: Recording) -> list[float]:
    """Return the pause (s) before each trajectory; if the clock restarts, assume a pause of UNKNOWN_PAUSE_S."""
    starts = [recording.t[s.start] for s in recording.stretches]
    ends = [recording.t[s.stop - 1] for s in recording.stretches]
    between = [float(b - a) for a, b in zip(ends[:-1], starts[1:], strict=True)]
    return [0.0, *(p if p > 0 else UNKNOWN_PAUSE_S for p in between)]


def table(estimates: list[Estimate]) -> pd.DataFrame:
    """Return a table with a row for each estimate: its values and the half widths of their 95 % intervals."""
    columns: dict[str, list] = {"t": [e.t for e in estimates]}
    columns |= {"mass_kg": [e.mass for e in estimates], "mass_kg_half": [e.mass_half for e in estimates]}
    for name, unit in (("centre", "m"), ("friction", ""), ("offset", "Nm")):
        for i in range(len(getattr(estimates[0], name))):
            label = f"{name}_{'xyz'[i] if name == 'centre' else i + 1}" + (f"_{unit}" if unit else "")
            columns[label] = [getattr(e, name)[i] for e in estimates]
            columns[f"{label}_half"] = [getattr(e, f"{name}_half")[i] for e in estimates]
    columns |= {"rests": [int(e.rests) for e in estimates], "odds": [e.odds for e in estimates]}
    columns |= {"changed": [int(e.changed) for e in estimates]}
    return pd.DataFrame(columns)


def format_estimate(estimate: Estimate) -> str:
    """Return an estimate as one line of text."""
    payload = f"{max(estimate.mass, 0.0):.3f} ± {estimate.mass_half:.3f} kg"
    if np.isfinite(estimate.centre).all():
        values = zip(estimate.centre, estimate.centre_half, strict=True)
        payload += f" at ({', '.join(f'{100 * c:.1f} ± {100 * h:.1f}' for c, h in values)}) cm"
    friction = " ".join(f"{100 * f:.0f}" for f in estimate.friction)
    payload += " above the arm's largest payload" if estimate.beyond else ""
    return f"{estimate.t:7.2f} s  {payload}; friction {friction} %{'; at rest' if estimate.rests else ''}"
