"""2,000 recordings, files of run folders and command lines, each changed so that it is nonsense or damaged.

Hypothesis draws them, from fixed seeds. Files are read here, a command is typed in a process of its own, up to where
its run folder would be made.
Three ends are good: one line that begins with `error:` and exit status 2; a command that may stand; a file whose
content may stand, judged here by what it holds and not by the code that read it.
"""

import contextlib
import io
import json
import math
import os
import shutil
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import yaml
from common import NEW, ROBOT, conf
from faulty import command, ended, forked, one_line
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st

COUNTS = {"recordings": 700, "files": 700, "commands": 600}
SEEDS = {"recordings": 191, "files": 192, "commands": 193}
SUFFIXES = (".csv", ".npz", ".parquet", ".h5")
FIELDS = [f"{name}{j}" for name in ("q", "dq", "tau_J") for j in range(1, 8)]
# what may at most be read as if it were right: rad/s, also between two rows; Nm
MOST_SPEED, MOST_TORQUE = 20.0, 500.0


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


HOSTILE = [math.nan, math.inf, -math.inf, 1e308, -1e9, "x", "", None, True, "1e", "nan", "0x10", "\uff11"]


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


def damaged(draw, content: bytes) -> tuple[bytes, str]:
    """Return changed bytes, and what was done to them."""
    kind = draw(st.sampled_from(["cut", "flip", "insert", "noise", "zeros", "empty", "double"]))
    n = len(content)
    at = draw(st.integers(0, max(0, n - 1)))
    if kind == "cut":
        return content[:at], f"cut off at byte {at} of {n}"
    if kind == "flip":
        bit = 1 << draw(st.integers(0, 7))
        return content[:at] + bytes([content[at] ^ bit]) + content[at + 1 :], f"bit {bit} of byte {at} flipped"
    if kind == "insert":
        extra = draw(st.binary(min_size=1, max_size=40))
        return content[:at] + extra + content[at:], f"{extra!r} at byte {at}"
    if kind == "noise":
        extra = draw(st.binary(min_size=1, max_size=200))
        return content[:at] + extra + content[at + len(extra) :], f"{len(extra)} bytes from {at} overwritten"
    if kind == "zeros":
        return content[:at] + b"\0" * (n - at), f"zeros from byte {at}"
    return (b"", "empty") if kind == "empty" else (content + content, "twice itself")


def drawn(kind: str, one: Callable, count: int) -> None:
    """Call `one(draw)` so many times, with what hypothesis draws from the seed of this kind."""

    @seeded(SEEDS[kind])
    @settings(
        max_examples=count, database=None, deadline=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.data())
    def run(data):
        one(data.draw)

    run()


def judged(work: Callable[[], str]) -> tuple[str, str]:
    """Do `work`; return how it ended and what it said.

    `work` returns "" where what was accepted may stand, else why it is nonsense.
    """
    from r2s.errors import UserError

    out = io.StringIO()
    try:
        with contextlib.redirect_stderr(out), contextlib.redirect_stdout(out), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reason = work()
    except UserError as error:
        return ("refused" if "\n" not in str(error) else "traceback"), str(error)
    except SystemExit as end:  # of a command
        line = one_line(out.getvalue())
        return ("refused", line) if end.code == 2 and line else ("traceback", out.getvalue())
    except BaseException:
        return "traceback", traceback.format_exc()[-1500:]
    return ("nonsense", reason) if reason else ("stands", "")


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


def leaves(node, path=()) -> list[tuple]:
    """Return the paths to the leaves of nested dicts and lists."""
    if isinstance(node, dict):
        return [p for k, v in node.items() for p in leaves(v, (*path, k))]
    if isinstance(node, list):
        return [p for k, v in enumerate(node) for p in leaves(v, (*path, k))]
    return [path]


def replaced(draw, document, names: list[str]) -> str:
    """Change one leaf of nested dicts and lists in place, or take it away; return what was done."""
    path = draw(st.sampled_from([p for p in leaves(document) if p and (not names or str(p[0]) in names)]))
    depth = draw(st.integers(1, len(path)))
    node = document
    for key in path[: depth - 1]:
        node = node[key]
    key, where = path[depth - 1], ".".join(map(str, path[:depth]))
    if draw(st.booleans()) and isinstance(node, dict):
        del node[key]
        return f"no {where}"
    value = draw(st.sampled_from([math.nan, math.inf, -1.0, -1e9, 1e30, "word", "", None, [], {}, [1.0, 2.0], True]))
    node[key] = value
    return f"{where} is {value!r}"


