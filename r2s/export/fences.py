"""Check start, goal and plan of a motion, run the policy in a thread, and bring the arm to rest after a signal.

`r2s export` copies this module into the bundle. On an arm in real time, the policy runs in a thread, because the arm
cannot wait for the policy.
"""

import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from r2s.export.law import BundleError, Model

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")  # Ctrl-C, kill, a closed terminal, Ctrl-\, Ctrl-Z
POLL_S = 1e-4  # s, interval at which the policy's thread looks for a new observation: a tenth of a cycle
ROUNDING_M = 1e-6  # m, tolerance at the border of the goal region
AGREE_M = 1e-3  # m, allowed distance between a position in a plan and the position that the plan's joint angles reach


def outside(trained: dict[str, Any], point: np.ndarray) -> str | None:
    """Return why a goal (3,) m is outside the region of the training's goals, or None if the goal is inside."""
    if not np.isfinite(point).all():
        return "the goal is not finite"
    away, azimuth = np.linalg.norm(point - np.array(trained["shoulder_m"])), abs(np.arctan2(point[1], point[0]))
    low, high = trained["shoulder_distance_m"]
    if not low - ROUNDING_M <= away <= high + ROUNDING_M:
        return f"the goal is {away:.3f} m from the shoulder; the training had {low:.3f} to {high:.3f} m"
    if point[2] < trained["lowest_m"] - ROUNDING_M:
        return f"the goal is at a height of {point[2]:.3f} m; the training had {trained['lowest_m']:g} m and more"
    if azimuth > trained["azimuth_rad"] + ROUNDING_M:
        return f"the goal is {azimuth:.2f} rad to the side; the training had up to {trained['azimuth_rad']:g} rad"
    return None


def check_start(start: dict[str, Any], home: np.ndarray, q: np.ndarray, dq: np.ndarray) -> None:
    """Raise BundleError unless the arm rests near `home` (n,) rad, as the contract's entry `start` requires."""
    if not (np.isfinite(q).all() and np.isfinite(dq).all()):
        raise BundleError("the arm's state is not finite")
    if start["within_rad"] is not None and (far := np.abs(q - home)).max() > start["within_rad"]:
        j = int(far.argmax())
        raise BundleError(
            f"joint {j + 1} is at {q[j]:.3f} rad; motions begin within {start['within_rad']:g} rad of {home[j]:.3f}"
        )
    if (speed := np.abs(dq)).max() > start["fastest_rad_per_s"]:
        j = int(speed.argmax())
        raise BundleError(f"joint {j + 1} moves at {dq[j]:.3f} rad/s; motions begin at rest")


def check_plan(contract: dict[str, Any], model: Model, plan: np.ndarray) -> None:
    """Raise BundleError if a plan violates an arm limit, leaves the training's region or is for a different arm."""
    at, own = contract["goal"]["columns"], contract["law"]["joint"]
    place, q, dq = (plan[:, slice(*at[name])] for name in ("place", "q", "dq"))
    low, high, most = (np.array([s if v is None else v for v in own[k]]) for k, s in BOUNDS.items())
    for values, beyond, unit in ((q, (q < low) | (q > high), "rad"), (dq, np.abs(dq) > most, "rad/s")):
        if beyond.any():
            row, j = np.argwhere(beyond)[0]
            raise BundleError(
                f"row {row} of the plan: joint {j + 1} at {values[row, j]:.3f} {unit} is beyond its limit"
            )
    for row in range(len(plan)):
        if why := outside(contract["goal"]["trained"], place[row]):
            raise BundleError(f"row {row} of the plan: {why}")
        model.place(q[row])
        if (off := np.abs(model.hand()[0] - place[row]).max()) > AGREE_M:
            raise BundleError(f"row {row} of the plan is {1e3 * off:.1f} mm from where its joint angles take the arm")


BOUNDS = {"q_stop_low": -np.inf, "q_stop_high": np.inf, "dq_stop": np.inf}  # limit in the contract: value if null


class PolicyThread:
    """A thread that computes the actions, so that the 1 kHz loop does not wait for the policy.

    Args:
        act: function that maps an observation to an action.
    """

    def __init__(self, act: Callable[[np.ndarray], np.ndarray]):
        self._act = act
        self._seen: deque[tuple] = deque(maxlen=1)  # append replaces an old item; append and pop are atomic
        self._made: deque[tuple] = deque(maxlen=1)
        threading.Thread(target=self._run, daemon=True).start()

    def give(self, motion: int, seen: np.ndarray, setpoint: np.ndarray) -> None:
        """Pass an observation of motion number `motion`, with its setpoint, to the policy."""
        self._seen.append((motion, seen, setpoint))

    def newest(self, motion: int) -> np.ndarray | None:
        """Return the newest command of motion number `motion`, or None if there is no new command."""
        try:
            of, command = self._made.pop()
        except IndexError:
            return None
        return command if of == motion else None

    def _run(self) -> None:
        while True:
            try:
                motion, seen, setpoint = self._seen.pop()
            except IndexError:
                time.sleep(POLL_S)
                continue
            try:
                self._made.append((motion, np.concatenate([self._act(seen), setpoint])))
            except Exception:  # the driver stops the arm if no command arrives
                continue


@contextmanager
def stopped_by_signals(runtime: Any) -> Iterator[None]:
    """On a signal in SIGNALS, bring the arm to rest instead of ending the program; call only in the main thread."""

    def stop(number: int, frame: Any) -> None:
        runtime.stop(signal.Signals(number).name)

    before = {name: signal.signal(getattr(signal, name), stop) for name in SIGNALS if hasattr(signal, name)}
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(getattr(signal, name), handler)
