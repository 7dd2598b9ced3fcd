"""Recordings out to ROS 2 (MCAP) and LeRobot, and in again: nothing changes beyond float32; bad input is one line."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
from conftest import ROOT, conf, in_blocks
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from r2s.commands import robot_of, run_command
from r2s.errors import UserError
from r2s.excitation.motion import Excitation
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.recordings.lerobot import INFO, write_dataset
from r2s.recordings.readers import files_of, read
from r2s.recordings.recording import Recording
from r2s.recordings.ros_bag import write_mcap
from r2s.stages.build import CONF
from r2s.stages.data import read_episodes

JOINTS = [f"joint{j}" for j in range(1, 8)]
ROWS = 60
FLOAT32 = np.finfo(np.float32).eps


def motion(torque="measured", split=True, step=1e-3, **more) -> Recording:
    """Return a recording of 7 joints in which every value differs, of two trajectories on one clock."""
    t = step * np.arange(ROWS)
    angle = 2 * t[:, None] / step / ROWS + np.arange(7)
    q = np.array([0.0, 0.0, 0.0, -1.5, 0.0, 1.8, 0.0]) + 0.3 * np.sin(angle)
    index = np.arange(ROWS) >= ROWS // 2 if split else np.zeros(ROWS)
    return Recording(t, q, 0.6 * np.cos(angle), 10 * np.sin(3 * angle), torque, index, **more)


def assert_same(out: Recording, true: Recording) -> None:
    """Every value agrees to float32, time from the start of each trajectory."""
    for field in ("q", "dq", "tau"):
        np.testing.assert_array_equal(getattr(out, field).astype(np.float32), getattr(true, field).astype(np.float32))
    np.testing.assert_array_equal(out.trajectory, true.trajectory)
    for a, b in zip(out.stretches, true.stretches, strict=True):
        np.testing.assert_allclose(out.t[a] - out.t[a][0], true.t[b] - true.t[b][0], rtol=FLOAT32, atol=2e-9)
    assert out.torque == true.torque


def messages(path: Path, topic: str) -> list:
    """Return the messages of a topic."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(path) as bag:
        of = [c for c in bag.connections if c.topic == topic]
        return [store.deserialize_cdr(raw, c.msgtype) for c, _, raw in bag.messages(connections=of)]


def one_line(*words: str) -> str:
    with pytest.raises(UserError) as caught:
        run_command(words)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture(scope="module")
def dynamics(panda):
    return nominal_dynamics(panda, phi1=1.0, phi2=10.0, phi3=0.0)


# --- MCAP


