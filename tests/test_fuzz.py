"""Mutated recordings and run folders never end in a traceback; see also test_fuzz_commands.py and test_fuzz_arm.py.

A mutated input has two good outcomes. Either one line names the mistake (a UserError, exit status 2), or the input is
accepted and describes a possible arm. The tests judge accepted inputs by limits of their own, not by r2s's checks.
Examples are few, so that the suite stays fast; `R2S_FUZZ=20 pytest tests/test_fuzz*.py` draws 20 times as many.
"""

import contextlib
import io
import json
import math
import os
import shutil

import h5py
import mujoco
import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from conftest import conf
from hydra import compose, initialize_config_dir
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from r2s import cli
from r2s.errors import UserError
from r2s.identification.parameter_file import load_parameters, load_posterior, save_parameters
from r2s.identification.parameters import ParameterEstimate, parameter_space
from r2s.learning.checkpoint import load_tensors
from r2s.learning.policy import load_policy, make_policy, save_policy
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.reporting.comparison.trainings import read_trainings
from r2s.runs import is_done, load_arrays, read_summary
from r2s.stages import build
from r2s.stages.data import FileData
from r2s.stages.recordings import read_groups
from r2s.stages.transfer import trained_config
from r2s.tasks.reach import ReachTask

PANDA = load_robot(**conf("robot/panda"))
PAPER = nominal_dynamics(PANDA, **conf("friction/paper"))
TASK = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
FIELDS = [f"{name}{j}" for name in ("q", "dq", "tau_J") for j in range(1, 8)]
MAX_SPEED, MAX_TORQUE = 20.0, 500.0  # rad/s and Nm: more than any joint of an arm this size has


def examples(count: int):
    """Return the settings of a test with `count` examples, the same ones in every run."""
    count *= int(os.environ.get("R2S_FUZZ", "1"))
    fixed = {"derandomize": True, "database": None, "deadline": None, "phases": [Phase.generate]}
    return settings(max_examples=count, suppress_health_check=list(HealthCheck), **fixed)


def refusal(read) -> str | None:
    """Return the one line with which `read()` refuses its input; None if it accepts the input."""
    line = None
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            read()
        except UserError as error:
            line = f"error: {error}"
        except SystemExit as end:
            line = err.getvalue().rstrip("\n") if end.code == 2 else f"exit status {end.code}"
    assert line is None or (line.startswith("error: ") and "\n" not in line), line
    return line


def damage(draw, content: bytes) -> bytes:
    """Return `content` cut off, with a flipped bit, inserted, overwritten, zeroed or repeated bytes."""
    kind = draw(st.sampled_from(["cut", "flip", "insert", "noise", "zeros", "empty", "double"]))
    at = draw(st.integers(0, max(0, len(content) - 1)))
    extra = draw(st.binary(min_size=1, max_size=100)) if kind in ("insert", "noise") else b""
    if kind == "flip":
        return content[:at] + bytes([content[at] ^ 1 << draw(st.integers(0, 7))]) + content[at + 1 :]
    tail = {"insert": content[at:], "noise": content[at + len(extra) :], "zeros": b"\0" * (len(content) - at)}
    return {"empty": b"", "double": content + content}.get(kind, content[:at] + extra + tail.get(kind, b""))


def recording() -> pd.DataFrame:
    """Return two seconds of a Panda with viscous friction, link-side torque."""
    t = np.arange(2000) * 1e-3
    swing = np.linspace(0.1, 0.2, 7)
    q = np.outer(1 - np.cos(2 * t), swing) + np.array([0, -0.8, 0, -2.3, 0, 1.6, 0.8])
    dq, ddq = np.outer(2 * np.sin(2 * t), swing), np.outer(4 * np.cos(2 * t), swing)
    model = PANDA.model(gravity=True)
    data, tau = mujoco.MjData(model), 2 * dq
    for k in range(len(t)):
        data.qpos, data.qvel, data.qacc = q[k], dq[k], ddq[k]
        mujoco.mj_inverse(model, data)
        tau[k] += data.qfrc_inverse
    return pd.DataFrame(np.column_stack([t, q, dq, tau]), columns=["t", *FIELDS])


def save(frame: pd.DataFrame, path) -> None:
    """Write a recording in the format of the file's suffix."""
    if path.suffix == ".csv":
        frame.to_csv(path, index=False)
    elif path.suffix == ".parquet":
        frame.to_parquet(path)
    elif path.suffix == ".npz":
        np.savez(path, **{k: frame[k].to_numpy() for k in frame}, allow_pickle=True)
    else:
        with h5py.File(path, "w") as file:
            for k in frame:
                column = frame[k].to_numpy()
                file[k] = column if column.dtype != object else column.astype("S")


HOSTILE = [math.nan, math.inf, -math.inf, 1e308, -1e9, "x", "", None, "1e", "nan", "0x10", "\uff11"]
SPOILS = ["cell", "spike", "time", "clock", "units", "drop", "short", "still", "repeat", "swap"]
UNITS = [("q", 57.29578), ("q", -1.0), ("tau_J", 1e3), ("tau_J", -1.0), ("dq", 57.3)]