def plausible(d) -> str:
    """Return why dynamics cannot be an arm's; "" where they can."""
    fields = (
        "phi",
        "offset",
        "breakaway",
        "mass",
        "com",
        "inertia",
        "armature",
        "load",
        "drag",
        "gain",
        "delay",
        "lag",
    )
    for name in fields:
        if not np.isfinite(getattr(d, name)).all():
            return f"{name} is not finite"
    if (d.mass <= 0).any() or (np.linalg.eigvalsh(d.inertia) <= 0).any():
        return "a link that no body can be"
    if (d.phi[..., :2] < 0).any() or (d.armature < 0).any() or (d.load < 0).any():
        return "friction or rotors that give energy"
    if not (0 <= d.delay <= 1 and 0 <= d.lag <= 1 and d.dq_min >= 0):
        return "a delay, a lag or a speed that is none"
    if (np.abs(d.phi) > 1e6).any() or (np.abs(d.offset) > 1e4).any() or (np.abs(d.gain) >= 1).any():
        return "friction, an offset or a gain beyond any arm"
    return ""


def mutate_files(at: Path, err: Path) -> list[dict]:
    """Read files of run folders that are damaged or hold nonsense."""
    import torch

    from r2s.identification.parameter_file import save_parameters
    from r2s.identification.parameters import Estimate, parameter_space
    from r2s.learning.policy import make_policy, save_policy
    from r2s.tasks.reach import ReachTask

    whole, rows = at / "whole", []
    whole.mkdir()
    task = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
    bounds = conf("config")["identify"]["bounds"]
    space = parameter_space(ROBOT, NEW, {k: bounds[k] for k in ("phi1", "phi2", "phi3", "offset", "delay")})
    x = space.start
    found = Estimate(x, x - 0.01, x + 0.01, np.ones(len(x), bool), np.tile(x, (20, 1)))
    save_parameters(whole / "parameters.yaml", space, found, {"recording": "made here"})
    save_policy(whole, make_policy(ROBOT, task, (16, 16)))
    row = {"env_steps": 960, "updates": 100, "wall_clock_s": 1.5, "success_1cm": 0.5, "return_paper": -80.5}
    pd.DataFrame([row | {"env_steps": k} for k in (320, 640, 960)]).to_csv(whole / "evaluations.csv", index=False)
    (whole / "summary.json").write_text(json.dumps({"best": row, "last": row}))
    (whole / "meta.json").write_text(json.dumps({"status": "done", "stage": "train", "inputs": {}}))
    (whole / "overrides.yaml").write_text('- "seed=1"\n')
    np.savez(whole / "memo.npz", x=np.arange(100.0), y=np.arange(5))
    torch.save({"seen": 8, "chunks": ["a.pt"]}, whole / "state.pt")
    composed(whole / "config.yaml", err)
    names = sorted(p.name for p in whole.iterdir())
    own = {"parameters.yaml": ["robot", "joints", "friction_family", "parameters", "fixed"]}
    own["config.yaml"] = ["stage", "seed", "robot", "task", "dr", "friction", "inertia", "algo"]

    def one(draw):
        name = draw(st.sampled_from(names))
        folder = at / "changed"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(whole, folder)
        path = folder / name
        if path.suffix in (".yaml", ".json") and draw(st.integers(0, 3)):
            document = yaml.safe_load(path.read_text())
            what = replaced(draw, document, own.get(name, []))
            text = yaml.safe_dump(document, sort_keys=False) if path.suffix == ".yaml" else json.dumps(document)
            path.write_text(text)
        else:
            content, what = damaged(draw, path.read_bytes())
            path.write_bytes(content)
        end, said = judged(lambda: READ[name](folder, task))
        rows.append({"kind": "files", "what": f"{name}: {what}", "end": end, "said": said})

    drawn("files", one, COUNTS["files"])
    return rows


