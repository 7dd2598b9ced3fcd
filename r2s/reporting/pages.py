"""Write figures and recording.rrd of a training, transfer or pipeline; write report.md of a transfer or pipeline."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.arm.policy_runner import Stop
from r2s.arm.realtime import Timing
from r2s.physics.robot import Robot
from r2s.reporting.document import Item, report_markdown
from r2s.reporting.figures.episodes import error_figure, latency_figure, traces_figure
from r2s.reporting.figures.learning import learning_figure
from r2s.reporting.identification.figures import torque_figure
from r2s.reporting.measures import measures_of
from r2s.reporting.tables import diagnostic_rows, measure_rows
from r2s.reporting.viewer.data import Content, Overlay, first, saved_episodes
from r2s.reporting.viewer.recording import write_recording
from r2s.runs import Run
from r2s.tasks.measures import MeasureTable, write_measures
from r2s.tasks.rollout import Episodes

PREDICTED = "predicted: simulation with the training's model without randomization, the reference of both gaps."


def training(run: Run, robot: Robot) -> None:
    """Draw the learning curves of a training and write its recording.rrd."""
    measures = measures_of(run.folder)
    curves = {run.folder.name: pd.read_csv(run.folder / "evaluations.csv")}
    learning = learning_figure(run.figure("learning"), curves, [measures[key] for key in measures.curves])
    content = Content(measures, curves=curves, figures={"learning": learning})
    write_recording(run.folder / "recording.rrd", robot, content)


def transfer(
    run: Run,
    robot: Robot,
    episodes: Mapping[str, Episodes],
    rows: Mapping[str, Mapping],
    torque: np.ndarray,
    timing: Timing | None = None,
    stops: Sequence[Stop] = (),
    halted: str | None = None,
) -> None:
    """Save a transfer's episodes and the last second before each stop; draw up to four episodes; write the report.

    Args:
        run, robot: the run and its arm. episodes: {simulator or arm: episodes}. rows: {simulator or arm: measures}.
        torque: (n,) Nm, the policy's torque limits. timing: latencies of control cycles; None without an arm.
        stops: stops of the arm, with reasons. halted: reason why episodes were not run, or None if all episodes ran.
    """
    measures = measures_of(run.folder)
    shown = {label: first(e) for label, e in episodes.items()}
    for label, e in episodes.items():
        arrays = {name: a for name, a in asdict(e).items() if a is not None}
        np.savez_compressed(run.folder / f"episodes_{label}.npz", **arrays)
    if stops:
        logs = {f"episode_{stop.episode + 1}": stop.log for stop in stops}
        np.savez_compressed(run.folder / "stops.npz", **logs)  # type: ignore[arg-type]
    error = error_figure(run.figure("reach"), shown, measures)
    pictures = {"traces": traces_figure(run.figure("traces"), episodes, measures.reward)}
    sections: dict[str, Sequence[Item]] = {
        "The same policy (of the best evaluation) on the same goals": [
            measure_rows(measures, rows),
            diagnostic_rows(measures, rows),
            *([PREDICTED] if "predicted" in rows else []),
        ]
    }
    if timing:
        seconds = {name: values for name, values in asdict(timing).items() if name != "success"}
        pictures["latency"] = latency_figure(run.figure("latency"), seconds)
        sections["Latencies on this computer, ms"] = [
            pd.DataFrame(timing.table())
            .set_index("what")
            .map(lambda x: f"{x:.3g}" if isinstance(x, float) else str(x))
        ]
        sections["Stops of the arm"] = [list(map(str, stops)) or "None."]
        if halted is not None:
            sections["Episodes that were not run"] = [halted]
    collisions = [
        f"{label}, episode {k + 1}, {what}"
        for label, e in episodes.items()
        for k, what in enumerate(e.collision)
        if what
    ]
    if collisions:
        sections["Collisions"] = [collisions]
    content = Content(measures, shown, figures=pictures, torque=torque)
    write_recording(run.folder / "recording.rrd", robot, content)
    report_markdown(run.folder / "report.md", sections | {"Figures": [error, *pictures.values()]})


def pipeline(
    run: Run,
    robot: Robot,
    identified: Path,
    trained: Mapping[str, Path],
    transferred: Mapping[str, Path],
    rows: Mapping,
) -> MeasureTable:
    """Write one recording.rrd and one report of the whole pipeline; return the task's measure table.

    Args:
        run, robot: run and arm of the pipeline. identified: run folder of the identification.
        trained, transferred: {label: run folder} of trainings and transfers. rows: {label: measures of a transfer}.
    """
    measures = measures_of(next(iter(transferred.values())))
    write_measures(run.folder, measures)
    episodes = {
        f"{where}, {label}": e
        for label, folder in transferred.items()
        for where, e in saved_episodes(folder).items()
        if where != "mujoco"
    }
    curves = {label: pd.read_csv(folder / "evaluations.csv") for label, folder in trained.items()}
    overlay = Overlay.load(identified)
    learning = learning_figure(run.figure("learning"), curves, [measures[key] for key in measures.curves])
    title = "torque of validation motion"
    torque = torque_figure(run.figure("torque"), overlay.t, overlay.measured, overlay.predicted, title)
    error = error_figure(run.figure("reach"), episodes, measures)
    overlays = {"measured and predicted torque": overlay}
    content = Content(measures, episodes, overlays, curves, {"learning": learning})
    write_recording(run.folder / "recording.rrd", robot, content)
    steps = ", ".join(str(p) for p in (identified, *trained.values(), *transferred.values()))
    sections: dict[str, Sequence[Item]] = {
        f"From a recording to a policy: {run.folder.name}": [measure_rows(measures, rows), f"Steps: {steps}."],
        "Figures": [torque, learning, error],
    }
    report_markdown(run.folder / "report.md", sections)
    return measures
