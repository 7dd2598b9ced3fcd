"""Define the content of a recording for the Rerun viewer: episodes, torques, learning curves, figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from r2s.recordings.recording import Recording
from r2s.tasks.measures import Measure, MeasureTable

if TYPE_CHECKING:
    from r2s.tasks.rollout import Episodes  # imports torch, which an identification does not need

SHOWN = 4  # episodes in a Rerun recording or figure, as in the paper's figures


@dataclass(frozen=True)
class Episode:
    """One episode of one arm; positions are in the arm's base frame.

    Attributes:
        t: (T,) s, time. q: (T, n) rad, joint angles. ee: (T, 3) m, end effector. tau: (T, n) Nm, commanded torque.
        goal: (3,) m, or (T, 3) m on a path. box: (T, 11), rows of `Task.boxes`, or None without a pushed box.
    """

    t: np.ndarray
    q: np.ndarray
    ee: np.ndarray
    goal: np.ndarray
    tau: np.ndarray
    box: np.ndarray | None = None

    @property
    def moves(self) -> bool:
        """Whether the goal moves along a path."""
        return self.goal.ndim == 2

    @property
    def distance(self) -> np.ndarray:
        """Distance (T,) m of the end effector, or of a pushed box, from the goal or from the current path point."""
        return np.linalg.norm((self.ee if self.box is None else self.box[:, :3]) - self.goal, axis=-1)

    @property
    def duration(self) -> float:
        """Time, s, from the first row to the last row of the episode."""
        return float(self.t[-1] - self.t[0])


@dataclass(frozen=True)
class Overlay:
    """Torque over time t (T,) s: measured (T, n) Nm, and predicted {label: (T, n) Nm}."""

    t: np.ndarray
    measured: np.ndarray
    predicted: dict[str, np.ndarray]

    @classmethod
    def load(cls, run: Path) -> "Overlay":
        """Return the torque that stage=identify saved in its run folder as torque.npz."""
        with np.load(run / "torque.npz", allow_pickle=False) as saved:
            return cls(saved["t"], saved["measured"], {k: saved[k] for k in ("nominal", "identified")})


@dataclass(frozen=True)
class Content:
    """Content of a Rerun recording; the viewer shows a tab only for content that is not empty.

    Attributes:
        measures: the task's measures; `episodes` and `curves` need them.
        episodes: {label: episodes}, one arm per label; the k-th episodes of all arms start at the same time.
        overlays: {label: Overlay}; the viewer shows each overlay as a tab of torque plots.
        curves: {run: evaluations.csv}; all curves share one tab.
        figures: {name: PNG}; each figure has its own tab, except "learning", which is in the tab of the curves.
        torque: (n,) Nm, limits that the plots of commanded torque show.
    """

    measures: MeasureTable | None = None
    episodes: Mapping[str, Sequence[Episode]] = field(default_factory=dict)
    overlays: Mapping[str, Overlay] = field(default_factory=dict)
    curves: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    figures: Mapping[str, Path] = field(default_factory=dict)
    torque: np.ndarray | None = None

    @property
    def learning(self) -> list[Measure]:
        """The task's measures for learning curves and comparisons that are columns of a table in `curves`."""
        table = self.measures
        if table is None:
            return []
        keys = dict.fromkeys((*table.curves, *table.comparison))
        return [table[key] for key in keys if any(key in curve for curve in self.curves.values())]


def external_overlay(r: Recording) -> dict[str, Overlay]:
    """Return {label: overlay of external torque and reported contact (0 or 1)}, or {} without external torque."""
    torque = r.signals.get("tau_ext_hat_filtered")
    if torque is None or not torque.any():
        return {}
    contact = r.signals.get("joint_contact", np.zeros_like(torque))
    return {"external, and contact": Overlay(r.t, torque, {"contact": (contact > 0).astype(float)})}


def first(e: "Episodes") -> list[Episode]:
    """Return the first `SHOWN` of the episodes `e`, each as an `Episode`."""
    boxes = [None] * len(e.goal) if e.box is None else e.box
    return [Episode(e.t, e.q[i], e.ee[i], e.goal[i], e.tau[i], boxes[i]) for i in range(min(SHOWN, len(e.goal)))]


def saved_episodes(run: Path) -> dict[str, list[Episode]]:
    """Return {simulator or arm: first episodes} of a run folder; {} if the run saved no episodes."""
    from r2s.tasks.rollout import Episodes

    out = {}
    for path in sorted(run.glob("episodes_*.npz")):
        with np.load(path, allow_pickle=False) as saved:
            out[path.stem.removeprefix("episodes_")] = first(Episodes(**saved))
    return out
