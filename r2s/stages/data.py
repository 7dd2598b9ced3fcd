"""Read or record the training motion, validation motion and breakaway ramps of stage=identify."""

from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from r2s.errors import Stopped, UserError, check_number, choices
from r2s.files import located
from r2s.stages.build import opened_source, within_speed_share
from r2s.stages.parts import called, plain

SLOW_MS = 1.5  # ms; r2s prints an assumed hold of a command that is longer than this
LEAST_PRESSES = 4
MAX_OVERLAP = 0.2  # largest share of a validation motion that may repeat training motion, for example in the approach


@dataclass(frozen=True)
class ArmData:
    """Settings of data=arm: the motion to record on an arm.

    Attributes:
        torque: kind of the recorded torque, "commanded" or "measured".
        seconds: duration of the training motion and of the validation motion, s.
        excitation_seed: seed of the training motion; the validation motion has the next seed.
        excitation: file of the training motion; if None, r2s optimizes a training motion.
        ramp_poses: number of postures in which r2s records ramps of every joint in both directions; 0 means no ramps.
        presses: number of contact motions (press and slide); if 0, the arm moves without contact instead.
        gears: whether to record, instead of all other motions, each joint sliding slowly under a multisine torque.
        press_point, press_normal: point (3,) m and normal (3,) of the nominal plane; if None, a work table below the
            tip in the home posture.

    Raises:
        UserError: a value is outside its range.
    """

    kind: str
    torque: str
    seconds: float
    excitation_seed: int
    excitation: str | None
    ramp_poses: int
    presses: int = field(default=0, kw_only=True)
    gears: bool = field(default=False, kw_only=True)
    press_point: list[float] | None = field(default=None, kw_only=True)
    press_normal: list[float] | None = field(default=None, kw_only=True)

    def __post_init__(self):
        from r2s.excitation.fourier import LEAST_S, LONGEST_S

        check_number("data.seconds", self.seconds, f"[{LEAST_S:g}, {LONGEST_S:g}]")
        check_number("data.excitation_seed", self.excitation_seed, "[0, inf)", whole=True)
        check_number("data.ramp_poses", self.ramp_poses, "[0, inf)", whole=True)
        check_number("data.presses", self.presses, "[0, inf)", whole=True)
        if 0 < self.presses < LEAST_PRESSES:
            raise UserError(
                f"data.presses: expected 0, or at least {LEAST_PRESSES}: three places determine a plane and "
                f"one validates, got {self.presses}"
            )
        if self.torque not in ("commanded", "measured"):
            raise UserError(f"data.torque: expected commanded or measured, got '{self.torque}'")


@dataclass(frozen=True)
class SimulatedData(ArmData):
    """Settings of data=simulated: the motion to record on a simulated arm with known dynamics.

    Attributes:
        truth: name of the true dynamics, see `make_truth`. delay, lag: delay and lag of the actuation, s.
        position_noise, velocity_noise: standard deviations of the sensor noise, rad and rad/s.
    """

    truth: str
    delay: float
    lag: float
    position_noise: float
    velocity_noise: float

    def __post_init__(self):
        super().__post_init__()
        for name in ("delay", "lag", "position_noise", "velocity_noise"):
            check_number(f"data.{name}", getattr(self, name), "[0, inf)")