def composed(path: Path, err: Path) -> None:
    """Write the config of a training."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from r2s.stages.build import CONF

    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        path.write_text(OmegaConf.to_yaml(compose("config", ["+experiment=toy"])))


def _parameters(folder: Path, task) -> str:
    from r2s.identification.parameter_file import load_parameters, load_posterior

    space, x = load_parameters(folder, ROBOT)
    samples = load_posterior(folder, space)
    if not np.isfinite(samples).all():
        return "draws that are not finite"
    return plausible(space.dynamics(x))


def _config(folder: Path, task) -> str:
    """Make what stage=transfer makes of the config of a training."""
    from omegaconf import OmegaConf

    from r2s.stages import build
    from r2s.stages.transfer import trained_config

    said: list[str] = []

    def work(cfg) -> None:
        cfg.policy = str(folder)
        _, trained = trained_config(cfg)
        robot = build.make_robot(trained)
        dynamics = build.make_dynamics(trained, robot)
        build.make_task(trained, robot, dynamics)
        build.make_draw(trained, robot, dynamics)
        said.append(plausible(dynamics))

    from r2s.cli import said_in_one_line

    with said_in_one_line():
        work(OmegaConf.create({"policy": None}))
    return said[0]


def _policy(folder: Path, task) -> str:
    import torch

    from r2s.learning.policy import load_policy

    policy = load_policy(folder, ROBOT, task)
    seen = torch.zeros(1, len(policy.normalizer.mean))
    return "" if torch.isfinite(policy(seen)).all() else "a policy whose torque is not finite"


def _trainings(folder: Path, task) -> str:
    from r2s.reporting.trainings import read_trainings

    (trained,), _ = read_trainings([folder])
    return "" if math.isfinite(trained.last["return_paper"]) else "a return that is not finite"


def _meta(folder: Path, task) -> str:
    from r2s.runs import is_done

    is_done(folder)
    return ""


def _overrides(folder: Path, task) -> str:
    from omegaconf import OmegaConf

    from r2s.cli import typed_in

    words = typed_in(folder)
    return "" if all(isinstance(w, str) for w in OmegaConf.to_container(OmegaConf.create(words))) else "no words"


def _summary(folder: Path, task) -> str:
    from r2s.runs import read_summary

    return "" if isinstance(read_summary(folder, "policy"), dict) else "no summary"


def _memo(folder: Path, task) -> str:
    from r2s.runs import load_arrays

    return "" if load_arrays(folder / "memo.npz") else "no arrays"


def _state(folder: Path, task) -> str:
    from r2s.learning.checkpoint import load_tensors

    load_tensors(folder / "state.pt", "resume")
    return ""


READ = {
    "parameters.yaml": _parameters,
    "posterior.npz": _parameters,
    "config.yaml": _config,
    "policy.pt": _policy,
    "evaluations.csv": _trainings,
    "meta.json": _meta,
    "overrides.yaml": _overrides,
    "summary.json": _summary,
    "memo.npz": _memo,
    "state.pt": _state,
}

BASES = (
    ["+experiment=toy"],
    ["algo=sac", "dr=none", "seed=3"],
    ["stage=identify", "+experiment=toy"],
    ["stage=identify", "data=simulated", "+experiment=toy"],
    ["stage=identify", "data=kinova_gen3"],
    ["stage=compare", "runs='runs/train/*'"],
    ["-m", "+experiment=toy", "seed=0,1"],
    ["algo=oracle"],
)
# options that are numbers, with what is allowed, written down again here: the judge is not the accused
NUMBERS: dict[str, tuple[float, float, bool, str]] = {
    "seed": (0, math.inf, True, ""),
    "threads": (0, 4096, True, ""),
    "budget.minutes": (1e-9, math.inf, False, "train"),
    "budget.env_steps": (1e-9, math.inf, False, "train"),
    "algo.lr": (1e-30, 1, False, "train"),
    "algo.gamma": (0, 1, False, "train"),
    "algo.tau": (1e-30, 1, False, "train"),
    "algo.batch_size": (1, 800000, True, "train"),
    "algo.n_envs": (1, 100000, True, "train"),
    "algo.learning_starts": (0, math.inf, True, "train"),
    "algo.updates_per_step": (1, math.inf, True, "train"),
    "algo.replay_size": (32, 1e10, True, "train"),
    "evaluation.episodes": (1, 1e6, True, "train"),
    "evaluation.env_steps": (1, math.inf, True, "train"),
    "task.ctrl_hz": (1, 1000, True, "train"),
    "task.seconds": (0.5, 1000, False, "train"),
    "dr.phi_relative": (0, 1, False, "train"),
    "dr.inertia_relative": (0, 1, False, "train"),
    "friction.phi1": (0, 1e6, False, "both"),
    "friction.phi2": (0, 1e6, False, "both"),
    "friction.dq_min": (0, 100, False, "both"),
    "inertia.scale": (1e-6, 1e6, False, "both"),
    "robot.torque_fraction": (1e-6, 1, False, "train"),
    "identify.window_s": (1e-3, 1000, False, "identify"),
    "identify.stride": (1, 10000, True, "identify"),
    "identify.cutoff_hz": (1e-3, 500, False, "identify"),
    "identify.folds": (2, 1000, True, "identify"),
    "identify.breakaway": (0, 1e6, False, "identify"),
    "identify.validation_fraction": (1e-9, 1 - 1e-9, False, "identify"),
    "data.seconds": (0.1, 1e5, False, "arm"),
    "data.ramp_poses": (0, 1000, True, "arm"),
    "data.excitation_seed": (0, math.inf, True, "arm"),
}
VALUES = ["nan", "inf", "-inf", "-1", "0", "1e308", "-1e9", "1e400", "word", "[]", "{}", "null", "true", "''", "0.5"]
VALUES += [
    "[1,2]",
    "1e-320",
    "${seed}",
    "${nowhere}",
    "${oc.env:HOME}",
    "'",
    "{a: 1}",
    "[nan]",
    "\uff13",
    "1_000",
    "0x1F",
]


def mutate_commands(at: Path, err: Path) -> list[dict]:
    """Type commands that are nonsense; what is accepted stops where its run folder would be made."""
    rows: list[dict] = []
    root = at / "typed"

    def stop_at_the_folder() -> None:
        from r2s.stages import compare, identify, train

        class Reached:
            def __enter__(self):
                print("reached", flush=True)
                os._exit(0)

            def __exit__(self, *_):
                return False

        for stage in (compare, identify, train):
            stage.open_run = lambda *_, **__: Reached()

    def one(draw):
        words = list(draw(st.sampled_from(BASES)))
        kind = draw(st.sampled_from(["number", "number", "number", "letters", "word", "text", "path"]))
        key, value, wrong = "", "", None
        if kind == "number":
            key, value = draw(st.sampled_from(sorted(NUMBERS))), draw(st.sampled_from(VALUES))
            words.append(f"{key}={value}")
            wrong = outside(key, value)
        elif kind == "letters":
            k = draw(st.integers(0, len(words) - 1))
            letters = list(words[k])
            place = draw(st.integers(0, len(letters) - 1))
            letters[place] = draw(st.sampled_from(list("abcxyzäß=+~[]{}$,'\"\\ \t0:;")))
            words[k] = "".join(letters)
        elif kind == "word":
            words.append(
                draw(st.text(min_size=0, max_size=12, alphabet=st.characters(codec="utf-8", exclude_characters="\0")))
            )
        elif kind == "text":
            key = draw(
                st.sampled_from(["name", "root", "calibration", "device", "matmul", "friction.family", "stage"])
            )
            value = draw(
                st.sampled_from(["..", "a/b", "''", "null", "[]", "{}", "-1", "true", "x" * 300, "'\t'", "∅"])
            )
            words.append(f"{key}={value}")
        else:
            key = draw(st.sampled_from(["resume", "calibration", "runs", "robot.mjcf", "data.excitation"]))
            value = draw(st.sampled_from(["/", "/dev/null", "/dev/zero", ".", "'*'", "/proc/self/mem", "~", "'**'"]))
            words.append(f"{key}={value}")
        if not any(w.startswith("root=") for w in words):
            words.append(f"root={root}")
        status = ended(forked(command(words, at), err, before=stop_at_the_folder), 120.0)
        text = err.read_text(errors="replace")
        errors = [line for line in text.splitlines() if line.startswith("error: ")]
        if status == 2 and errors and "Traceback" not in text and (len(errors) == 1 or "-m" in words):
            end, said = "refused", errors[0]  # of a sweep a line for each job
        elif status == 0 and "Traceback" not in text:
            end, said = ("nonsense", f"{key}={value} was taken") if wrong and "reached" in text else ("stands", "")
        else:
            end, said = "traceback", text[-1500:] or f"exit status {status}"
        made = [str(p) for p in at.rglob("*") if p.name == "meta.json" and "typed" in p.parts]
        rows.append({"kind": "commands", "what": " ".join(words), "end": end, "said": said, "left": made})

    drawn("commands", one, COUNTS["commands"])
    return rows


def outside(key: str, value: str) -> bool:
    """Return whether a value typed for an option is nonsense; lists and null are judged by the code alone."""
    low, high, whole, _ = NUMBERS[key]
    try:
        number = float(value)
    except ValueError:
        return value in ("word", "{}", "true", "''", "{a: 1}", "[nan]", "[]", "${oc.env:HOME}")
    return not (low <= number <= high) or (whole and number != int(number)) if math.isfinite(number) else True


def mutate(at: Path, err: Path) -> dict:
    """Do all; return the counts, and every case that ended badly."""
    rows = []
    for part in (mutate_recordings, mutate_files, mutate_commands):
        folder = at / part.__name__
        folder.mkdir()
        own = part(folder, err)
        print(part.__name__, Counter(r["end"] for r in own), flush=True)
        for r in own:
            if r["end"] in ("traceback", "nonsense") or r.get("left"):
                print(json.dumps(r, ensure_ascii=False), flush=True)
        rows += own
    bad = [r for r in rows if r["end"] in ("traceback", "nonsense") or r.get("left")]
    counts = {kind: Counter(r["end"] for r in rows if r["kind"] == kind) for kind in COUNTS}
    return {"counts": counts, "bad": bad, "left": sum(len(r.get("left", [])) for r in rows), "seeds": SEEDS}