def test_mcap_restores_a_recording(tmp_path, panda, dynamics):
    """Also time of day, which float64 resolves to 0.2 us only, and trajectories whose clock restarts."""
    true = motion()
    late = replace(true, t=np.where(true.trajectory == 0, true.t, true.t - true.t[ROWS // 2]) + 4.0)
    for k, recording in enumerate((true, late)):
        assert write_mcap(tmp_path / f"{k}.mcap", panda, recording, dynamics) == []
        assert_same(read(tmp_path / f"{k}.mcap", torque="measured", model_joints=JOINTS), recording)


def test_mcap_holds_the_wrench_and_the_reference(tmp_path, panda, dynamics):
    wrench = np.arange(6.0 * ROWS).reshape(ROWS, 6)
    recording = motion(split=False, signals={"O_F_ext_hat_K": wrench})
    plan = {"t": recording.t, "q": recording.q, "dq": recording.dq, "ddq": 0 * recording.q}
    write_mcap(path := tmp_path / "a.mcap", panda, recording, dynamics, plan)
    seen = [m.wrench for m in messages(path, "/external_wrench")]
    back = [[m.force.x, m.force.y, m.force.z, m.torque.x, m.torque.y, m.torque.z] for m in seen]
    np.testing.assert_array_equal(back, wrench)
    (trajectory,) = messages(path, "/reference")
    assert trajectory.joint_names == JOINTS
    np.testing.assert_array_equal([p.positions for p in trajectory.points], recording.q)
    times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in trajectory.points]
    np.testing.assert_allclose(times, recording.t, atol=1e-9)
    layout = json.loads((tmp_path / "a.foxglove.json").read_text())
    used = {x["value"].split(".")[0] for p in layout["configById"].values() for x in p.get("paths", ())}
    assert used == {"/joint_states", "/external_wrench"}


def test_frames_are_those_of_the_urdf(tmp_path, panda, dynamics):
    """The frames of tf, one after the other, lead where MuJoCo puts the links of /robot_description."""
    write_mcap(path := tmp_path / "a.mcap", panda, recording := motion(split=False), dynamics)
    (description,) = messages(path, "/robot_description")
    with Reader(path) as bag:
        (connection,) = [c for c in bag.connections if c.topic == "/robot_description"]
        assert [q.durability.name for q in connection.ext.offered_qos_profiles] == ["TRANSIENT_LOCAL"]
    model = mujoco.MjModel.from_xml_string(description.data)
    data = mujoco.MjData(model)
    frames = messages(path, "/tf")
    assert len(frames) == 3  # 60 ms at 50 Hz
    for k, message in zip((0, 20, 40), frames, strict=True):
        data.qpos[:] = recording.q[k]
        mujoco.mj_kinematics(model, data)
        at, turn = np.zeros(3), np.array([1.0, 0, 0, 0])
        for stamped in message.transforms:
            x, r = stamped.transform.translation, stamped.transform.rotation
            step, out = np.array([x.x, x.y, x.z]), np.empty(3)
            mujoco.mju_rotVecQuat(out, step, turn)
            at = at + out
            mujoco.mju_mulQuat(turn, turn.copy(), np.array([r.w, r.x, r.y, r.z]))
            np.testing.assert_allclose(data.body(stamped.child_frame_id).xpos, at, atol=1e-9)


# --- LeRobotDataset


@pytest.mark.parametrize("torque", ["measured", "commanded", "motor"])
def test_a_dataset_restores_a_recording(tmp_path, torque):
    """The kind of torque is declared in it; a command is its action."""
    path = tmp_path / "set"
    assert write_dataset(path, motion(torque), JOINTS, "panda") == []
    out = read(path, torque=None, model_joints=JOINTS, n_joints=7)
    assert_same(out, motion(torque))
    assert "the clock is nominal" in out.notes[0]
    assert ("action" in json.loads((path / INFO).read_text())["features"]) == (torque == "commanded")
    assert [p.suffix for p in files_of(path)] == [".json", ".parquet"]


def test_a_jittering_clock_is_resampled_and_it_is_reported(tmp_path):
    true = motion()
    t = true.t + np.where(np.arange(ROWS) % 2, 4e-4, 0.0)  # steps of 1.4 and 0.6 ms
    (note,) = write_dataset(tmp_path / "set", replace(true, t=t), JOINTS, "panda")
    fps = json.loads((tmp_path / "set" / INFO).read_text())["fps"]
    assert note == f"resampled: a LeRobotDataset has the clock frame_index / fps, here {fps} Hz"
    assert fps == pytest.approx(1000, abs=1000 * 0.4 / (ROWS // 2 - 1) + 0.5)  # an end is 0.4 ms off, and rounding
    out = read(tmp_path / "set", torque=None, n_joints=7)
    assert out.duration == pytest.approx(
        replace(true, t=t).duration, abs=2 / fps
    )  # at most a step of each trajectory


def lerobot(code: str, *arguments: Path, home: Path) -> None:
    """Run code where lerobot is installed: it needs an older torch than r2s, so that is an environment of its own."""
    python = os.environ.get("R2S_LEROBOT_PYTHON") or (sys.executable if find_spec("lerobot") else None)
    if python is None:
        pytest.skip("no lerobot: pip install lerobot==0.4.4 in a venv of its own, R2S_LEROBOT_PYTHON=VENV/bin/python")
    head = "import sys\nimport numpy as np\nfrom lerobot.datasets.lerobot_dataset import LeRobotDataset\n"
    env = {"HF_HOME": str(home), "HF_HUB_OFFLINE": "1"}  # LeRobot reads its folders at import
    subprocess.run([python, "-c", head + code, *arguments], check=True, env=env)


def test_lerobot_opens_a_dataset(tmp_path):
    write_dataset(tmp_path / "set", true := motion("commanded"), JOINTS, "panda")
    code = (
        "d = LeRobotDataset('r2s/set', root=sys.argv[1], delta_timestamps={'action': [0, 0.001]})\n"
        "assert (d.num_episodes, d.fps) == (2, 1000) and d[0]['task'] == 'recording'\n"
        "np.save(sys.argv[2], np.stack([np.r_[x['observation.state'], x['action'][0]] for x in d]))"
    )
    lerobot(code, tmp_path / "set", tmp_path / "x.npy", home=tmp_path / "home")
    expected = np.hstack([true.q, true.dq, true.tau]).astype(np.float32)
    np.testing.assert_array_equal(np.load(tmp_path / "x.npy"), expected)


def test_a_dataset_of_lerobot_is_read(tmp_path):
    """Made with its own recorder: two episodes, a gripper, goals as action."""
    true = motion()
    np.savez(tmp_path / "x.npz", q=np.c_[true.q, 0 * true.t], tau=np.c_[true.tau, 0 * true.t], k=true.trajectory)
    code = (
        "x, names = np.load(sys.argv[1]), [f'joint{j}' for j in range(1, 8)] + ['gripper']\n"
        "kinds = {'observation.state': 'pos', 'observation.effort': 'effort', 'action': 'pos'}\n"
        "make = lambda kind: {'dtype': 'float32', 'shape': (8,), 'names': [f'{n}.{kind}' for n in names]}\n"
        "features = {k: make(kind) for k, kind in kinds.items()}\n"
        "d = LeRobotDataset.create('a/b', 50, features, root=sys.argv[2], use_videos=False)\n"
        "q, tau = x['q'].astype(np.float32), x['tau'].astype(np.float32)\n"
        "for k in (0, 1):\n"
        "    for i in np.flatnonzero(x['k'] == k):\n"
        "        frame = {'observation.state': q[i], 'observation.effort': tau[i], 'action': q[i]}\n"
        "        d.add_frame({**frame, 'task': 'move'})\n"
        "    d.save_episode()\n"
        "d.finalize()"
    )
    lerobot(code, tmp_path / "x.npz", tmp_path / "set", home=tmp_path / "home")
    out = read(tmp_path / "set", torque="measured", model_joints=JOINTS, n_joints=7)
    np.testing.assert_array_equal(out.q, true.q.astype(np.float32))
    np.testing.assert_array_equal(out.tau, true.tau.astype(np.float32))
    np.testing.assert_array_equal(out.trajectory, true.trajectory)
    assert out.rate_hz == pytest.approx(50)


def foreign(folder: Path, features: dict, fps=30, version="v3.0", names=None, rows=ROWS, width=None) -> Path:
    """Write a dataset of another program: {feature: (T, k)}, {feature: names of elements}; declare rows, width."""
    (folder / "data/chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    table = {k: list(x) for k, x in features.items()}
    table |= {"frame_index": np.arange(ROWS), "episode_index": np.zeros(ROWS, int)}
    table["timestamp"] = (table["frame_index"] / fps).astype(np.float32)
    pd.DataFrame(table).to_parquet(folder / "data/chunk-000/file-000.parquet")
    described = {
        k: {"dtype": "float32", "shape": [width or x.shape[1]], "names": (names or {}).get(k)}
        for k, x in features.items()
    }
    described["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    described["observation.images.top"] = {"dtype": "video", "shape": [480, 640, 3], "names": ["h", "w", "c"]}
    info = {"codebase_version": version, "fps": fps, "total_frames": rows, "features": described}
    (folder / INFO).write_text(json.dumps(info))
    return folder


@pytest.mark.parametrize(("late_s", "clock"), [(0.0, "nominal"), (1e-3, "timestamp")])
def test_the_clock_is_nominal_up_to_the_rounding_of_a_timestamp(tmp_path, late_s, clock):
    """Float32 stamps are off by up to 0.24 ms after two hours; another millisecond is the dataset's own clock."""
    path = foreign(tmp_path / "a", EFFORT)
    frames = path / "data/chunk-000/file-000.parquet"
    index = 30 * 7200 + np.arange(ROWS)
    stamp = (index / 30 + late_s * (index % 2)).astype(np.float32)
    pd.read_parquet(frames).assign(frame_index=index, timestamp=stamp).to_parquet(frames)
    assert clock in read(path, torque="measured", n_joints=7).notes[0]


def test_foreign_names_units_and_grippers(tmp_path):
    """Joints in another order, degrees by name, a gripper on both features; velocity is derived."""
    true, order = motion(), [6, 0, 1, 2, 3, 4, 5]
    wide = {
        "observation.state": np.rad2deg(true.q[:, order]),
        "observation.effort": true.tau[:, order],
        "action": true.q[:, order],  # a goal: angles
    }
    features = {k: np.hstack([x, np.ones((ROWS, 1))]).astype(np.float32) for k, x in wide.items()}
    joints = [*(JOINTS[j] for j in order), "gripper"]
    names = {
        "observation.state": {"motors": [f"{j}.pos_deg" for j in joints]},
        "observation.effort": [f"{j}.effort" for j in joints],
        "action": [f"{j}.pos" for j in joints],
    }
    out = read(foreign(tmp_path / "a", features, names=names), torque="measured", model_joints=JOINTS, n_joints=7)
    np.testing.assert_allclose(out.q, true.q, atol=180 * FLOAT32)
    np.testing.assert_array_equal(out.tau, true.tau.astype(np.float32))
    assert out.rate_hz == pytest.approx(30)
    assert "q from observation.state, tau from observation.effort" in out.notes[0]


def test_elements_without_names_are_numbered(tmp_path):
    true = motion()
    features = {"observation.state": true.q, "observation.velocity": true.dq, "observation.torque": true.tau}
    features = {k: x.astype(np.float32) for k, x in features.items()}
    out = read(foreign(tmp_path / "a", features), torque="measured", model_joints=JOINTS, n_joints=7)
    for x, name in ((out.q, "state"), (out.dq, "velocity"), (out.tau, "torque")):
        np.testing.assert_array_equal(x, features[f"observation.{name}"])


def test_currents_need_a_torque_constant(tmp_path):
    true = motion()
    features = {"observation.state": true.q.astype(np.float32), "observation.current": true.tau.astype(np.float32)}
    path = foreign(tmp_path / "a", features)
    with pytest.raises(UserError, match="is a current"):
        read(path, torque="motor", n_joints=7)
    out = read(path, torque="motor", torque_constant=2.0, n_joints=7)
    np.testing.assert_array_equal(out.tau, 2 * features["observation.current"].astype(float))


STATE = {"observation.state": np.zeros((ROWS, 7), np.float32)}
EFFORT = {**STATE, "observation.effort": np.ones((ROWS, 7), np.float32)}


@pytest.mark.parametrize(
    ("features", "how", "edit", "expected"),
    [
        (STATE, {}, None, "no torque in this dataset: features observation.state, timestamp, observation.images.top"),
        ({"observation.effort": STATE["observation.state"]}, {}, None, "no joint angles in this dataset"),
        (EFFORT, {"version": "v2.1"}, None, "expected codebase_version v3.x, got v2.1"),
        (EFFORT, {"fps": -1}, None, "expected fps > 0"),
        (EFFORT, {}, lambda p: (p / INFO).write_text("{"), "meta/info.json is damaged"),
        (EFFORT, {}, lambda p: (p / "data/chunk-000/file-000.parquet").unlink(), "not downloaded whole"),
        (EFFORT, {}, lambda p: (p / "data/chunk-000/file-000.parquet").write_bytes(b"PAR1"), "cannot be read"),
        (EFFORT, {"rows": 2 * ROWS}, None, "expected 120 frames, as meta/info.json says, got 60"),
        (EFFORT, {"width": 6}, None, "observation.state: expected 6 values a frame (meta/info.json), got 7"),
        (EFFORT, {"fps": 4}, None, "raise max_gap_s"),
    ],
)
def test_a_bad_dataset_is_refused_in_one_line(tmp_path, features, how, edit, expected):
    path = foreign(tmp_path / "a", features, **how)
    if edit:
        edit(path)
    with pytest.raises(UserError) as caught:
        read(path, torque="measured", n_joints=7)
    assert expected in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


# --- r2s convert


@pytest.mark.long
def test_convert_writes_both_from_a_run_folder(tmp_path, capsys, monkeypatch):
    """The plan beside a recording becomes /reference; a dataset converts on; r2s -> each -> r2s agrees."""
    monkeypatch.chdir(tmp_path)
    true = motion("commanded", split=False)
    true.save("train.npz")
    Excitation(true.t, true.q, true.dq, 0 * true.q).save("excitation_train.csv")
    run_command(["convert", "train.npz", "to=a.mcap"])
    run_command(["convert", "train.npz", "to=set"])
    run_command(["convert", "set", "to=b.mcap", "robot=panda"])
    assert capsys.readouterr().out.count("written: ") == 3
    assert len(messages(tmp_path / "a.mcap", "/reference")) == 1
    for name in ("a.mcap", "b.mcap", "set"):
        out = read(name, torque="commanded", model_joints=JOINTS)
        assert_same(out, true)


@pytest.mark.long
def test_the_commands_of_the_reference(tmp_path, monkeypatch):
    """docs/reference/commands.md: FILE is a CSV in it."""
    monkeypatch.chdir(tmp_path)
    true = motion(split=False)
    head = ",".join(["t", *(f"{name}{j}" for name in ("q", "dq", "tau_J") for j in range(1, 8))])
    table = np.column_stack([true.t, true.q, true.dq, true.tau])
    np.savetxt("log.csv", table, fmt="%.17g", delimiter=",", header=head, comments="")
    lines = [x for x in in_blocks(ROOT / "docs/reference/commands.md") if x.startswith("python run.py convert ")]
    assert len(lines) == 2
    for line in lines:
        words = line.replace("FILE", "log.csv").split()[2:]
        run_command(words)
        out = read(next(w for w in words if w.startswith("to=")).removeprefix("to="), torque="measured", n_joints=7)
        assert_same(out, true)


@pytest.mark.long
def test_convert_writes_the_episodes_of_a_transfer(tmp_path):
    episodes, steps = 3, 20
    rng = np.random.default_rng(0)
    x = {k: rng.normal(size=(episodes, steps, n)) for k, n in (("q", 7), ("dq", 7), ("tau", 7), ("ee", 3))}
    x |= {"t": 0.02 * np.arange(1, steps + 1), "goal": rng.normal(size=(episodes, 3))}
    np.savez(tmp_path / "episodes_twin.npz", **x, reward=rng.normal(size=(episodes, steps)))
    true, more = read_episodes(tmp_path / "episodes_twin.npz")
    for to in ("a.mcap", "set"):
        run_command(["convert", str(tmp_path / "episodes_twin.npz"), f"to={tmp_path / to}", "robot=panda"])
        assert_same(read(tmp_path / to, torque="commanded", model_joints=JOINTS), true)
    frame = pd.read_parquet(tmp_path / "set/data")
    np.testing.assert_array_equal(np.stack(frame["observation.ee"]), more["observation.ee"].astype(np.float32))
    np.testing.assert_array_equal(np.stack(frame["observation.goal"])[steps - 1], x["goal"][0].astype(np.float32))


@pytest.mark.long
def test_a_wrong_conversion_is_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    motion().save("a.npz")
    np.savez("episodes_twin.npz", t=np.zeros(3))
    assert one_line("convert", "a.npz", "to=a.bag").startswith("to: expected FILE.mcap, or a folder")
    assert one_line("convert", "a.npz", "to=a.npz").startswith("to: expected FILE.mcap")
    assert one_line("convert", "a.npz", "to=x", "algo=td3").startswith("convert: expected robot=, data=")
    assert "got data.torque=motor" in one_line("convert", "a.npz", "to=x", "data.torque=motor")
    assert "expected 6 joints" in one_line("convert", "a.npz", "to=x.mcap", "robot=ur10e")
    assert "no file b.npz; did you mean 'a.npz'?" in one_line("convert", "b.npz", "to=x")
    assert "expected episodes of a transfer" in one_line("convert", "episodes_twin.npz", "to=x")
    run_command(["convert", "a.npz", "to=x"])
    assert one_line("convert", "a.npz", "to=x") == "to: x exists"
    assert {p.name for p in tmp_path.iterdir()} == {"a.npz", "episodes_twin.npz", "x"}


@pytest.mark.parametrize("name", ["iiwa14", "kinova_gen3", "ur10e", "xarm7"])
def test_every_robot_has_frames_and_a_description(tmp_path, name):
    robot = load_robot(**conf(f"robot/{name}"))
    t = 1e-3 * np.arange(ROWS)
    q = np.tile(np.clip(0, robot.q_min, robot.q_max), (ROWS, 1)) + 0.1 * t[:, None]
    recording = Recording(t, q, 0.1 + 0 * q, 1 + q, "motor")
    write_mcap(tmp_path / "a.mcap", robot, recording, nominal_dynamics(robot, phi1=1.0, phi2=10.0, phi3=0.0))
    (frames, *_) = messages(tmp_path / "a.mcap", "/tf")
    text = messages(tmp_path / "a.mcap", "/robot_description")[0].data
    assert all(f'<link name="{x.child_frame_id}"' in text for x in frames.transforms)


@pytest.mark.long
@pytest.mark.parametrize("stage", ["identify", "transfer"])
def test_a_run_folder_names_the_arm(tmp_path, stage):
    """With friction and inertia of its joints; of a transfer, policy.yaml names the arm, config.yaml the default."""
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        own = OmegaConf.to_yaml(compose("config", ["robot=ur10e"]))
        default = OmegaConf.to_yaml(compose("config", ["stage=transfer"]))
    (tmp_path / "config.yaml").write_text(own if stage == "identify" else default)
    if stage == "transfer":
        (tmp_path / "policy.yaml").write_text(own)
    true = motion("commanded", split=False)
    replace(true, q=true.q[:, :6], dq=true.dq[:, :6], tau=true.tau[:, :6]).save(tmp_path / "train.npz")
    run_command(["convert", str(tmp_path / "train.npz"), f"to={tmp_path / 'set'}"])
    info = json.loads((tmp_path / "set" / INFO).read_text())
    assert info["robot_type"] == "ur10e"
    assert [len(info["features"]["action"][key]) for key in ("names", "shape")] == [6, 1]
    run_command(["convert", str(tmp_path / "train.npz"), f"to={tmp_path / 'a.mcap'}"])
    assert robot_of([tmp_path, tmp_path]).name == "ur10e"