@dataclass(frozen=True)
class FileData:
    """Settings of data=recording, which reads files; conf/data/recording.yaml explains each setting.

    Raises:
        UserError: a number is outside its range.
    """

    kind: str
    path: str
    torque: str | None
    torque_constant: list[float] | float | None
    validation: str | None
    ramps: str | None
    period: float | None
    max_gap_s: float | None
    columns: dict[str, str | None]
    topic: str | None
    joints: list[str] | None
    command_hz: float | None = None
    contact: str | None = None
    contact_validation: str | None = None
    loaded: str | None = None
    gears: str | None = None
    declared_payload: Any = None
    payload: Any = None

    def __post_init__(self):
        if self.max_gap_s is not None:
            check_number("data.max_gap_s", self.max_gap_s, "(0, inf)")
        if self.period is not None:
            check_number("data.period", self.period, "(0, inf)")
        if self.command_hz is not None:
            check_number("data.command_hz", self.command_hz, "(0, inf)")

    def held(self, recording):
        """Return the recording with the hold of its commands set to 1 / data.command_hz.

        If data.command_hz is unset, assume that each command holds until the next row; print a hold above SLOW_MS.
        """
        if self.command_hz is not None:
            return replace(recording, command_period=1 / self.command_hz)
        if recording.torque == "commanded" and (hold := 1e3 / recording.rate_hz) > SLOW_MS:
            print(f"commands are held for {hold:.3g} ms, from row to row; data.command_hz= states another rate")
        return recording

    @property
    def files(self) -> list[Path | str]:
        """Files that contain the training motion, the validation motion and the ramps."""
        from r2s.recordings.readers import files_of

        motion = [f for path in (self.path, self.validation) if path for f in files_of(path)]
        return [*motion, *([self.ramps] if self.ramps else [])]


def file_data(cfg, path=None):
    """Return the `FileData` of a config; ignore keys of data=arm and data=simulated.

    path: file to read instead of data.path; data.path may then be missing.
    """
    from omegaconf import OmegaConf

    own = {f.name for f in fields(FileData)}
    node = cfg.data if path is None else OmegaConf.merge(cfg.data, {"path": path})
    given = {k: v for k, v in plain(node).items() if k in own}
    for key in ("path", "validation"):
        if isinstance(given[key], list | dict):
            raise UserError(f"data.{key}: expected one file here, got {len(given[key])}; give it as data.{key}=FILE")
    for key in ("contact", "contact_validation", "loaded", "gears"):
        if given.get(key) and not isinstance(given[key], str):
            raise UserError(f"data.{key}: expected a file, got {given[key]!r}")
    given |= {k: str(located(str(given[k]))) for k in ("path", "validation", "ramps") if given[k]}
    if given.get("contact") and given["torque"] is None:
        given["torque"] = "commanded"
    return called(FileData, "data", given)


def read_file(robot, file, path, torque=None):
    """Return the recording in `path`, read with the settings of a `FileData`; `torque` replaces data.torque.

    Print what the reader repaired. If data.path is a bag but `path` is not, ignore data.topic and data.joints.
    """
    from r2s.recordings.readers import is_bag, read

    file = file if torque is None else replace(file, torque=torque)
    keys = ("torque", "torque_constant", "columns", "period", "max_gap_s", "topic", "joints")
    how = {k: getattr(file, k) for k in keys}
    if path != file.path and file.path and is_bag(Path(file.path)) and not is_bag(Path(path)):
        how |= {"topic": None, "joints": None}
    out = read(path, **how, **of_joints(robot))
    for note in out.notes:
        print(f"{path}: {note}")
    return file.held(out)


def of_joints(robot):
    """Return the arguments of `readers.read` that describe the robot's joints: number, names and position limits."""
    names = [robot.model(gravity=False).joint(i).name for i in range(robot.n)]
    limits = robot.q_min, robot.q_max
    return {"n_joints": robot.n, "model_joints": names if all(names) else None, "limits": limits}


