"""Repair log faults that have only one remedy: swapped rows, repeats, zero stamps, wrapped or misread angles.

Every repair adds a line to the notes of the recording. A fault with several possible remedies is not repaired:
`Recording` or the checks of an identification report it.
"""

from itertools import pairwise

import numpy as np

Arrays = dict[str, np.ndarray]  # t (T,), trajectory (T,), q, dq, tau (T, n)

MOST_SWAPPED = 10  # rows; a row that is farther out of place indicates two interleaved logs
JUMP, JUMPS, FASTEST = 0.05, 20, 10.0  # rad, median steps, rad/s: a misread q jumps by more than each limit, and back
AWAY, MOST_FAILED = 10, 0.01  # largest number of successive rows, and share of all rows, with misread q
FIRST_STEP = 100  # median steps; zero stamps are dropped only if the first valid stamp is larger than this
REVOLUTION, NEAR = 2 * np.pi, 0.5  # rad; at a wrap, q jumps by a revolution, plus or minus a motion below NEAR
SLACK = 0.05  # rad by which a logged angle may exceed a joint limit
LEAST_HELD = 2.0  # rows, least median length of a hold: a run of rows with equal values
REGULAR = 0.8  # least share of holds whose length is near the median; with a coarse encoder, lengths vary
MOVES = 0.2  # rad, least motion of a log in which holds are removed


def repair_rows(arrays: Arrays) -> tuple[Arrays, list[str]]:
    """Sort rows by time; drop rows that are repeated, misread, incomplete or at time 0; return a note per repair."""
    notes: list[str] = []
    whole = all(x.dtype.kind in "iuf" and len(x) == len(arrays["t"]) for x in arrays.values())
    if not whole or arrays["t"].ndim != 1 or len(arrays["t"]) < 3:
        return arrays, notes
    if not all(np.isfinite(x[-1]).all() for x in arrays.values()):
        arrays = {k: x[:-1] for k, x in arrays.items()}
        notes.append("the last row is incomplete and left out")
    t, zeros = arrays["t"], int(np.argmax(arrays["t"] != 0))
    usual = float(np.median(np.diff(t[zeros:]))) if len(t) > zeros + 1 else 0.0
    if zeros and t[zeros] > FIRST_STEP * usual > 0:
        arrays = {k: x[zeros:] for k, x in arrays.items()}
        notes.append(f"{zeros} rows with time 0 before the first stamp are left out")
    order = _order(arrays)
    if order is not None:
        arrays = {k: x[order] for k, x in arrays.items()}
        notes.append(f"{int((order != np.arange(len(order))).sum())} rows out of order are sorted by time")
    same = np.zeros(len(arrays["t"]), dtype=bool)
    same[1:] = np.all([np.reshape(x[1:] == x[:-1], (len(x) - 1, -1)).all(1) for x in arrays.values()], axis=0)
    if same.any():
        arrays = {k: x[~same] for k, x in arrays.items()}
        notes.append(f"{int(same.sum())} repeated rows are left out")
    away = _failed(arrays["t"], arrays["q"]) if arrays["q"].ndim == 2 else np.zeros(0, dtype=bool)
    if away.any():
        arrays = {k: x[~away] for k, x in arrays.items()}
        notes.append(f"{int(away.sum())} rows in which q jumps away and back are left out (row {int(away.argmax())})")
    return arrays, notes


