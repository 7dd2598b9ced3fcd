"""Lay out a recording in the Rerun viewer: tabs for arms, learning curves, each torque overlay and each figure."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from r2s.physics.robot import Robot
from r2s.reporting.figures.log_rows import without_pauses
from r2s.reporting.viewer.data import Content, Episode
from r2s.tasks.measures import Measure, MeasureTable

PAUSE = 0.5  # s between two episodes
SPACING = 0.95  # m between two arms, more than a Panda's reach of 0.855 m
LEARNING = "learning"
OVERLAY_OPENS = 15.0  # s, time range that a plot first shows; over a longer range, lines look like a solid band
LINE = 1.6  # points, width of a line


def entity(*parts: str) -> str:
    """Return the path of a Rerun entity from its `parts`."""
    return rr.new_entity_path(list(parts))


def rgb(colour: str) -> np.ndarray:
    """Return red, green and blue (3,) of "#rrggbb", each from 0 to 255."""
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])


def log_series(
    stream: rr.RecordingStream,
    path: str,
    index: Sequence[rr.TimeColumn],
    values: np.ndarray,
    name: str,
    colour: str,
    width: float = LINE,
) -> None:
    """Log one line of a plot at the entity path `path`; a nan in `values` interrupts the line."""
    stream.log(path, rr.SeriesLines(names=name, colors=rgb(colour), widths=width), static=True)
    stream.send_columns(path, indexes=index, columns=rr.Scalars.columns(scalars=values))


def starts_of(episodes: Mapping[str, Sequence[Episode]]) -> np.ndarray:
    """Return the start times of K episodes, equal for all arms, and the end time of the last episode: (K + 1,) s."""
    count = max((len(sequence) for sequence in episodes.values()), default=0)
    longest = [max(s[k].duration for s in episodes.values() if k < len(s)) + PAUSE for k in range(count)]
    return np.concatenate([[0.0], np.cumsum(longest)])


def blueprint(robot: Robot, content: Content) -> rrb.Blueprint:
    """Return the Rerun viewer's layout for `content`: tabs and the time panel."""
    joints = [f"joint {j + 1}" for j in range(robot.n)]
    episodes, overlays, figures = content.episodes, content.overlays, content.figures
    tabs: list[rrb.View | rrb.Container] = []
    if episodes and content.measures:
        tabs.append(_arms_tab(len(episodes), joints, float(starts_of(episodes)[-1]), content.measures))
    if content.curves:
        tabs.append(_learning_tab(content.learning, LEARNING in figures))
    for label, overlay in overlays.items():
        until = min(OVERLAY_OPENS, float(without_pauses(overlay.t)[0][-1]))
        views = _plots({f"{joint}, Nm": entity("torque", label, joint) for joint in joints}, until=until)
        tabs.append(rrb.Grid(*views, grid_columns=2, name=f"torque: {label}"))
    tabs += [_picture(name, name) for name in figures if not (content.curves and name == LEARNING)]
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


def _learning_tab(curves: Iterable[Measure], pictured: bool) -> rrb.Container:
    """Return a tab of learning curves: plots over env_steps or wall_clock and, if `pictured`, their figure."""
    plots = _plots({m.heading: entity(LEARNING, m.title) for m in curves}, rrb.Corner2D.RightBottom)
    live = rrb.Grid(*plots, grid_columns=3, name="plots: select the timeline env_steps or wall_clock below")
    return rrb.Tabs(*[_picture(LEARNING, "figure")] * pictured, live, active_tab=0, name="learning")


def _arms_tab(count: int, joints: Sequence[str], seconds: float, measures: MeasureTable) -> rrb.Container:
    """Return a tab with the 3D view left of the plots or, with four arms or more, above the plots."""
    width = SPACING * count
    away = 0.3 + 0.4 * width if count > 3 else max(1.5, 0.4 + 0.85 * width)
    eye = rrb.EyeControls3D(position=[away, -0.2 * away, 0.5 + 0.3 * away], look_target=[0.15, 0, 0.48])
    scene = rrb.Spatial3DView(origin="arms", name="arms", eye_controls=eye)
    error, most = measures.error, measures.error_levels[0]
    distance = _plot(error.heading, "distance", rrb.Corner2D.RightTop, until=seconds)
    near = _plot(f"the last {most:g} {error.unit}", "distance", y=(0.0, most), until=seconds)
    torques = [_plot(f"{joint}, Nm", entity("command", joint), until=seconds) for joint in joints]
    commands = rrb.Tabs(*torques, name="command")
    if count > 3:
        return rrb.Vertical(scene, rrb.Horizontal(distance, near, commands), row_shares=[3, 2], name="arms")
    return rrb.Horizontal(scene, rrb.Vertical(distance, near, commands), column_shares=[3, 2], name="arms")


def _plots(
    origins: Mapping[str, str], corner: rrb.Corner2D = rrb.Corner2D.RightTop, until: float | None = None
) -> list[rrb.View]:
    """Return a plot for each {title: entity path}; only the first plot has a legend."""
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
    """Return a plot that initially shows 0 to `until` s of the timeline, or the whole timeline if `until` is None."""
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