def read_episodes(path):
    """Return a transfer's episodes as a recording of commanded torque, and further signals {LeRobot feature: rows}.

    Raises:
        UserError: the file has no episodes of a transfer.
    """
    import numpy as np

    from r2s.files import DAMAGED
    from r2s.recordings.recording import Recording

    try:
        with np.load(path, allow_pickle=False) as saved:
            e = {k: saved[k] for k in ("t", "q", "dq", "tau", "ee", "goal", "reward")}
        count, steps = e["q"].shape[:2]
        goal = np.broadcast_to(e["goal"] if e["goal"].ndim == 3 else e["goal"][:, None], e["ee"].shape)
        more = {"observation.ee": e["ee"], "observation.goal": goal, "next.reward": e["reward"][..., None]}
        rows = {
            k: x.reshape(count * steps, -1) for k, x in {"q": e["q"], "dq": e["dq"], "tau": e["tau"], **more}.items()
        }
        index, t = np.repeat(np.arange(count), steps), np.tile(e["t"], count)
        arrays = {k: rows.pop(k) for k in ("q", "dq", "tau")}
        return Recording(t=t, **arrays, torque="commanded", trajectory=index, name=path.stem), rows
    except DAMAGED as error:
        raise UserError(f"{path}: expected episodes of a transfer: {' '.join(str(error).split())[:150]}") from None


def read_reference(path, n):
    """Return the reference motion {t, q, dq, ddq} for a recording of stage=identify; None if no motion was saved."""
    import numpy as np

    from r2s.recordings.csv_table import read_csv

    if not (motion := path.parent / f"excitation_{path.stem}.csv").is_file():
        return None
    table = read_csv(motion)
    columns = {x: [f"{x}{j}" for j in range(1, n + 1)] for x in ("q", "dq", "ddq")}
    if missing := [c for names in columns.values() for c in names if c not in table]:
        raise UserError(f"{motion}: no column '{missing[0]}'; columns: {choices(table)}")
    return {"t": table["t"], **{x: np.stack([table[c] for c in names], axis=1) for x, names in columns.items()}}


def check_other_motion(recording, validation):
    """Raise UserError if a validation recording repeats rows or motion of the training recording."""
    import numpy as np

    mix = np.random.default_rng(0).standard_normal((2, recording.q.shape[1]))  # equal rows have equal weighted sums
    sums = [np.einsum("tn,n", r.q, mix[0]) + np.einsum("tn,n", r.dq, mix[1]) for r in (validation, recording)]
    same = int(np.isin(*sums).sum())
    if same > 0.01 * len(validation.t):
        raise UserError(
            f"data.validation: {same} of its {len(validation.t)} rows are rows of the training file; it must hold "
            "other motion"
        )
    if (overlap := validation.overlap(recording)) > MAX_OVERLAP:
        raise UserError(
            f"data.validation: {100 * overlap:.0f} % of its motion repeats the training file; it must hold other "
            "motion (to hold out a part of a periodic motion, leave data.validation=null)"
        )


def check_cutoff(cutoff_hz, recordings):
    """Raise UserError unless identify.cutoff_hz is below 500 Hz and below the Nyquist frequency of each recording."""
    from r2s.identification.checks import check_rate

    check_number("identify.cutoff_hz", cutoff_hz, "(0, 500)")  # r2s works at 1 kHz
    for recording in recordings:
        check_rate(cutoff_hz, recording)


def read_user_ramps(robot, file):
    """Return the ramps in the file `file.ramps`, read with `file.columns`; return None if `file.ramps` is unset."""
    from r2s.identification.checks import check_ramps
    from r2s.recordings.ramps import read_ramps
    from r2s.recordings.readers import is_bag

    if not file.ramps:
        return None
    columns = dict(file.columns)
    if file.torque != "commanded":
        columns["tau"] = None  # ramps need commanded torque; this column names another torque
    how = of_joints(robot) | {"columns": columns, "max_gap_s": file.max_gap_s}
    ramps = read_ramps(file.ramps, joints=None if is_bag(Path(file.path)) else file.joints, **how)
    check_ramps(robot, ramps)
    return replace(ramps, recording=file.held(ramps.recording))


def check_data(cfg):
    """Raise UserError if the settings of data=arm or data=simulated are out of range."""
    called(SimulatedData if cfg.data.kind == "simulated" else ArmData, "data", plain(cfg.data))


