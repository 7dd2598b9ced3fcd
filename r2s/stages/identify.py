"""stage=identify: recording -> parameters.yaml, errors on training and validation motion, figures."""

import os
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from r2s.errors import Stopped, UserError, check_number
from r2s.files import located
from r2s.stages.build import (
    called,
    check_source,
    console,
    make_dynamics,
    make_robot,
    open_run,
    opened_source,
    part,
    plain,
)

KNOWN = 0.2  # share of a validation motion that may come in the training motion too, such as the way to a start
WHY = {
    "arm": "only data=arm moves an arm",
    "inertia": "calibration= says what the links are",
    "friction": "calibration= says what friction is; friction.family= may change its law",
}


def reads(cfg):
    """Return the keys of the config that this stage reads."""
    keys = {"robot", "calibration", "identify", "search", "data"}
    keys |= {"friction.family"} if cfg.calibration else {"friction", "inertia"}
    return keys | ({"arm"} if cfg.data.kind == "arm" else set())


@dataclass(frozen=True)
class Excitation:
    """What is recorded of an arm: data=arm, and with a known truth data=simulated.

    Attributes:
        torque: level of the torque that is kept, commanded or measured.
        seconds: of each of the two motions.
        excitation_seed: of the first motion, and 1 more of the second.
        excitation: file of a motion to follow instead of the first; None: one is made.
        ramp_poses: postures at which every joint's torque is ramped both ways; 0: none.

    Raises:
        UserError: a number outside its range.
    """

    kind: str
    torque: str
    seconds: float
    excitation_seed: int
    excitation: str | None
    ramp_poses: int

    def __post_init__(self):
        from r2s.excitation.fourier import LEAST_S, LONGEST_S

        check_number("data.seconds", self.seconds, f"[{LEAST_S:g}, {LONGEST_S:g}]")
        check_number("data.excitation_seed", self.excitation_seed, "[0, inf)", whole=True)
        check_number("data.ramp_poses", self.ramp_poses, "[0, inf)", whole=True)
        if self.torque not in ("commanded", "measured"):
            raise UserError(f"data.torque: '{self.torque}' is not allowed; commanded and measured are")


