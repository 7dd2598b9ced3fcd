"""Draw figures of episodes: error, reward and torque over time, and latencies."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from r2s.reporting.figures.colours import OTHERS, colours
from r2s.reporting.figures.panels import log_axis, panels
from r2s.reporting.viewer.layout import Episode
from r2s.tasks.measures import MeasureTable
from r2s.tasks.rollout import Episodes

SHOWN = 4  # largest number of goals in a figure, as in the paper


def error_figure(path: Path, episodes: Mapping[str, Sequence[Episode]], measures: MeasureTable) -> Path:
    """Draw the error over time for up to `SHOWN` goals or paths, one line per label."""
    colour, error = colours(episodes), measures.error
    count = max(1, min(SHOWN, max((len(e) for e in episodes.values()), default=0)))
    with panels(path, count, min(count, 2), error.title, height=3.0) as axes:
        for k, axis in enumerate(axes):
            shown = {label: sequence[k] for label, sequence in episodes.items() if k < len(sequence)}
            for label, episode in shown.items():
                distance = error.scale * np.maximum(episode.distance, 1e-5)
                axis.plot(episode.t - episode.t[0], distance, color=colour[label], label=label)
            for level in measures.error_levels:
                axis.axhline(level, color="#555555", linewidth=0.7, linestyle=":")
            log_axis(axis)
            goal = next((e.goal for e in shown.values()), np.zeros((0, 3)))
            at = f"goal {k + 1} at ({', '.join(f'{x:.2f}' for x in goal)}) m" if goal.ndim == 1 else f"path {k + 1}"
            axis.set_title(at, loc="left")
            axis.set(xlabel="time, s", ylabel=error.column)
    return path


def traces_figure(path: Path, episodes: Mapping[str, Episodes], reward: str) -> Path:
    """Draw the `reward` and the torque of joints 1 and 2 over time, one column per goal."""
    colour, first = colours(episodes), next(iter(episodes.values()))
    count = min(SHOWN, *(len(e.goal) for e in episodes.values()))
    goal = "path" if first.goal.ndim == 3 else "goal"
    rows = [reward, *(f"torque of joint {j + 1}, Nm" for j in range(min(2, first.q.shape[-1])))]
    with panels(path, len(rows) * count, count, f"reward and torque: same policy, same {goal}s", 2.4) as axes:
        for i, name in enumerate(rows):
            for k in range(count):
                axis = axes[i * count + k]
                for label, e in episodes.items():
                    axis.plot(e.t, e.tau[k, :, i - 1] if i else e.reward[k], color=colour[label], label=label, lw=1.2)
                axis.set(xlabel="time, s" if i == len(rows) - 1 else "", ylabel=name if k == 0 else "")
                if i == 0:
                    axis.set_title(f"{goal} {k + 1}", loc="left")
    return path


def latency_figure(path: Path, seconds: Mapping[str, Sequence[float]]) -> Path:
    """For each entry of {name: latencies, s}, draw a histogram in ms with logarithmic axes."""
    present = {name: 1e3 * np.array(values) for name, values in seconds.items() if len(values)}
    with panels(path, len(present), len(present), "latencies on this computer", height=2.4) as axes:
        for axis, (name, ms) in zip(axes, present.items(), strict=True):
            bins = np.geomspace(max(ms.min(), 1e-4), 1.01 * ms.max() + 1e-4, 60).tolist()
            axis.hist(ms, bins=bins, color=OTHERS[0])
            axis.set(xscale="log", yscale="log", xlabel="ms", ylabel="count")
            axis.set_title(f"{name}: median {np.median(ms):.2g}, 99 % {np.percentile(ms, 99):.2g} ms", loc="left")
    return path