def ramp_poses(cfg, robot):
    """Return the postures (k, n) rad of the ramps; raise UserError if no safe path leads to a posture."""
    from r2s.arm.ramp import check_paths, poses_about

    poses = poses_about(robot, cfg.data.ramp_poses if cfg.data.torque == "commanded" else 0)
    if len(poses):
        check_paths(robot, poses, what="data.ramp_poses")
    return poses


def record_motion(cfg, robot, motion, k, label, timing):
    """Record a motion on the arm; return the motion and the recording. If `motion` is None, optimize a motion.

    k: number of this recording (0, 1, ...). timing: object that stores the durations of the control cycles.
    """
    from r2s.arm.recorder import record
    from r2s.excitation.fourier import fourier
    from r2s.progress import Progress

    progress = Progress(label, in_cycle=True)
    if motion is None:
        seed, gravity = cfg.data.excitation_seed + k, cfg.data.torque == "measured"
        motion = fourier(within_speed_share(cfg, robot), duration=cfg.data.seconds, seed=seed, gravity=gravity)
    with opened_source(cfg, robot, k) as arm:  # an arm accepts one client at a time
        how = {"torque": cfg.data.torque, "timing": timing}
        out = record(arm, motion, **how, progress=lambda k, n: progress(k / n, f"{k / 1000:.1f} s"))
    progress.close(f"{out.duration:.1f} s of motion")
    return motion, out


def record_ramps(cfg, robot, timing):
    """Record breakaway ramps in postures near home; return the ramps, or None if the settings ask for no ramps.

    timing: object that stores the durations of the control cycles.
    """
    from r2s.arm.ramp import ramp
    from r2s.progress import Progress

    poses = ramp_poses(cfg, robot)
    if not len(poses):
        return None
    progress = Progress("ramp the joints until they move", in_cycle=True)
    with opened_source(cfg, robot, 2) as arm:
        out = ramp(arm, poses, timing=timing, progress=lambda k, n: progress(k / n, f"{k} ramps"))
    progress.close(f"{out.recording.duration:.1f} s of ramps")
    return out


def record_arm(cfg, robot, run, motion):
    """Record and return training motion, validation motion and ramps of an arm.

    A resumed run reads its existing recordings. timing.csv lists the cycle durations, even if the arm stopped.

    Args:
        run: open run folder for the files. motion: training motion; if None, r2s optimizes a motion.

    Raises:
        Stopped: the arm stopped; <name>_until_stop.npz contains the motion up to the stop.
    """
    from r2s.arm.interface import ArmStopped
    from r2s.arm.realtime import Timing
    from r2s.recordings.ramps import read_ramps
    from r2s.recordings.readers import read

    @contextmanager
    def timed(name):
        timing = Timing()
        try:
            yield timing
        finally:
            for row in timing.table():
                run.log("timing", {"motion": name, **row})

    def one(name, motion, k):
        path = run.folder / f"{name}.npz"
        if not path.is_file():
            try:
                with timed(name) as timing:
                    motion, out = record_motion(cfg, robot, motion, k, f"record {name} motion", timing)
            except ArmStopped as stop:
                if stop.recording is not None:
                    stop.recording.save(run.folder / f"{name}_until_stop.npz")
                raise
            motion.save(run.folder / f"excitation_{name}.csv")
            out.save(path)
        return read(path, torque=cfg.data.torque)

    try:
        train = one("train", motion, 0)
        validation = one("validation", None, 1)
        path = run.folder / "ramps.npz"
        with timed("ramps") as timing:
            ramps = read_ramps(path) if path.is_file() else record_ramps(cfg, robot, timing)
        if ramps is not None and not path.is_file():
            ramps.save(path)
    except ArmStopped as stop:
        done = [name for name in ("train", "validation") if (run.folder / f"{name}.npz").is_file()]
        kept = f"{' and '.join(done)} motion is kept, " if done else ""
        raise Stopped(f"while the arm was recorded: {stop}; {kept}resume={run.folder} goes on") from None
    return train, validation, ramps
