"""Write the page of an identification: Tables I to IV of the paper for this arm, identifiability, and figures.

In tables, "old" denotes the nominal model and "new" the identified model. Intervals contain 95 % of the posterior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from r2s.identification.base_parameters import base_table
from r2s.identification.blocks import BLOCK_S
from r2s.identification.prediction import REPLAYED_S, SCORED_EACH_S, SCORED_S
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.residuals.windows import replay, windows_or_none
from r2s.identification.residuals.zero_phase import FRICTION_CUTOFF
from r2s.identification.result import IdentificationResult
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import SIGMOID
from r2s.physics.robot import Robot
from r2s.recordings.parts import spread
from r2s.recordings.recording import Recording
from r2s.reporting.document import Item, report_html, report_markdown
from r2s.reporting.identification.figures import convergence_figure, friction_figure, position_figure, torque_figure
from r2s.reporting.identification.identifiability import identifiability
from r2s.reporting.identification.paper_tables import (
    base_items,
    breakaway_table,
    family_table,
    friction_table,
    inertia_tables,
    offset_table,
    other_terms,
)
from r2s.reporting.identification.tables import error_tables
from r2s.reporting.identification.values import LEGEND
from r2s.reporting.identification.whiteness import whiteness_figure, whiteness_table
from r2s.reporting.tables import number
from r2s.reporting.viewer.data import Content, Overlay, external_overlay
from r2s.reporting.viewer.recording import write_recording
from r2s.runs import Run

TORQUE = {  # data.torque in words
    "commanded": "commanded torque, without gravity",
    "measured": "link-side torque, with gravity",
    "motor": "motor torque, with gravity and all friction",
}
FIGURE_WINDOW_S = 0.5  # s, shortest open-loop window in the position figure, unless the motion is too short


class Evidence(NamedTuple):
    """What the page of an identification shows besides `IdentificationResult`.

    Attributes:
        pictures: {"torque": PNG file, ...}. fastest: (n,) rad/s, 99.5 % quantile of each joint's speed in validation.
        whiteness: result of `whiteness_table` for the validation motion. base: result of `base_table`.
        window_s: length of a replay, s. cutoff_hz: cutoff frequency of the low-pass in the torque fit, Hz.
    """

    pictures: Mapping[str, Path]
    fastest: np.ndarray
    whiteness: pd.DataFrame
    base: pd.DataFrame
    window_s: float
    cutoff_hz: float


def identification_page(
    run: Run,
    nominal: Dynamics,
    found: IdentificationResult,
    validation: Recording,
    summary: Mapping,
    *,
    window_s: float,
    cutoff_hz: float,
    more: Mapping[str, Sequence[Item]] | None = None,
) -> None:
    """Write the report (Markdown, HTML), figures, base_parameters.csv, torque.npz and recording.rrd.

    Args:
        run: run of the identification. nominal: nominal model. found: the result. validation: held-out motion.
        summary: content of summary.json. window_s: length of a replay, s. cutoff_hz: cutoff frequency of the low-pass
            in the torque fit, Hz.
        more: {heading: items}, further sections of the page, placed after the prediction errors.
    """
    robot, shown = found.space.robot, spread(validation, SCORED_S, SCORED_EACH_S)
    torque = TorqueResidual(found.space, shown, cutoff_hz=cutoff_hz)
    motion, both = torque.motion, {"nominal": nominal, "identified": found.dynamics}
    error = {label: torque.error(d) for label, d in both.items()}
    overlay = Overlay(motion.t, motion.tau, {label: motion.tau + e for label, e in error.items()})
    kind = TORQUE[validation.torque].split(",")[0]
    title = f"{kind} of validation motion, low-pass {cutoff_hz:g} Hz"
    pictures = {"torque": torque_figure(run.figure("torque"), motion.t, motion.tau, overlay.predicted, title)}
    block_s = BLOCK_S
    if validation.torque == "commanded":
        block_s = window_s
        seconds = max(window_s, FIGURE_WINDOW_S) if validation.duration > 2 * FIGURE_WINDOW_S else window_s
        windows = windows_or_none(spread(validation, REPLAYED_S), seconds)
        if windows is not None:
            replays = {label: replay(robot, d, windows) for label, d in both.items()}
            pictures["position"] = position_figure(run.figure("position"), windows.q, replays)
    fastest = np.maximum(np.quantile(np.abs(motion.dq), 0.995, axis=0), 0.02)
    without = replace(found.dynamics, family=SIGMOID, phi=np.zeros((robot.n, 3)))
    friction = torque.predict(found.dynamics) - torque.predict(without) - error["identified"]
    draws = found.space.dynamics(found.found.samples).phi
    pictures["friction"] = friction_figure(run.figure("friction"), both, fastest, (motion.dq, friction), draws)
    pictures["whiteness"] = whiteness_figure(run.figure("whiteness"), motion.t, error, cutoff_hz, block_s)
    pictures["convergence"] = convergence_figure(run.figure("convergence"), found.history)
    arrays = {"t": motion.t, "measured": motion.tau, **overlay.predicted}
    np.savez_compressed(run.folder / "torque.npz", **arrays)  # type: ignore[arg-type]
    overlays = {kind: overlay, **external_overlay(validation)}
    timeless = {name: p for name, p in pictures.items() if name != "torque"}
    write_recording(run.folder / "recording.rrd", robot, Content(overlays=overlays, figures=timeless))
    whiteness = whiteness_table(motion.t, error["identified"], cutoff_hz)
    base = base_table(found.space, found.found, rotors=validation.torque != "measured")
    base.to_csv(run.folder / "base_parameters.csv", index=False, float_format="%.6g")
    evidence = Evidence(pictures, fastest, whiteness, base, window_s, cutoff_hz)
    own = list(identification_sections(robot, nominal, found, validation, summary, evidence).items())
    sections = dict([*own[:2], *(more or {}).items(), *own[2:]])
    report_markdown(run.folder / "report.md", sections)
    report_html(run.folder / "report.html", sections)


def identification_sections(
    robot: Robot,
    nominal: Dynamics,
    found: IdentificationResult,
    validation: Recording,
    summary: Mapping,
    evidence: Evidence,
) -> dict[str, Sequence[Item]]:
    """Return the page as {heading: paragraphs, bullets, tables, figures}; see `identification_page` for arguments."""
    commanded = validation.torque == "commanded"

    def shown(*names: str) -> list[Item]:
        return [evidence.pictures[name] for name in names if name in evidence.pictures]

    errors = [x for name, table in error_tables(robot, summary).items() for x in (name[0].upper() + name[1:], table)]
    sections: dict[str, Sequence[Item]] = {
        f"Identification of {robot.name}": [
            _headlines(robot, found, validation, summary),
            f"In the tables: {LEGEND}.",
        ],
        "Prediction, before and after": [
            "Nominal and identified model on the training motion and on the validation motion, which the fit did not "
            "use. A ratio below 1 is an improvement.",
            *errors,
            *shown("torque", "position"),
        ],
        "Table I: torque offsets": offset_table(robot, found),
        "Table II: breakaway": breakaway_table(robot, nominal, found, commanded),
        "Table III: inertia": inertia_tables(robot, found),
        "Base parameters": base_items(robot, evidence.base),
        "Table IV: friction": [
            *friction_table(robot, nominal, found, evidence.fastest),
            *shown("friction"),
            "Dots: torque of the validation motion minus all other terms of the identified model.",
        ],
        "Delay, lag and other terms": other_terms(robot, found),
        "Friction families": family_table(found),
        "Identifiability": identifiability(found),
        "Residual": [
            "Torque of the validation motion minus the prediction of the identified model. A complete model leaves "
            "white noise. If the residual stays correlated for longer than a bootstrap block, the intervals are too "
            "narrow.",
            evidence.whiteness,
            *shown("whiteness"),
        ],
        "Convergence": [
            *shown("convergence"),
            "Costs are comparable within one search only, because residuals are reweighted between searches.",
        ],
        "Filtering of the recording": _filtering(commanded, evidence.window_s, evidence.cutoff_hz),
    }
    return {heading: items for heading, items in sections.items() if items}


def _headlines(robot: Robot, found: IdentificationResult, validation: Recording, summary: Mapping) -> list[str]:
    """Return the bullets at the top of the page: recording, friction family and errors on validation motion."""
    parts = [f"Recording {validation.name or 'without a name'}: {TORQUE[validation.torque]}"]
    for side in ("train", "validation"):
        if "seconds" in summary.get(side, {}):
            what = "training" if side == "train" else side
            parts.append(f"{summary[side]['seconds']:.1f} s of {what} motion")
    lines = [
        f"{'; '.join(parts)}.",
        f"Friction family {found.dynamics.family.name}; {len(found.x)} parameters searched, "
        f"{int(found.found.identifiable.sum())} identifiable, {len(found.unseen)} kept nominal.",
    ]
    errors = summary.get("validation", {})
    if "nominal_torque_rmse_Nm" in errors:
        new, old = (np.asarray(errors[f"{k}torque_rmse_Nm"]) for k in ("", "nominal_"))
        worse = [f"joint {j + 1} ({new[j] / old[j]:.2f})" for j in np.flatnonzero(new > old)]
        lines.append(
            f"Torque RMSE on validation motion, mean over joints: {new.mean():.3g} Nm, nominal {old.mean():.3g} Nm; "
            f"{'worse than nominal: ' + ', '.join(worse) if worse else 'no joint is worse'}."
        )
    reached, before = errors.get("ee_error_mm", {}), errors.get("nominal_ee_error_mm", {})
    if reached:
        after = [f"{number(reached[h])} mm after {h} s ({number(before.get(h))})" for h in sorted(reached, key=float)]
        lines.append(f"Open-loop end-effector error on validation motion (nominal in brackets): {', '.join(after)}.")
    return lines


def _filtering(commanded: bool, window_s: float, cutoff_hz: float) -> list[Item]:
    """Return bullets about resampling, filters and replay windows."""
    lines = [
        "Each trajectory was resampled to 1 kHz on its logged time, linearly.",
        f"Torque fit: positions, velocities and torque pass a zero-phase low-pass of {cutoff_hz:g} Hz (Butterworth "
        "of order 4, forwards and backwards); accelerations are its derivative. The fit uses a row per 10 ms and "
        "drops the first and last 50 ms of a trajectory.",
        f"Friction is evaluated at velocities low-passed at {FRICTION_CUTOFF * cutoff_hz:g} Hz ({FRICTION_CUTOFF:g} "
        "times the cutoff), then filtered like the torque: the filter rounds the step of friction at a reversal.",
    ]
    if commanded:
        lines.append(
            f"Replay: windows of {window_s:g} s with unfiltered commands. The start state is a cubic Savitzky-Golay "
            "fit to 31 ms of positions, also in the figure of open-loop errors."
        )
    return [lines]
