"""stage=watch: listens to an arm at work: what it carries, when that changes, how its friction drifts."""

from dataclasses import replace

from r2s.errors import Stopped, UserError, check_number, nearest
from r2s.files import located
from r2s.stages.adapting import calibrated
from r2s.stages.build import called, check_source, make_dynamics, make_robot, open_run, opened_source, plain

WHY = {
    "arm": "only data=arm moves an arm",
    "friction": "calibration= says what friction is",
    "inertia": "calibration= says what the links are",
}
CALM = 0.6  # of the speed and acceleration limits, of the motion that is made for an arm that may carry something


def reads(cfg):
    """Return the keys of the config that this stage reads."""
    keys = {"robot", "calibration", "data", "watch"} | (set() if cfg.calibration else {"friction", "inertia"})
    return keys | ({"arm"} if cfg.data.kind == "arm" else set())


def heard(cfg, robot):
    """Return the recording of data=recording, or that of an arm that is moved for data.seconds."""
    from r2s.arm.interface import ArmStopped
    from r2s.arm.tracking import record
    from r2s.excitation.fourier import fourier
    from r2s.excitation.motion import load
    from r2s.progress import Progress

    if cfg.data.excitation:
        motion = load(cfg.data.excitation, robot)
    else:
        calm = replace(robot, dq_max=CALM * robot.dq_max, ddq_max=CALM * robot.ddq_max)
        motion = fourier(calm, duration=cfg.data.seconds, seed=cfg.data.excitation_seed)
    progress = Progress("listen to the arm")
    try:
        with opened_source(cfg, robot, 0) as arm:
            out = record(arm, motion, laden=True, progress=lambda k, n: progress(k / n, f"{k / 1000:.1f} s"))
    except ArmStopped as stop:
        if stop.recording is None:
            raise Stopped(f"while the arm was listened to: {stop}") from None
        progress.close(f"stopped: {stop}")
        return stop.recording
    progress.close(f"{out.duration:.1f} s of motion")
    return out


def from_file(cfg, robot):
    """Return the recording of data.path, which must be of commanded torque."""
    from r2s.recordings.readers import read

    if cfg.data.torque != "commanded":
        raise UserError(f"data.torque: {cfg.data.torque} is not allowed for stage=watch; commanded is")
    names = [robot.model(gravity=False).joint(i).name for i in range(robot.n)]
    told = {k: plain(cfg.data)[k] for k in ("torque", "columns", "max_gap_s", "topic", "joints")}
    path = located(cfg.data.path)
    if not path.exists():
        near = nearest(path.name, [p.name for p in path.parent.glob("*")] if path.parent.is_dir() else [])
        raise UserError(f"data.path: no such file: {path}{near}")
    return read(str(path), **told, n_joints=robot.n, model_joints=names if all(names) else None)


def watch(cfg, overrides):
    """Recording or arm -> watch.csv: payload, friction and offsets at every moment, with intervals, and figures."""
    from r2s.adaptation.listen import at_rate, estimator, listen, table, words
    from r2s.physics.payload import moment, payload_of
    from r2s.reporting.watch_page import watch_figures, watch_recording
    from r2s.stages.identify import Excitation, Simulated

    check_number("watch.every_s", cfg.watch.every_s, "(0, inf)")
    robot = make_robot(cfg)
    inputs, recording = [], None
    if cfg.data.kind == "recording":
        recording = at_rate(robot, from_file(cfg, robot))
        inputs = [str(located(cfg.data.path))]
    else:
        called(Simulated if cfg.data.kind == "simulated" else Excitation, "data", plain(cfg.data))
        if cfg.data.torque != "commanded":
            raise UserError(f"data.torque: {cfg.data.torque} is not allowed for stage=watch; commanded is")
        check_source(cfg, robot)
    dynamics, posterior, unloaded = make_dynamics(cfg, robot), None, None
    if cfg.calibration:
        dynamics, posterior, unloaded = calibrated(cfg.calibration, robot)
    if cfg.data.kind == "arm" and cfg.arm.get("load"):  # what the arm was told of is no surprise
        dynamics = replace(dynamics, told=moment(robot, payload_of(plain(cfg.arm)["load"], "arm.load")))
    parents = [str(cfg.calibration)] if cfg.calibration else []
    with open_run(cfg, overrides, inputs, parents=parents) as run:
        if recording is None:
            recording = heard(cfg, robot)
            recording.save(run.folder / "heard.npz")
        ear = estimator(robot, dynamics, posterior, unloaded)
        shown = [-float("inf")]

        def told(now):
            if now.changed:
                print(f"{now.t:7.2f} s  what the hand carries has changed")
            if now.t - shown[0] >= cfg.watch.every_s:
                print(words(now))
                shown[0] = now.t

        known = listen(robot, ear, recording, told)
        if not known:
            raise UserError(f"data: {recording.duration:g} s are too short to listen to")
        rows, last = table(known), known[-1]
        rows.to_csv(run.folder / "watch.csv", index=False, float_format="%.6g")
        finite = [None if c != c else round(float(c), 5) for c in (*last.centre, *last.centre_half)]
        run.summary(
            {
                "seconds": recording.duration,
                "mass_kg": last.mass,
                "mass_kg_half": last.mass_half,
                "centre_m": finite[:3],
                "centre_m_half": finite[3:],
                "inertia_kg_m2": last.tensor.tolist(),
                "friction": last.friction.tolist(),
                "friction_half": last.friction_half.tolist(),
                "offset_Nm": last.offset.tolist(),
                "offset_Nm_half": last.offset_half.tolist(),
                "rests": last.rests,
                "changes_s": ear.changes,
                "noise_from": "calibration" if unloaded else "priors",
            }
        )
        watch_figures(run.figure("payload"), run.figure("friction"), rows, ear.changes)
        watch_recording(run.folder / "recording.rrd", rows)
        print(words(last))
    print(f"written: {run.folder}")