def _failed(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of the rows with misread q: a joint's angle jumps, and jumps back within AWAY rows."""
    out, fast = np.zeros(len(q), dtype=bool), FASTEST * np.maximum(np.diff(t), 0.0)
    for x in q.T:  # one joint at a time saves memory in a long log
        step = np.abs(np.diff(x))
        least = max(JUMP, JUMPS * float(np.median(step)))
        for first, back in pairwise((np.flatnonzero(step > np.maximum(least, fast)) + 1).tolist()):
            wrapped = abs(step[first - 1] - REVOLUTION) < NEAR
            if not wrapped and back - first <= AWAY and abs(x[back] - x[first - 1]) < least:
                out[first:back] = True
    return out if out.mean() < MOST_FAILED else np.zeros(len(q), dtype=bool)


def _order(arrays: Arrays) -> np.ndarray | None:
    """Return row indices (T,) that sort trajectories by time; None if rows are in order or too far out of order."""
    t, index = arrays["t"], arrays.get("trajectory", np.zeros(len(arrays["t"])))
    run = np.concatenate([[0], np.cumsum(np.diff(index) != 0)])
    if not np.any((np.diff(t) < 0) & (np.diff(run) == 0)):
        return None
    order = np.lexsort((np.arange(len(t)), t, run))
    return order if np.abs(order - np.arange(len(t))).max() <= MOST_SWAPPED else None


def unwrap(arrays: Arrays, limits: tuple[np.ndarray, np.ndarray] | None = None) -> tuple[Arrays, list[str]]:
    """Remove jumps of q by a full revolution within a trajectory; return the arrays and a list of notes on repairs.

    limits: (low, high) joint limits, (n,) rad each; angles outside are shifted inside by full revolutions, if
    possible.
    """
    q, index = arrays["q"], arrays.get("trajectory")
    if q.ndim != 2 or q.dtype.kind not in "iuf" or len(q) != len(arrays["t"]):
        return arrays, []
    jumps = [np.flatnonzero(np.abs(np.abs(np.diff(x)) - REVOLUTION) < NEAR) for x in q.T]
    if index is not None:
        jumps = [at[index[at + 1] == index[at]] for at in jumps]
    notes = []
    if any(len(at) for at in jumps):
        q = q.copy()
        for x, at in zip(q.T, jumps, strict=True):
            signs = np.sign(x[at + 1] - x[at])
            for k, sign in zip(at, signs, strict=True):
                end = len(x) if index is None else k + 1 + int(np.argmax(np.append(index[k + 1 :] != index[k], True)))
                x[k + 1 : end] -= sign * REVOLUTION
        joints = ", ".join(str(j + 1) for j, at in enumerate(jumps) if len(at))
        count = sum(len(at) for at in jumps)
        notes.append(f"q of joint {joints} jumps by a turn {count} times and is continued beyond it")
    if limits is not None and limits[0].shape == q.shape[1:]:
        q, turned = _into(q, np.zeros(len(q)) if index is None else index, *limits)
        joints = ", ".join(str(j + 1) for j in turned)
        notes += [f"q of joint {joints} is turned into the limits of the robot"] if turned else []
    return (arrays | {"q": q} if notes else arrays), notes


def _into(q: np.ndarray, index: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Shift trajectories by full revolutions into the limits; return q (T, n) and the indices of shifted joints."""
    if (q.min(0) >= low - SLACK).all() and (q.max(0) <= high + SLACK).all():
        return q, []
    out, turned = q.copy(), set()
    for label in np.unique(index):
        rows = index == label
        least, most = q[rows].min(0), q[rows].max(0)
        for j in np.flatnonzero((least < low - SLACK) | (most > high + SLACK)).tolist():
            for k in range(-3, 4):
                if least[j] + REVOLUTION * k >= low[j] - SLACK and most[j] + REVOLUTION * k <= high[j] + SLACK:
                    out[rows, j] += REVOLUTION * k
                    turned.add(j)
                    break
    return out, sorted(turned)


def held(t: np.ndarray, q: np.ndarray, dq: np.ndarray, stretches: list[slice]) -> np.ndarray | None:
    """Return a mask (T,) of the rows with new values, or None if the log does not repeat each value in several rows.

    For example, a log at 1 kHz may contain each value of a 30 Hz sensor in about 33 rows while the arm moves.
    """
    new = np.ones(len(t), dtype=bool)
    lengths, moved = [], 0.0
    for s in stretches:
        change = (q[s][1:] != q[s][:-1]).any(1) | (dq[s][1:] != dq[s][:-1]).any(1)
        new[s] = np.concatenate([[True], change])
        if 1.5 * new[s].sum() * LEAST_HELD > 2 * len(change):  # most rows have new values
            return None
        at = np.flatnonzero(new[s])
        travel = np.abs(np.diff(q[s][at], axis=0)).max(1, initial=0.0)
        fast = travel > 0.1 * travel.max(initial=0.0)
        lengths.append(np.diff(at)[fast])
        moved += float(travel.sum())
    length = np.concatenate(lengths) if lengths else np.empty(0)
    if len(length) < 10 or moved < MOVES:
        return None
    usual = float(np.median(length))
    if usual < LEAST_HELD or (np.abs(length - usual) <= 1 + 0.1 * usual).mean() < REGULAR:
        return None
    return new
