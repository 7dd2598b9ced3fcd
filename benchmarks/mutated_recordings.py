"""Recordings that are damaged or nonsense, read as stage=identify reads them."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
from common import ROBOT, conf
from hypothesis import strategies as st
from mutated import COUNTS, damaged, drawn, judged

SUFFIXES = (".csv", ".npz", ".parquet", ".h5")
FIELDS = [f"{name}{j}" for name in ("q", "dq", "tau_J") for j in range(1, 8)]
# what may at most be read as if it were right: rad/s, also between two rows; Nm
MOST_SPEED, MOST_TORQUE = 20.0, 500.0
HOSTILE = [math.nan, math.inf, -math.inf, 1e308, -1e9, "x", "", None, True, "1e", "nan", "0x10", "\uff11"]
SPOILS = (
    "cell",
    "spike",
    "time",
    "clock",
    "units",
    "lost",
    "name",
    "order",
    "short",
    "still",
    "silent",
    "twice",
    "swap",
)


def recording() -> pd.DataFrame:
    """Return two seconds of a Panda with viscous friction."""
    t = np.arange(2000) * 1e-3
    swing = np.linspace(0.1, 0.2, 7)
    q = np.outer(1 - np.cos(2 * t), swing) + np.array([0, -0.8, 0, -2.3, 0, 1.6, 0.8])
    dq, ddq = np.outer(2 * np.sin(2 * t), swing), np.outer(4 * np.cos(2 * t), swing)
    model = ROBOT.model(gravity=True)
    data, tau = mujoco.MjData(model), 2 * dq
    for k in range(len(t)):
        data.qpos, data.qvel, data.qacc = q[k], dq[k], ddq[k]
        mujoco.mj_inverse(model, data)
        tau[k] += data.qfrc_inverse
    return pd.DataFrame(np.column_stack([t, q, dq, tau]), columns=["t", *FIELDS])


def save(frame: pd.DataFrame, path: Path) -> None:
    """Write a recording in the format of the file's suffix."""
    if path.suffix == ".csv":
        frame.to_csv(path, index=False)
    elif path.suffix == ".parquet":
        frame.to_parquet(path)
    elif path.suffix == ".npz":
        np.savez(path, **{k: frame[k].to_numpy() for k in frame}, allow_pickle=True)
    else:
        import h5py

        with h5py.File(path, "w") as file:
            for k in frame:
                column = frame[k].to_numpy()
                file[k] = column if column.dtype != object else column.astype("S")


