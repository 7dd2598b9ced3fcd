"""Figures of episodes: the way to the goal, reward and torque over time, latencies."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from r2s.reporting.colours import OTHERS, colours
from r2s.reporting.figures import log_axis, panels
from r2s.reporting.viewer_layout import Episode
from r2s.tasks.episode import Episodes


def reach_figure(path: Path, episodes: Mapping[str, Sequence[Episode]]) -> Path:
    """Draw the distance to up to four goals, or from as many paths, over time, one line per label."""
    colour = colours(episodes)
    count = max(1, min(4, max((len(e) for e in episodes.values()), default=0)))
    moving = any(e.goal.ndim == 2 for sequence in episodes.values() for e in sequence)
    title, scale, unit, levels = "distance to the goal", 100, "cm", (5, 2, 1)
    if moving:
        title, scale, unit, levels = "error of the path", 1000, "mm", (10, 5, 2)
    with panels(path, count, min(count, 2), title, height=3.0) as axes:
        for k, axis in enumerate(axes):
            shown = {label: sequence[k] for label, sequence in episodes.items() if k < len(sequence)}
            for label, episode in shown.items():
                distance = scale * np.maximum(episode.distance, 1e-5)
                axis.plot(episode.t - episode.t[0], distance, color=colour[label], label=label)
            for level in levels:
                axis.axhline(level, color="#555555", linewidth=0.7, linestyle=":")
            log_axis(axis)
            if moving:
                axis.set_title(f"path {k + 1}", loc="left")
                axis.set(xlabel="time, s", ylabel=f"error, {unit}")
                continue
            goal = next((f" at ({', '.join(f'{x:.2f}' for x in e.goal)}) m" for e in shown.values()), "")
            axis.set_title(f"goal {k + 1}{goal}", loc="left")
            axis.set(xlabel="time, s", ylabel=f"distance, {unit}")
    return path


def traces_figure(path: Path, episodes: Mapping[str, Episodes], goals: int = 4) -> Path:
    """Draw the reward, of reaching eq. (2), and the torque of joints 1 and 2 over time: a column per goal."""
    colour = colours(episodes)
    count = min(goals, *(len(e.goal) for e in episodes.values()))
    n = next(iter(episodes.values())).q.shape[-1]
    moving = next(iter(episodes.values())).goal.ndim == 3
    rows = ["reward" if moving else "reward, eq. (2)", *(f"torque of joint {j + 1}, Nm" for j in range(min(2, n)))]
    with panels(
        path, len(rows) * count, count, f"the same policy and {'paths' if moving else 'goals'}", height=2.4
    ) as axes:
        for i, name in enumerate(rows):
            for k in range(count):
                axis = axes[i * count + k]
                for label, e in episodes.items():
                    axis.plot(e.t, e.tau[k, :, i - 1] if i else e.reward[k], color=colour[label], label=label, lw=1.2)
                axis.set(xlabel="time, s" if i == len(rows) - 1 else "", ylabel=name if k == 0 else "")
                if i == 0:
                    axis.set_title(f"{'path' if moving else 'goal'} {k + 1}", loc="left")
    return path


def latency_figure(path: Path, seconds: Mapping[str, Sequence[float]]) -> Path:
    """Draw how often what took how long, {what: s}, each over its own milliseconds; the count is logarithmic."""
    there = {what: 1e3 * np.array(values) for what, values in seconds.items() if len(values)}
    with panels(path, len(there), len(there), "on the clock of this computer", height=2.4) as axes:
        for axis, (what, ms) in zip(axes, there.items(), strict=True):
            axis.hist(
                ms, bins=np.geomspace(max(ms.min(), 1e-4), 1.01 * ms.max() + 1e-4, 60).tolist(), color=OTHERS[0]
            )
            axis.set(xscale="log", yscale="log", xlabel="ms", ylabel="count")
            axis.set_title(f"{what}: median {np.median(ms):.2g}, 99 % {np.percentile(ms, 99):.2g} ms", loc="left")
    return path