def spoil(draw, frame: pd.DataFrame) -> tuple[pd.DataFrame, bool]:
    """Return a recording with one mistake, and whether it may still be a possible recording of the arm."""
    out, column, at = frame.copy(), draw(st.sampled_from(FIELDS)), draw(st.integers(1, len(frame) - 2))
    kind = draw(
        st.sampled_from(["cell", "spike", "time", "clock", "units", "drop", "short", "still", "repeat", "swap"])
    )
    if kind == "cell":
        out[column] = out[column].astype(object)
        out.loc[at, column] = draw(st.sampled_from(HOSTILE))
        return out, False
    if kind == "spike":
        size = draw(st.sampled_from([5.0, -20.0, 1e4, 1e12]))
        out.loc[at, column] += size
        return out, abs(size) < {"q": 0.1, "d": MAX_SPEED, "t": MAX_TORQUE}[column[0]]
    if kind == "time":  # the reader drops a single row far away, and a restarted clock begins a new trajectory
        value = draw(st.sampled_from([math.nan, -1.0, 1e18, math.inf, 0.0]))
        out.loc[at, "t"] = value
        return out, value in (0.0, 1e18)
    if kind == "clock":
        out["t"] *= draw(st.sampled_from([1e3, 1e6, 1e9, -1.0, 0.0]))
    elif kind == "units":
        name, factor = draw(st.sampled_from(UNITS))
        out[[f"{name}{j}" for j in range(1, 8)]] *= factor
    elif kind == "drop":
        out = out.drop(columns=column)
    elif kind == "short":
        out = out.iloc[: draw(st.integers(0, 900))]
    elif kind == "still":
        out[FIELDS[:7]] = out[FIELDS[:7]].iloc[0].to_numpy()
    elif kind == "repeat":  # from the first 0.1 s on, the file is a motion recorded twice
        return pd.concat([out, out.iloc[at:]], ignore_index=True), at <= 100
    else:  # joints 1 and 2 move alike, so their swap may pass
        swap = draw(st.sampled_from([(1, 2), (2, 4), (4, 6)]))
        names = {f"{x}{a}": f"{x}{b}" for x in ("q", "tau_J") for a, b in (swap, swap[::-1])}
        return out.rename(columns=names), swap == (1, 2)
    return out, False


class Formats:
    """A folder, and the same recording as a table and as the bytes of each format."""

    def __init__(self, folder):
        self.folder, self.frame, self.content = folder, recording(), {}
        for suffix in (".csv", ".npz", ".parquet", ".h5"):
            save(self.frame, folder / f"intact{suffix}")
            self.content[suffix] = (folder / f"intact{suffix}").read_bytes()


@pytest.fixture(scope="module")
def formats(tmp_path_factory):
    return Formats(tmp_path_factory.mktemp("recordings"))


@pytest.mark.long
@examples(40)
@given(data=st.data())
def test_a_mutated_recording_is_refused_or_physical(formats, data):
    """Damaged bytes, hostile cells, wrong units, clocks, signs and joints."""
    suffix, possible = data.draw(st.sampled_from(sorted(formats.content))), True
    path = formats.folder / f"mutated{suffix}"
    if data.draw(st.booleans()):
        path.write_bytes(damage(data.draw, formats.content[suffix]))
    else:
        spoilt, possible = spoil(data.draw, formats.frame)
        try:
            save(spoilt, path)
        except Exception:  # the format cannot hold such a value
            path.write_bytes(b"")
    seen = []
    file = FileData(**conf("data/recording") | {"path": str(path), "torque": "measured"})
    if refusal(lambda: seen.extend(read_groups(PANDA, [file], [], 0.25, 10.0))) is None:
        assert possible
        for side in (*seen[0].train.values(), *seen[0].validation.values()):
            assert side.n_joints == 7
            assert all(np.isfinite(a).all() for a in (side.t, side.q, side.dq, side.tau))
            assert np.abs(side.dq).max() <= MAX_SPEED
            assert np.abs(side.tau).max() <= MAX_TORQUE
            for s in side.stretches:
                assert (np.diff(side.t[s]) > 0).all()
                assert (np.abs(np.diff(side.q[s], axis=0)) <= 0.06 + MAX_SPEED * np.diff(side.t[s])[:, None]).all()


def check_possible(d) -> None:
    """Fail if no arm can have these dynamics."""
    names = ("phi", "offset", "breakaway", "mass", "com", "inertia", "armature", "load", "drag", "gain")
    assert all(np.isfinite(getattr(d, name)).all() for name in (*names, "delay", "lag"))
    assert (d.mass > 0).all()
    assert (np.linalg.eigvalsh(d.inertia) > 0).all()
    assert min(d.phi[..., :2].min(), np.min(d.armature), np.min(d.load), d.dq_min) >= 0
    assert 0 <= d.delay <= 1
    assert 0 <= d.lag <= 1
    assert np.abs(d.phi).max() <= 1e6
    assert np.abs(d.offset).max() <= 1e4
    assert np.abs(d.gain).max() < 1