def spoiled(draw, frame: pd.DataFrame) -> tuple[pd.DataFrame, str, bool]:
    """Return a changed recording, what was done to it, and whether what is left might be right."""
    rows, column = len(frame), draw(st.sampled_from(FIELDS))
    kind = draw(st.sampled_from(SPOILS))
    out = frame.copy()
    at = draw(st.integers(1, rows - 2))
    if kind == "cell":
        value = draw(st.sampled_from(HOSTILE))
        out[column] = out[column].astype(object)
        out.loc[at, column] = value
        return out, f"{column} is {value!r} at row {at}", False
    if kind == "spike":
        size = draw(st.sampled_from([5.0, -20.0, 1e4, 1e12]))
        out.loc[at, column] += size
        most = {"q": 0.1, "d": MOST_SPEED, "t": MOST_TORQUE}[column[0]]
        return out, f"{column} jumps by {size:g} at row {at}", abs(size) < most
    if kind == "time":
        value = draw(st.sampled_from([math.nan, -1.0, 1e18, math.inf, 0.0]))
        out.loc[at, "t"] = value
        # a row apart from all others in time is dropped, and where a clock starts anew so does a trajectory
        return out, f"t is {value:g} at row {at}", value in (0.0, 1e18)
    if kind == "clock":
        factor = draw(st.sampled_from([1e3, 1e6, 1e9, -1.0, 0.0]))
        out["t"] *= factor
        return out, f"t times {factor:g}", False
    if kind == "units":
        name, factor = draw(
            st.sampled_from([("q", 57.29578), ("q", -1.0), ("tau_J", 1e3), ("tau_J", -1.0), ("dq", 57.3)])
        )
        own = [f"{name}{j}" for j in range(1, 8)]
        out[own] *= factor
        return out, f"{name} times {factor:g}", False
    if kind == "lost":
        return out.drop(columns=column), f"no {column}", False
    if kind == "name":
        wrong = draw(st.sampled_from(["", " ", "Q", f"{column} ", "t", "qq", "\uff51", "q0", "q[1]"]))
        return out.rename(columns={column: wrong}), f"{column} is named {wrong!r}", wrong == f"{column} "
    if kind == "order":
        order = draw(st.permutations(range(rows)))[: draw(st.integers(0, 30))]
        keep = [*order, *(k for k in range(rows) if k not in set(order))]
        moved = order != sorted(order) or keep != list(range(rows))
        return out.iloc[keep].reset_index(drop=True), "rows in another order", not moved
    if kind == "short":
        return out.iloc[: draw(st.integers(0, 900))], "cut short", False
    if kind == "still":
        out[[f"q{j}" for j in range(1, 8)]] = out[[f"q{j}" for j in range(1, 8)]].iloc[0].to_numpy()
        return out, "nothing moves", False
    if kind == "silent":
        out[[f"tau_J{j}" for j in range(1, 8)]] = 0.0
        return out, "no torque", False
    if kind == "twice":
        # from the first 0.1 s on it is a motion that was recorded twice
        return pd.concat([out, out.iloc[at:]], ignore_index=True), f"rows from {at} on come twice", at <= 100
    swap = draw(st.sampled_from([(1, 2), (2, 4), (4, 6)]))
    names = {f"{x}{a}": f"{x}{b}" for x in ("q", "tau_J") for a, b in (swap, swap[::-1])}
    return (
        out.rename(columns=names),
        f"joints {swap[0]} and {swap[1]} changed places",
        swap == (1, 2),
    )  # these move alike


def mutate_recordings(at: Path, err: Path) -> list[dict]:
    """Read recordings that are damaged or nonsense."""
    base, rows = recording(), []
    wholes = {}
    for suffix in SUFFIXES:
        save(base, at / f"whole{suffix}")
        wholes[suffix] = (at / f"whole{suffix}").read_bytes()

    def one(draw):
        suffix = draw(st.sampled_from(SUFFIXES))
        path, may_stand = at / f"changed{suffix}", True
        if draw(st.booleans()):
            content, what = damaged(draw, wholes[suffix])
            path.write_bytes(content)
        else:
            frame, what, may_stand = spoiled(draw, base)
            try:
                save(frame, path)
            except Exception:  # no such file can be written
                path.write_bytes(b"")
                what += " (empty file)"

        def work() -> str:
            from r2s.stages.identify import File, read_motion

            given = {k: v for k, v in conf("data/recording").items()} | {"path": str(path), "torque": "measured"}
            for side in read_motion(ROBOT, File(**given), 0.25):
                arrays = (side.t, side.q, side.dq, side.tau)
                if not all(np.isfinite(a).all() for a in arrays) or side.n_joints != 7:
                    return "not finite"
                for s in side.stretches:
                    steps = np.diff(side.t[s])
                    if (steps <= 0).any():
                        return "time stands"
                    if (np.abs(np.diff(side.q[s], axis=0)) - MOST_SPEED * steps[:, None]).max(initial=0) > 0.06:
                        return f"a joint moves faster than {MOST_SPEED:g} rad/s"
                if np.abs(side.dq).max() > MOST_SPEED or np.abs(side.tau).max() > MOST_TORQUE:
                    return "a speed or a torque that no joint has"
            return "" if may_stand else f"{what}: taken as right"

        end, said = judged(work)
        rows.append({"kind": "recordings", "what": f"{suffix}: {what}", "end": end, "said": said})

    drawn("recordings", one, COUNTS["recordings"])
    return rows
