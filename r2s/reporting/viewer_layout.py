"""The layout of a rerun recording: a tab of arms, one of learning curves, one per overlay and one per figure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from r2s.physics.robot import Robot
from r2s.reporting.log_rows import without_pauses

PAUSE = 0.5  # s between two episodes
SPACING = 0.95  # m between two arms
LEARNING = "learning"
CURVES = {
    "success_5cm": "success at 5 cm",
    "success_2cm": "success at 2 cm",
    "success_1cm": "success at 1 cm",
    "success_5mm": "success at 5 mm",
    "distance_median_m": "median distance, m",
    "return_paper": "return (paper)",
    "path_rmse_mm": "RMSE of the path, mm",
    "path_max_mm": "largest error, mm",
    "within_5mm": "time within 5 mm",
    "return_track": "return",
}
OVERLAY_OPENS = 15.0  # s of an overlay that its plots open on: more is a solid band


@dataclass(frozen=True)
class Episode:
    """One episode of one arm, simulated or real; positions are in the base frame of the arm."""

    t: np.ndarray
    """(T,) s."""
    q: np.ndarray
    """(T, n) rad."""
    ee: np.ndarray
    """(T, 3) m."""
    goal: np.ndarray
    """(3,) m, or (T, 3) where it moves."""
    tau: np.ndarray
    """(T, n) Nm, the command."""

    @property
    def distance(self) -> np.ndarray:
        """(T,) m from the end effector to the goal, or to where it is at that time."""
        return np.linalg.norm(self.ee - self.goal, axis=-1)

    @property
    def duration(self) -> float:
        """Seconds from the first row to the last."""
        return float(self.t[-1] - self.t[0])


@dataclass(frozen=True)
class Overlay:
    """Real against simulated torque: t (T,) s, measured (T, n) Nm, predicted {label: (T, n) Nm}."""

    t: np.ndarray
    measured: np.ndarray
    predicted: dict[str, np.ndarray]


def entity(*parts: str) -> str:
    """Return the path of an entity of the recording."""
    return rr.new_entity_path(list(parts))


def starts_of(episodes: Mapping[str, Sequence[Episode]]) -> np.ndarray:
    """(K + 1,) s on the timeline: where the k-th episodes begin, and the end of the last."""
    count = max((len(sequence) for sequence in episodes.values()), default=0)
    longest = [max(s[k].duration for s in episodes.values() if k < len(s)) + PAUSE for k in range(count)]
    return np.concatenate([[0.0], np.cumsum(longest)])


def blueprint(
    robot: Robot,
    episodes: Mapping[str, Sequence[Episode]],
    overlays: Mapping[str, Overlay],
    curves: Mapping[str, pd.DataFrame],
    figures: Mapping[str, Path],
) -> rrb.Blueprint:
    """Lay out a tab of arms, one of learning curves, one per overlay and one per figure."""
    joints = [f"joint {j + 1}" for j in range(robot.n)]
    tabs: list[rrb.View | rrb.Container] = []
    if episodes:
        moving = any(e.goal.ndim == 2 for sequence in episodes.values() for e in sequence)
        tabs.append(_arms_tab(len(episodes), joints, float(starts_of(episodes)[-1]), moving))
    if curves:
        tabs.append(_learning_tab(curves, LEARNING in figures))
    for label, overlay in overlays.items():
        until = min(OVERLAY_OPENS, float(without_pauses(overlay.t)[0][-1]))
        views = _plots({f"{joint}, Nm": entity("torque", label, joint) for joint in joints}, until=until)
        tabs.append(rrb.Grid(*views, grid_columns=2, name=f"torque: {label}"))
    tabs += [_picture(name, name) for name in figures if not (curves and name == LEARNING)]
    time_panel = rrb.TimePanel(
        state="collapsed",
        timeline="time" if episodes or overlays else "env_steps",
        play_state="playing" if episodes else "paused",
        loop_mode="selection" if episodes else "off",
        time_selection=_selection(starts_of(episodes)[-1]) if episodes else None,
    )
    sides = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
    return rrb.Blueprint(rrb.Tabs(*tabs, active_tab=0), *sides, time_panel)


def _selection(seconds: float) -> rrb.components.AbsoluteTimeRange:
    low, high = (rr.encodings.TimeInt(seconds=s) for s in (0.0, float(seconds)))
    return rrb.components.AbsoluteTimeRange(min=low, max=high)


def _picture(name: str, title: str) -> rrb.View:
    return rrb.Spatial2DView(origin=entity("figures", name), name=title)


def _learning_tab(curves: Mapping[str, pd.DataFrame], pictured: bool) -> rrb.Container:
    """Return the live plots, empty while the timeline is `time`, behind the figure if there is one."""
    titles = [CURVES[c] for c in CURVES if any(c in table for table in curves.values())]
    plots = _plots({title: entity(LEARNING, title) for title in titles}, rrb.Corner2D.RightBottom)
    live = rrb.Grid(*plots, grid_columns=3, name="live: pick the timeline env_steps or wall_clock below")
    first = [_picture(LEARNING, "figure")] if pictured else []
    return rrb.Tabs(*first, live, active_tab=0, name="learning")


def _arms_tab(count: int, joints: Sequence[str], seconds: float, moving: bool) -> rrb.Container:
    """Return the 3D view beside its plots; from four arms on, above them."""
    width = SPACING * count
    away = 0.3 + 0.4 * width if count > 3 else max(1.5, 0.4 + 0.85 * width)
    eye = rrb.EyeControls3D(position=[away, -0.2 * away, 0.5 + 0.3 * away], look_target=[0.15, 0, 0.48])
    scene = rrb.Spatial3DView(origin="arms", name="arms", eye_controls=eye)
    title, near_title, most = ("error of the path, cm", "the last 1 cm", 1.0) if moving else ("", "", 5.0)
    distance = _plot(title or "distance to goal, cm", "distance", rrb.Corner2D.RightTop, until=seconds)
    near = _plot(near_title or "the last 5 cm", "distance", y=(0.0, most), until=seconds)
    torques = [_plot(f"{joint}, Nm", entity("command", joint), until=seconds) for joint in joints]
    commands = rrb.Tabs(*torques, name="command")
    if count > 3:
        return rrb.Vertical(scene, rrb.Horizontal(distance, near, commands), row_shares=[3, 2], name="arms")
    return rrb.Horizontal(scene, rrb.Vertical(distance, near, commands), column_shares=[3, 2], name="arms")


def _plots(
    origins: Mapping[str, str], corner: rrb.Corner2D = rrb.Corner2D.RightTop, until: float | None = None
) -> list[rrb.View]:
    """Return a plot per {title: origin}; only the first has the legend."""
    corners = [corner, *[None] * len(origins)]
    return [_plot(*origin, legend, until=until) for origin, legend in zip(origins.items(), corners, strict=False)]


def _plot(
    title: str,
    origin: str,
    legend: rrb.Corner2D | None = None,
    *,
    y: tuple[float, float] | None = None,
    until: float | None = None,
) -> rrb.View:
    """Return a plot; with `until` it opens on that many seconds, else on everything."""
    edge = rrb.TimeRangeBoundary
    ends = (edge.infinite(), edge.infinite())
    if until is not None:
        ends = (edge.absolute(seconds=0.0), edge.absolute(seconds=until))
    return rrb.TimeSeriesView(
        origin=origin,
        name=title,
        plot_legend=rrb.PlotLegend(legend, visible=legend is not None),
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(*ends)),
        axis_y=rrb.ScalarAxis(range=y, zoom_lock=True) if y else None,
    )