def read_parameters(folder) -> None:
    space, x = load_parameters(folder, PANDA)
    assert np.isfinite(load_posterior(folder, space)).all()
    check_possible(space.dynamics(x))


def read_config(folder) -> None:
    """Make what stage=transfer makes from the config of a training."""
    with cli.errors_in_one_line():
        _, trained = trained_config(OmegaConf.create({"policy": str(folder)}))
        robot = build.make_robot(trained)
        dynamics = build.make_dynamics(trained, robot)
        build.make_task(trained, robot, dynamics)
        build.make_draw(trained, robot, dynamics)
        check_possible(dynamics)


def read_policy(folder) -> None:
    policy = load_policy(folder, PANDA, TASK)
    assert torch.isfinite(policy(torch.zeros(1, len(policy.normalizer.mean)))).all()


READ = {
    "parameters.yaml": read_parameters,
    "posterior.npz": read_parameters,
    "config.yaml": read_config,
    "policy.pt": read_policy,
    "evaluations.csv": lambda folder: read_trainings([folder]),
    "meta.json": is_done,
    "overrides.yaml": cli.typed_overrides,
    "summary.json": lambda folder: read_summary(folder, "policy"),
    "memo.npz": lambda folder: load_arrays(folder / "memo.npz"),
    "state.pt": lambda folder: load_tensors(folder / "state.pt", "resume"),
}
READ_KEYS = {  # keys that the readers above use
    "parameters.yaml": ("robot", "joints", "friction_family", "parameters", "fixed"),
    "config.yaml": ("stage", "seed", "robot", "task", "dr", "friction", "inertia", "algo"),
}


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """Return a folder with every kind of file that a later command reads."""
    folder = tmp_path_factory.mktemp("run") / "intact"
    folder.mkdir()
    with initialize_config_dir(str(build.CONF.resolve()), version_base="1.3"):
        cfg = compose("config", ["+experiment=toy"])
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(cfg))
    bounds = OmegaConf.to_container(cfg.identify.bounds)
    space = parameter_space(PANDA, PAPER, {k: bounds[k] for k in ("phi1", "phi2", "phi3", "offset", "delay")})
    x = space.start
    found = ParameterEstimate(x, x - 0.01, x + 0.01, np.ones(len(x), bool), np.tile(x, (20, 1)))
    save_parameters(folder / "parameters.yaml", space, found, {"recording": "a test"})
    save_policy(folder, make_policy(PANDA, TASK, (16, 16)))
    row = {"env_steps": 960, "updates": 100, "wall_clock_s": 1.5, "success_1cm": 0.5, "return_paper": -80.5}
    pd.DataFrame([row | {"env_steps": k} for k in (320, 640, 960)]).to_csv(folder / "evaluations.csv", index=False)
    (folder / "summary.json").write_text(json.dumps({"best": row, "last": row}))
    (folder / "meta.json").write_text(json.dumps({"status": "done", "stage": "train", "inputs": {}}))
    (folder / "overrides.yaml").write_text('- "seed=1"\n')
    np.savez(folder / "memo.npz", x=np.arange(100.0), y=np.arange(5))
    torch.save({"seen": 8, "chunks": ["a.pt"]}, folder / "state.pt")
    return folder


def leaves(node, path=()) -> list[tuple]:
    """Return the paths to the leaves of nested dicts and lists."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else None
    return [path] if items is None else [p for key, value in items for p in leaves(value, (*path, key))]


def mutate_leaf(draw, document, keys) -> None:
    """Delete or replace one node of nested dicts and lists."""
    path = draw(st.sampled_from([p for p in leaves(document) if p and (not keys or p[0] in keys)]))
    *parents, key = path[: draw(st.integers(1, len(path)))]
    for parent in parents:
        document = document[parent]
    if isinstance(document, dict) and draw(st.booleans()):
        del document[key]
    else:
        values = [math.nan, math.inf, -1.0, -1e9, 1e30, "word", "", None, [], {}, [1.0, 2.0], True]
        document[key] = draw(st.sampled_from(values))


@pytest.mark.long
@examples(100)
@given(data=st.data())
def test_a_mutated_run_folder_is_refused_or_physical(run_folder, data):
    """Damaged bytes of each file, and deleted or replaced entries of YAML and JSON."""
    path = run_folder.parent / "mutated" / data.draw(st.sampled_from(sorted(READ)))
    shutil.rmtree(path.parent, ignore_errors=True)
    shutil.copytree(run_folder, path.parent)
    if path.suffix in (".yaml", ".json") and data.draw(st.integers(0, 3)):
        document = yaml.safe_load(path.read_text())
        mutate_leaf(data.draw, document, READ_KEYS.get(path.name))
        path.write_text(json.dumps(document) if path.suffix == ".json" else yaml.safe_dump(document, sort_keys=False))
    else:
        path.write_bytes(damage(data.draw, path.read_bytes()))
    refusal(lambda: READ[path.name](path.parent))
