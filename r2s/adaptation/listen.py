"""A recording, listened to as the arm would be while it works: cycle by cycle, nothing ahead."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd

from r2s.adaptation.believed import believed
from r2s.adaptation.estimator import Estimate, Estimator
from r2s.adaptation.kalman import Noise
from r2s.adaptation.noise import balances, learnt, noise_of, prior_of
from r2s.adaptation.refinement import Beyond, refined
from r2s.errors import UserError
from r2s.identification.parameters import ParameterSpace
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording

SLOWEST = 200.0  # Hz


def estimator(
    robot: Robot,
    dynamics: Dynamics,
    posterior: tuple[ParameterSpace, np.ndarray] | None = None,
    unloaded: tuple[Recording, Recording] | None = None,
) -> Estimator:
    """Return the estimator of an arm; arguments as of `learn`."""
    more, noise = learn(robot, dynamics, posterior, unloaded)
    return Estimator(refined(believed(robot, dynamics), more), noise)


def learn(
    robot: Robot,
    dynamics: Dynamics,
    posterior: tuple[ParameterSpace, np.ndarray] | None = None,
    unloaded: tuple[Recording, Recording] | None = None,
) -> tuple[Beyond, Noise]:
    """Return what motion without a payload says of an arm beyond its identification, and how wrong that may be.

    Args:
        robot, dynamics: what is believed of the arm.
        posterior: the space and draws of its identification, which say how well friction and offsets are known.
        unloaded: two recordings of commanded torque without a payload, such as the identification's own. Without
            them nothing is beyond it, and the model's error is taken to be a tenth of friction.
    """
    arm = believed(robot, replace(dynamics, told=np.zeros(4)))  # as it was when it was identified
    prior = prior_of(*posterior) if posterior is not None else None
    if unloaded is None:
        return Beyond.none(robot.n), noise_of(arm, prior)
    train, other = (balances(arm, at_rate(robot, r)) for r in unloaded)
    return learnt(robot, arm, prior, train, other)


def at_rate(robot: Robot, recording: Recording) -> Recording:
    """Return the recording with a row per millisecond.

    Raises:
        UserError: it is of another arm, of another torque than the commanded one, or slower than 200 Hz.
    """
    if recording.n_joints != robot.n:
        raise UserError(f"data: the recording has {recording.n_joints} joints, {robot.name} has {robot.n}")
    if recording.torque != "commanded":
        raise UserError(f"data.torque: '{recording.torque}' is not allowed here; commanded is")
    if recording.rate_hz < SLOWEST:
        raise UserError(f"data: {recording.rate_hz:.0f} Hz is too slow to listen to an arm; at least {SLOWEST:g} is")
    steps = np.diff(recording.t)[np.diff(recording.trajectory) == 0]
    return recording if np.allclose(steps, SIM_DT, atol=1e-6) else recording.resample(SIM_DT)


def listen(
    robot: Robot, estimator: Estimator, recording: Recording, told: Callable[[Estimate], None] | None = None
) -> list[Estimate]:
    """Return what is known at the end of each span of the recording; `told` gets each as it comes."""
    recording, out = at_rate(robot, recording), []
    for stretch in recording.stretches:
        estimator.begin()
        for k in range(stretch.start, stretch.stop):
            if estimator(recording.q[k], recording.dq[k], recording.tau[k]):
                out.append(estimator.now)
                if told is not None:
                    told(estimator.now)
    return out


def table(known: list[Estimate]) -> pd.DataFrame:
    """Return a row per moment: value and half width at 95 % of each number."""
    columns: dict[str, list] = {"t": [k.t for k in known]}
    columns |= {"mass_kg": [k.mass for k in known], "mass_kg_half": [k.mass_half for k in known]}
    for name, unit in (("centre", "m"), ("friction", ""), ("offset", "Nm")):
        for i in range(len(getattr(known[0], name))):
            label = f"{name}_{'xyz'[i] if name == 'centre' else i + 1}" + (f"_{unit}" if unit else "")
            columns[label] = [getattr(k, name)[i] for k in known]
            columns[f"{label}_half"] = [getattr(k, f"{name}_half")[i] for k in known]
    columns |= {"rests": [int(k.rests) for k in known], "odds": [k.odds for k in known]}
    columns |= {"changed": [int(k.changed) for k in known]}
    return pd.DataFrame(columns)


def words(known: Estimate) -> str:
    """Return one moment in a line."""
    carried = f"{max(known.mass, 0.0):.3f} ± {known.mass_half:.3f} kg"
    if np.isfinite(known.centre).all():
        place = ", ".join(
            f"{100 * c:.1f} ± {100 * h:.1f}" for c, h in zip(known.centre, known.centre_half, strict=True)
        )
        carried += f" at ({place}) cm"
    friction = " ".join(f"{100 * f:.0f}" for f in known.friction)
    return f"{known.t:7.2f} s  {carried}; friction {friction} %{'; at rest' if known.rests else ''}"
