"""Write the report of a planned motion: table, figure and recording for the Rerun viewer."""

from typing import Any

import numpy as np
from rich.console import Console

from r2s.excitation.motion import Excitation
from r2s.identification.planned_width import PlannedWidths
from r2s.physics.robot import Robot
from r2s.reporting.document import report_markdown
from r2s.reporting.figures.log_rows import thin
from r2s.reporting.figures.panels import joint_panels
from r2s.reporting.identification.verdict import LEGEND, WIDTHS, width_table
from r2s.reporting.tables import print_table
from r2s.reporting.viewer.data import Content
from r2s.reporting.viewer.recording import write_recording
from r2s.runs import Run


def excitation_page(
    console: Console, run: Run, robot: Robot, motion: Excitation, design: PlannedWidths
) -> dict[str, Any]:
    """Print expected widths of 95 % intervals; write report.md, figure and recording; return a summary."""
    table = width_table(design, robot.n)
    print_table(console, table, f"{WIDTHS}, of {design.torque} torque", LEGEND)
    share = {"velocity": np.abs(motion.dq) / robot.dq_max, "acceleration": np.abs(motion.ddq) / robot.ddq_max}
    peak = {k: x.max(0).tolist() for k, x in share.items()}
    words = ", ".join(f"{k} up to {100 * max(x):.0f} %" for k, x in peak.items())
    lines = [
        f"{motion.t[-1]:.1f} s; {words} of the limits. Move the arm to the first row before.",
        "excitation.csv holds t, q, dq, ddq of every millisecond, trajectory.yaml the same as a JointTrajectory.",
    ]
    console.print(lines[0], highlight=False)
    picture = motion_figure(run.figure("motion"), robot, motion)
    sections = {"A motion worth recording": [*lines, picture], f"{WIDTHS} ({LEGEND})": [table]}
    report_markdown(run.folder / "report.md", sections)  # type: ignore[arg-type]
    write_recording(run.folder / "recording.rrd", robot, Content(figures={"motion": picture}))
    rows = zip(design.space.names, design.width.tolist(), design.identifiable.tolist(), strict=True)
    expected = {name: {"width": width, "identifiable": known} for name, width, known in rows}
    return {"seconds": float(motion.t[-1]), "peak_share": peak, "expected_width95": expected}


def motion_figure(path: Any, robot: Robot, motion: Excitation) -> Any:
    """Draw joint angles with their limits, and joint velocities, over time."""
    some = thin(len(motion.t))
    low, high = robot.q_range
    with joint_panels(path, robot.n, "planned motion") as axes:
        for j, axis in enumerate(axes):
            axis.plot(motion.t[some], motion.q[some, j], color="#1f77b4", linewidth=1.2, label="angle, rad")
            axis.plot(motion.t[some], motion.dq[some, j], color="#ff7f0e", linewidth=0.7, label="velocity, rad/s")
            for limit in (low[j], high[j]):
                axis.axhline(limit, color="#d62728", linewidth=0.8, linestyle=":", label="limit of the angle")
            axis.set_title(f"joint {j + 1}", loc="left")
            axis.set(xlabel="time, s", ylabel="rad, rad/s", xlim=(0, motion.t[-1]))
    return path
