"""What a stage leaves to look at: figures/*.png, recording.rrd and report.md of its run folder."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.arm.deploy import Stop, Timing
from r2s.identification.parameters import parameter_space
from r2s.identification.torque_residual import BLOCK_S, TorqueResidual
from r2s.identification.uncertainty import Identified
from r2s.identification.windows import cut_windows, replay
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import SIGMOID
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording
from r2s.reporting.comparison import (
    improvement_matrix,
    improvement_table,
    sensitivity_table,
    shown_of,
    summary_table,
)
from r2s.reporting.document import report_html, report_markdown
from r2s.reporting.grouping import Groups
from r2s.reporting.identification_figures import (
    convergence_figure,
    friction_figure,
    position_figure,
    torque_figure,
    whiteness_figure,
    whiteness_table,
)
from r2s.reporting.identification_page import TORQUE, identification_sections
from r2s.reporting.learning_figures import bands_figure, learning_figure, scores_figure
from r2s.reporting.reach_figures import latency_figure, reach_figure, traces_figure
from r2s.reporting.tables import gap_rows, reach_rows, scores_rows
from r2s.reporting.viewer import write_recording
from r2s.reporting.viewer_layout import Episode, Overlay
from r2s.runs import Run
from r2s.tasks.episode import Episodes

SHOWN = 4  # episodes, as in the paper's figures


def identification(
    run: Run,
    robot: Robot,
    nominal: Dynamics,
    found: Identified,
    validation: Recording,
    summary: Mapping,
    *,
    window_s: float,
    cutoff_hz: float,
) -> None:
    """Write figures, report.md, report.html and recording.rrd; everything is shown on validation motion."""
    space = parameter_space(robot, nominal, {"offset": [-1.0, 1.0]})
    torque = TorqueResidual(robot, space, validation, cutoff_hz=cutoff_hz)
    motion, both = torque.motion, {"nominal": nominal, "identified": found.dynamics}
    commanded = validation.torque == "commanded"
    error = {label: torque.off(d) for label, d in both.items()}
    predicted = {label: motion.tau + e for label, e in error.items()}  # beside the recorded torque, delay undone
    kind = TORQUE[validation.torque].split(",")[0]
    title = f"{kind} of validation motion, low-pass {cutoff_hz:g} Hz"
    pictures = {"torque": torque_figure(run.figure("torque"), motion.t, motion.tau, predicted, title)}
    if commanded:
        windows = cut_windows(validation, max(window_s, 0.5) if validation.duration > 1.0 else window_s)
        replays = {label: replay(robot, d, windows) for label, d in both.items()}
        pictures["position"] = position_figure(run.figure("position"), windows.q, replays)
    fastest = np.maximum(np.quantile(np.abs(motion.dq), 0.995, axis=0), 0.02)
    without = replace(found.dynamics, family=SIGMOID, phi=np.zeros((robot.n, 3)))
    friction = torque.predict(found.dynamics) - torque.predict(without) - error["identified"]
    draws = found.space.dynamics(found.found.samples).phi
    pictures["friction"] = friction_figure(run.figure("friction"), both, fastest, (motion.dq, friction), draws)
    block_s = window_s if commanded else BLOCK_S
    pictures["whiteness"] = whiteness_figure(run.figure("whiteness"), motion.t, error, cutoff_hz, block_s)
    pictures["convergence"] = convergence_figure(run.figure("convergence"), found.history)
    np.savez_compressed(run.folder / "torque.npz", t=motion.t, measured=motion.tau, **predicted)  # type: ignore[arg-type]
    overlay = Overlay(motion.t, motion.tau, predicted)
    timeless = {name: p for name, p in pictures.items() if name != "torque"}
    write_recording(run.folder / "recording.rrd", robot, overlays={kind: overlay}, figures=timeless)
    sections = identification_sections(
        robot,
        nominal,
        found,
        validation,
        summary,
        pictures=pictures,
        fastest=fastest,
        whiteness=whiteness_table(motion.t, error["identified"], cutoff_hz),
        window_s=window_s,
        cutoff_hz=cutoff_hz,
    )
    report_markdown(run.folder / "report.md", sections)
    report_html(run.folder / "report.html", sections)


def training(run: Run, robot: Robot) -> None:
    """Draw the learning curves."""
    curves = {run.folder.name: pd.read_csv(run.folder / "evaluations.csv")}
    learning = learning_figure(run.figure("learning"), curves)
    write_recording(run.folder / "recording.rrd", robot, curves=curves, figures={"learning": learning})


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
    """Save all episodes and what came before a stop, show four goals in figures and recording, say it on one page.

    Args:
        run, robot: whose. episodes: per simulator and arm.
        rows: the same with what was measured. torque: (n,) Nm, the most that a policy may ask for.
        timing: of the arm's cycle, None where there was no arm. stops: why the arm stopped.
        halted: why not all goals were done, or None.
    """
    shown = {label: first(e) for label, e in episodes.items()}
    for label, e in episodes.items():
        np.savez_compressed(run.folder / f"episodes_{label}.npz", **asdict(e))
    if stops:
        logs = {f"episode_{stop.episode + 1}": stop.log for stop in stops}
        np.savez_compressed(run.folder / "stops.npz", **logs)  # type: ignore[arg-type]
    reach = reach_figure(run.figure("reach"), shown)
    traces = traces_figure(run.figure("traces"), episodes)
    pictures = {"traces": traces}
    sections: dict[str, Sequence] = {
        "The same policy (of the best evaluation) and goals": [reach_rows(rows), gap_rows(rows)]
    }
    if timing:
        pictures["latency"] = latency_figure(run.figure("latency"), asdict(timing))
        cycle = pd.DataFrame(timing.table()).set_index("what").map(lambda x: f"{x:.3g}")
        sections["On the clock of this computer"] = [cycle]
        sections["Why the arm stopped"] = [list(map(str, stops)) or "It did not."]
        if halted is not None:
            sections["Why not all goals were done"] = [halted]
    touched = {
        label: [f"episode {k + 1}, {what}" for k, what in enumerate(e.collision) if what]
        for label, e in episodes.items()
    }
    if any(touched.values()):
        sections["What touched what"] = [f"{label}, {line}" for label, lines in touched.items() for line in lines]
    write_recording(run.folder / "recording.rrd", robot, episodes=shown, figures=pictures, torque=torque)
    report_markdown(run.folder / "report.md", sections | {"Figures": [reach, *pictures.values()]})


def compare(
    run: Run, robot: Robot, grouped: Groups, apart: Mapping[str, str], others: Mapping[str, str]
) -> dict[str, pd.DataFrame]:
    """Write what can be said of several trainings: tables as CSV, figures, a report and one recording.

    Args:
        run, robot: whose. grouped: what is compared. apart: {run: why it cannot be compared with these}.
        others: {folder: why it is no finished training}.

    Returns:
        {"scores", "improvement", "sensitivity"}: tables of r2s/reporting/comparison.py.
    """
    groups = grouped.members
    tables = {"scores": summary_table(groups), "improvement": improvement_table(groups)}
    tables["sensitivity"] = sensitivity_table(groups)
    last = {r.folder.name: {"group": label, "seed": r.seed} | r.last for label, g in groups.items() for r in g}
    pd.DataFrame.from_dict(last, orient="index").to_csv(run.folder / "last.csv", index_label="run")
    for name, table in tables.items():
        if len(table):
            table.to_csv(run.folder / f"{name}.csv", index=False)
    figures = {"learning": bands_figure(run.figure("learning"), grouped)}
    figures["scores"] = scores_figure(run.figure("scores"), tables["scores"])
    curves = {f"{label}, run {k}": r.curve for label, g in groups.items() for k, r in enumerate(g, 1)}
    write_recording(run.folder / "recording.rrd", robot, curves=curves, figures=figures)
    sections = _comparison(grouped, tables, apart, others)
    report_markdown(run.folder / "report.md", sections | {"Figures": list(figures.values())})
    return tables


def _comparison(
    grouped: Groups, tables: Mapping[str, pd.DataFrame], apart: Mapping[str, str], others: Mapping[str, str]
) -> dict[str, Sequence]:
    """Return the tables of a comparison and what was not compared, in words."""
    count = sum(map(len, grouped.members.values()))
    sections: dict[str, Sequence] = {
        f"{count} runs in {len(grouped.members)} groups, by their last evaluation": [
            "Interquartile mean over seeds, with a 95 % bootstrap interval. A group is named by what was typed of "
            "the settings that differ; what its name leaves out is the default.",
            scores_rows(tables["scores"]),
            *([[f"{label}: {name}" for label, name in grouped.key.items()]] if grouped.key else []),
        ]
    }
    if apart:
        sections["Set apart: these cannot be compared with the runs above"] = [
            [f"{k}: {v}" for k, v in apart.items()]
        ]
    if others:
        sections["No finished trainings"] = [[f"{k}: {v}" for k, v in others.items()]]
    titles = {"success_1cm": "success within 1 cm", "return_paper": "return", "within_5mm": "time within 5 mm"}
    titles["path_rmse_mm"] = "RMSE of the path"
    judged = shown_of(grouped.members).judged
    for measure in judged:
        if len(tables["improvement"]):
            heading = "Probability that a run of one group is better than a run of another: "
            heading += f"{titles[measure]}, last evaluation"
            sections[heading] = [improvement_matrix(tables["improvement"], measure)]
    if len(tables["sensitivity"]):
        what = titles[judged[1]]
        sections[f"How much the last {what} depends on the settings (smaller spread: less to tune)"] = [
            tables["sensitivity"].round(2).astype(str).set_index("algo")
        ]
    return sections


def pipeline(
    run: Run,
    robot: Robot,
    identified: Path,
    trained: Mapping[str, Path],
    transferred: Mapping[str, Path],
    rows: Mapping,
) -> None:
    """Put the whole chain into one recording and one report."""
    episodes = {}
    for label, folder in transferred.items():
        for path in sorted(folder.glob("episodes_*.npz")):
            where = path.stem.removeprefix("episodes_")
            if where != "mujoco":
                episodes[f"{where}, {label}"] = unstack(path)
    curves = {label: pd.read_csv(folder / "evaluations.csv") for label, folder in trained.items()}
    with np.load(identified / "torque.npz", allow_pickle=False) as saved:
        predicted = {k: saved[k] for k in ("nominal", "identified")}
        overlay = Overlay(saved["t"], saved["measured"], predicted)
    title = "torque of validation motion"
    learning = learning_figure(run.figure("learning"), curves)
    torque = torque_figure(run.figure("torque"), overlay.t, overlay.measured, predicted, title)
    pictures = [torque, learning, reach_figure(run.figure("reach"), episodes)]
    overlays = {"real against simulated torque": overlay}
    write_recording(
        run.folder / "recording.rrd",
        robot,
        episodes=episodes,
        overlays=overlays,
        curves=curves,
        figures={"learning": learning},
    )
    steps = ", ".join(str(p) for p in (identified, *trained.values(), *transferred.values()))
    sections: dict[str, Sequence] = {
        f"From a recording to a policy: {run.folder.name}": [reach_rows(rows), f"Steps: {steps}."],
        "Figures": pictures,
    }
    report_markdown(run.folder / "report.md", sections)


def first(episodes: Episodes) -> list[Episode]:
    """Return the first few episodes, one by one."""
    e = episodes
    return [Episode(e.t, e.q[i], e.ee[i], e.goal[i], e.tau[i]) for i in range(min(SHOWN, len(e.goal)))]


def unstack(path: Path) -> list[Episode]:
    """Return the first few of the episodes that `transfer` saved."""
    with np.load(path, allow_pickle=False) as saved:
        return first(Episodes(**saved))