@dataclass(frozen=True)
class Simulated(Excitation):
    """An excitation of a simulated arm.

    Attributes:
        truth: what it is (`make_truth`). delay, lag: s, of its actuation.
        position_noise, velocity_noise: standard deviations of its sensors, rad and rad/s.
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
class File:
    """The user's own recording, data=recording; r2s/recordings/readers.py says what each means.

    Raises:
        UserError: a number outside its range.
    """

    kind: str
    path: str
    torque: str | None
    torque_constant: list[float] | float | None
    validation: str | None
    ramps: str | None
    period: float | None
    max_gap_s: float
    columns: dict[str, str | None]
    topic: str | None
    joints: list[str] | None

    def __post_init__(self):
        check_number("data.max_gap_s", self.max_gap_s, "(0, inf)")
        if self.period is not None:
            check_number("data.period", self.period, "(0, inf)")


def record_motion(cfg, robot, motion, k, label):
    """Return the k-th recording, of a motion; without one, of the best that was found for data.seconds."""
    from r2s.arm.tracking import record
    from r2s.excitation.fourier import fourier
    from r2s.progress import Progress

    progress = Progress(label)
    if motion is None:
        motion = fourier(
            robot, duration=cfg.data.seconds, seed=cfg.data.excitation_seed + k, gravity=cfg.data.torque == "measured"
        )
    with opened_source(cfg, robot, k) as arm:  # one client at a time, and the next recording is another
        out = record(arm, motion, torque=cfg.data.torque, progress=lambda k, n: progress(k / n, f"{k / 1000:.1f} s"))
    progress.close(f"{out.duration:.1f} s of motion")
    return motion, out


def ramp_poses(cfg, robot):
    """Return the postures (., n) rad at which joints are to be ramped; raise UserError where no way leads there."""
    from r2s.arm.ramp import check_ways, poses_about

    poses = poses_about(robot, cfg.data.ramp_poses if cfg.data.torque == "commanded" else 0)
    if len(poses):
        check_ways(robot, poses, what="data.ramp_poses")
    return poses


def record_ramps(cfg, robot):
    """Return the ramps of the breakaway protocol about the home posture, or None where none are asked for."""
    from r2s.arm.ramp import ramp
    from r2s.progress import Progress

    poses = ramp_poses(cfg, robot)
    if not len(poses):
        return None
    progress = Progress("ramp the joints until they move")
    with opened_source(cfg, robot, 2) as arm:
        out = ramp(arm, poses, progress=lambda k, n: progress(k / n, f"{k} ramps"))
    progress.close(f"{out.recording.duration:.1f} s of ramps")
    return out


def read_motion(robot, file, share):
    """Return training and validation motion of a `File`; they must not share motion.

    Args:
        share: of the recording that validates where there is no second one.
    """
    import numpy as np

    from r2s.identification.checks import check_recording
    from r2s.recordings.readers import read

    told = ("torque", "torque_constant", "columns", "period", "max_gap_s", "topic", "joints")
    how = {k: getattr(file, k) for k in told}
    names = [robot.model(gravity=False).joint(i).name for i in range(robot.n)]
    how |= {"n_joints": robot.n, "model_joints": names if all(names) else None}
    recording = read(file.path, **how)
    check_recording(robot, recording)
    if file.period is None and (again := recording.in_phase()) is not recording:
        recording = again
        if not file.validation:
            print(
                f"the motion repeats itself after {recording.period:.2f} s: what validates is held out in every "
                "repetition"
            )
    if not file.validation:
        return recording.split(share)
    if os.path.realpath(file.validation) == os.path.realpath(file.path):
        raise UserError("data.validation is the training file itself: it must hold other motion")
    validation = read(file.validation, **how)
    check_recording(robot, validation)
    rows = {row.tobytes() for row in np.column_stack([recording.q, recording.dq])}
    same = sum(row.tobytes() in rows for row in np.column_stack([validation.q, validation.dq]))
    if same > 0.01 * len(validation.t):
        raise UserError(
            f"data.validation: {same} of its {len(validation.t)} rows are rows of the training file; it must hold "
            "other motion"
        )
    if (known := validation.known_from(recording)) > KNOWN:
        raise UserError(
            f"data.validation: {100 * known:.0f} % of its motion is that of the training file, recorded again; it "
            "must hold other motion (to hold out a part of a repeated motion, leave data.validation=null)"
        )
    return recording, validation


def read_user_ramps(robot, file):
    """Return the ramps of a `File`; its columns are named as those of the recording."""
    from r2s.identification.checks import check_ramps
    from r2s.recordings.ramps import read_ramps

    columns = dict(file.columns)
    if file.torque != "commanded":
        columns["tau"] = None  # that names another torque; ramps are of the command
    ramps = read_ramps(file.ramps, columns=columns, n_joints=robot.n, max_gap_s=file.max_gap_s)
    check_ramps(robot, ramps)
    return ramps


def recorded(cfg, robot, run, motion):
    """Return training and validation motion and the ramps of an arm; a resumed run reads what it has recorded.

    Args:
        run: the run folder, which gets them. motion: the excitation to follow; None: one is made.

    Raises:
        Stopped: the arm was stopped. What it had recorded of that motion is <motion>_until_stop.npz.
    """
    from r2s.arm.interface import ArmStopped
    from r2s.recordings.ramps import read_ramps
    from r2s.recordings.readers import read

    def one(name, motion, k):
        path = run.folder / f"{name}.npz"
        if not path.is_file():
            try:
                motion, out = record_motion(cfg, robot, motion, k, f"record {name} motion")
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
        ramps = read_ramps(path) if path.is_file() else record_ramps(cfg, robot)
        if ramps is not None and not path.is_file():
            ramps.save(path)
    except ArmStopped as stop:
        there = [name for name in ("train", "validation") if (run.folder / f"{name}.npz").is_file()]
        kept = f"{' and '.join(there)} motion is kept, " if there else ""
        raise Stopped(f"while the arm was recorded: {stop}; {kept}resume={run.folder} goes on") from None
    return train, validation, ramps


def make_settings(cfg, torque):
    """Return the `Settings` of an identification from this level of torque."""
    from r2s.identification.settings import Settings

    words: dict[str, Any] = plain(cfg.identify)
    del words["validation_fraction"]
    for key in ("terms", "prior", "extra", "spare"):
        words[key] = words[key][torque]
    return called(Settings, "identify", words | {"family": cfg.friction.family})


@dataclass(frozen=True)
class Parts:
    """What an identification begins with. What a config says wrongly of it is said while they are made, before any
    folder. Of an arm `train`, `validation` and `ramps` are recorded later.
    """

    robot: Any
    nominal: Any
    searches: list[Any]
    inputs: list[Path | str]
    motion: Any = None
    train: Any = None
    validation: Any = None
    ramps: Any = None


def make_parts(cfg):
    """Return the parts of the identification that a config asks for; a real arm is not touched.

    Raises:
        UserError: it asks for none that there can be.
    """
    from r2s.excitation.motion import load
    from r2s.recordings.readers import files_of

    robot = make_robot(cfg)
    nominal = make_dynamics(cfg, robot)
    searches = [part(node, f"search.{k}") for k, node in enumerate(cfg.search)]
    check_number("identify.validation_fraction", cfg.identify.validation_fraction, "(0, 1)")
    if cfg.data.torque in cfg.identify.terms:
        make_settings(cfg, cfg.data.torque)
    if cfg.data.kind == "recording":
        own = {f.name for f in fields(File)}  # an experiment may set what other kinds of data have
        given = {k: v for k, v in plain(cfg.data).items() if k in own}
        given |= {k: str(located(given[k])) for k in ("path", "validation", "ramps") if given[k]}
        file = called(File, "data", given)
        train, validation = read_motion(robot, file, cfg.identify.validation_fraction)
        inputs: list[Path | str] = [f for p in (file.path, file.validation) if p for f in files_of(p)]
        ramps = read_user_ramps(robot, file) if file.ramps else None
        inputs += [file.ramps] if file.ramps else []
        return Parts(robot, nominal, searches, inputs, None, train, validation, ramps)
    called(Simulated if cfg.data.kind == "simulated" else Excitation, "data", plain(cfg.data))
    ramp_poses(cfg, robot)
    check_source(cfg, robot)
    if not cfg.data.excitation:
        return Parts(robot, nominal, searches, [])
    return Parts(robot, nominal, searches, [cfg.data.excitation], load(cfg.data.excitation, robot))


def identify(cfg, overrides):
    """Recording -> parameters.yaml, errors on training and validation motion, figures."""
    from r2s.identification.identify import identify as run_identify
    from r2s.identification.parameter_file import save_parameters
    from r2s.identification.prediction import prediction_errors
    from r2s.physics.description import write_description
    from r2s.progress import Progress
    from r2s.recordings.speed_noise import speed_noise
    from r2s.reporting import pages
    from r2s.reporting.identification_tables import identification_table

    made = make_parts(cfg)
    robot, nominal = made.robot, made.nominal
    train, validation, ramps = made.train, made.validation, made.ramps
    with open_run(cfg, overrides, made.inputs) as run:
        if cfg.data.kind != "recording":
            train, validation, ramps = recorded(cfg, robot, run, made.motion)
        nominal = replace(nominal, speed_noise=speed_noise([train, validation]))
        settings = make_settings(cfg, train.torque)
        progress = Progress("identify")

        def told(row):
            progress(
                row["done"] / row["total"],
                f"{row['search']}, {row['evaluations']} candidates, cost {row.get('cost', float('nan')):.4g}",
            )

        found = run_identify(
            robot,
            nominal,
            train,
            made.searches,
            settings,
            ramps=ramps,
            seed=cfg.seed,
            nthread=cfg.threads,
            report=told,
            memo=run.memo,
        )
        progress.close()
        how = {"window_s": settings.window_s, "cutoff_hz": settings.cutoff_hz}
        summary = {
            side: prediction_errors(robot, nominal, found.dynamics, data, **how, nthread=cfg.threads)
            for side, data in (("train", train), ("validation", validation))
        }
        source = {"recording": train.name, "torque": train.torque, "run": str(run.folder)}
        note = {
            "unseen_and_left_nominal": found.unseen,
            "decided_by_the_prior": [{"share_of_prior_left": round(s, 2), **v} for s, v in found.null_directions],
            "families_compared": found.families,
            "replays_refused": found.refused,
        }
        if found.edges is not None and found.edges.open:
            note["breakaway_unknown"] = found.edges.open
        save_parameters(run.folder / "parameters.yaml", *found.saved, source, note)
        found.history.to_csv(run.folder / "metrics.csv", index=False)
        for row in found.history.to_dict("records"):
            run.told("metrics", row)
        write_description(run.folder / "model", robot, found.dynamics)
        run.summary(summary)
        pages.identification(run, robot, nominal, found, validation, summary, **how)
        identification_table(console(), robot, found, summary)
    print(f"written: {run.folder}")
