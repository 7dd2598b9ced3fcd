"""stage=estimate: estimate payload, friction, offsets and external wrench from an arm's motion or a recording."""

from dataclasses import replace

from r2s.errors import Stopped, UserError, check_number
from r2s.files import located
from r2s.stages.adapter_factory import TORQUE, calibrated, free_recordings, with_declared_payload
from r2s.stages.build import (
    check_source,
    make_dynamics,
    make_robot,
    open_run,
    opened_source,
    within_speed_share,
)
from r2s.stages.data import check_data, file_data, read_file
from r2s.stages.parts import plain
from r2s.stages.payload import torque_of_calibration

WHY = {
    "arm": "only data=arm moves an arm",
    "friction": "calibration= sets the friction",
    "inertia": "calibration= sets the links",
}
LIMIT_SHARE = 0.6  # share of the speed and acceleration limits that a motion with an unknown payload may use


def reads(cfg):
    """Return the config keys that stage=estimate reads."""
    keys = {"robot", "calibration", "data", "estimate"} | (set() if cfg.calibration else {"friction", "inertia"})
    return keys | ({"arm"} if cfg.data.kind == "arm" else set())


def estimate(cfg, overrides):
    """Estimate payload, friction, offsets and wrench, with intervals; write estimate.csv, wrench.csv and figures."""
    from r2s.adaptation.adapters import AdapterContext
    from r2s.adaptation.estimator import Estimator
    from r2s.adaptation.offline_estimation import format_estimate, table
    from r2s.adaptation.wrench import contacts, observe_recording
    from r2s.reporting.estimate_page import draw_estimate, write_estimate_recording
    from r2s.reporting.wrench_page import draw_wrench

    check_number("estimate.every_s", cfg.estimate.every_s, "(0, inf)")
    robot = make_robot(cfg)
    recording = given_recording(cfg, robot)
    dynamics, posterior, unloaded = make_dynamics(cfg, robot), None, None
    if cfg.calibration:
        dynamics, posterior, unloaded = calibrated_by_commands(cfg, robot)
    dynamics = compensated(cfg, robot, dynamics)
    surface = identified_surface(cfg, robot)
    inputs = [str(located(cfg.data.path))] if recording is not None else []
    with open_run(cfg, overrides, inputs) as run:
        stopped = None
        if recording is None:
            recording, stopped = record_arm(cfg, robot)
            recording.save(run.folder / ("recording_until_stop.npz" if stopped else "recording.npz"))
        estimator = Estimator(*AdapterContext(robot, dynamics, posterior, unloaded).corrected)
        observer, thresholds_from = wrench_observer(cfg, robot, dynamics, surface)
        print(
            "compensated payload: up to {:g} kg at {:g} m (robot.payload_max, robot.payload_far)".format(
                *robot.payload_max
            )
        )
        printed, estimates = -float("inf"), []

        def report(now):
            nonlocal printed
            estimates.append(now)
            if now.changed:
                print(f"{now.t:7.2f} s  payload changed")
            if now.t - printed >= cfg.estimate.every_s:
                print(format_estimate(now))
                printed = now.t

        wrench = observe_recording(robot, observer, recording, estimator, report)
        wrench.to_csv(run.folder / "wrench.csv", index=False, float_format="%.6g")
        if not estimates:
            raise UserError(f"data: {recording.duration:g} s are too short for an estimate")
        rows, last, touched = table(estimates), estimates[-1], contacts(wrench)
        at = [e.cycle - 1 for e in estimates]
        rows = rows.join(wrench.drop(columns="t").iloc[at].reset_index(drop=True))
        rows.to_csv(run.folder / "estimate.csv", index=False, float_format="%.6g")
        source = "calibration" if unloaded else "priors"
        run.summary(
            {"seconds": recording.duration}
            | summary(last, estimator.changes)
            | {"noise_from": source}
            | {"contacts": touched, "contact_thresholds": observer.thresholds.tolist()}
            | {"thresholds_from": thresholds_from}
            | ({} if surface is None else {"surface_trusted": observer.trusted})
        )
        draw_estimate(run.figure("payload"), run.figure("friction"), rows, estimator.changes)
        draw_wrench(run.figure("wrench"), wrench, recording, touched)
        write_estimate_recording(run.folder / "recording.rrd", robot, recording, rows, wrench)
        print(format_estimate(last))
        print(format_contacts(touched))
        if stopped:
            raise Stopped(f"while the arm was recorded: {stopped}; the estimate is of the motion before")
    print(f"written: {run.folder}")


def calibrated_by_commands(cfg, robot):
    """Return the result of `calibrated`; raise UserError unless calibration= was identified from commanded torque."""
    if (torque := torque_of_calibration(cfg, None)) != TORQUE:
        raise UserError(
            f"calibration: stage=estimate expects a model identified with data.torque={TORQUE}, got {torque} "
            f"({cfg.calibration})"
        )
    return calibrated(cfg.calibration, robot)


def compensated(cfg, robot, dynamics):
    """Return the dynamics with the declared payload of the arm or of the recording."""
    from r2s.physics.payload import mass_and_moment, payload_of

    if cfg.data.kind == "arm":
        return with_declared_payload(cfg, robot, dynamics, cfg.calibration)
    declared = payload_of(plain(cfg.data).get("declared_payload"), robot.payload_max, "data.declared_payload")
    return dynamics if declared is None else replace(dynamics, declared_payload=mass_and_moment(robot, declared))


def identified_surface(cfg, robot):
    """Return the surface of estimate.surface, or None if unset; raise UserError for a surface without robot.tool."""
    if not cfg.estimate.surface:
        return None
    from r2s.identification.contact.contact_file import load_contact

    if robot.tool is None:
        raise UserError("robot.tool: estimate.surface needs the tip that touches: robot.tool=TOOL.json")
    return load_contact(cfg.estimate.surface, "estimate.surface").simulated


def wrench_observer(cfg, robot, dynamics, surface):
    """Return the wrench observer, and the source of its contact thresholds: "recordings" or "noise"."""
    from r2s.adaptation.wrench import WrenchObserver
    from r2s.adaptation.wrench_fusion import FusedWrench

    observer = WrenchObserver(robot, dynamics)
    if surface is not None:
        observer = FusedWrench(robot, dynamics, surface.surface, surface.draws)
    free = free_recordings(cfg.calibration) if cfg.calibration else []
    if free:
        observer.calibrate(robot, free)
    return observer, "recordings" if free else "noise"


def format_contacts(touched):
    """Return one line of text: the number of contacts, the largest force, and the first contact times."""
    if not touched:
        return "no contact"
    most = max(c["force_max_N"] for c in touched)
    first = ", ".join(f"{c['begin_s']:.2f} to {c['end_s']:.2f} s" for c in touched[:3])
    return f"{len(touched)} contacts, up to {most:.1f} N: {first}{' ...' if len(touched) > 3 else ''}"


def given_recording(cfg, robot):
    """Return the recording of data=recording with one row per millisecond, or None if r2s will record an arm.

    Raises:
        UserError: the file is missing or lacks commanded torque, or a setting of arm or payload is wrong.
    """
    from r2s.adaptation.offline_estimation import at_rate

    if cfg.data.kind != "recording":
        check_data(cfg)
    if cfg.data.torque != "commanded":
        raise UserError(f"data.torque: expected commanded for stage=estimate, got {cfg.data.torque}")
    if cfg.data.kind != "recording":
        check_source(cfg, robot)
        return None
    for key in ("payload", "loaded"):
        if cfg.data.get(key) is not None:
            raise UserError(
                f"data.{key}: stage=estimate finds the payload itself, got {cfg.data[key]}; leave it out; "
                "data.declared_payload= is what gravity compensation assumed"
            )
    file = file_data(cfg)
    return at_rate(robot, read_file(robot, file, file.path))


def record_arm(cfg, robot):
    """Record an arm in the motion data.excitation, or in a new motion of duration data.seconds.

    Return the recording, and the reason why the arm stopped early (or None).

    Raises:
        Stopped: a signal stopped the arm, or the arm stopped before the recording began.
    """
    from r2s.arm.interface import ArmStopped, StopRequested
    from r2s.arm.recorder import record
    from r2s.excitation.fourier import fourier
    from r2s.excitation.motion import load
    from r2s.progress import Progress

    if cfg.data.excitation:
        motion = load(cfg.data.excitation, robot)
    else:
        slow = within_speed_share(cfg, robot)
        slow = replace(slow, dq_max=LIMIT_SHARE * slow.dq_max, ddq_max=LIMIT_SHARE * slow.ddq_max)
        motion = fourier(slow, duration=cfg.data.seconds, seed=cfg.data.excitation_seed)
    progress = Progress("record the arm", in_cycle=True)
    try:
        with opened_source(cfg, robot, 0) as arm:
            out = record(arm, motion, loaded=True, progress=lambda k, n: progress(k / n, f"{k / 1000:.1f} s"))
    except ArmStopped as stop:
        if stop.recording is None or isinstance(stop, StopRequested):
            raise Stopped(f"while the arm was recorded: {stop}") from None
        progress.close(f"stopped: {stop}")
        return stop.recording, str(stop)
    progress.close(f"{out.duration:.1f} s of motion")
    return out, None


def summary(last, changes):
    """Return the entries for summary.json: the last estimate, and the times at which the payload changed."""
    centre = [None if c != c else round(float(c), 5) for c in (*last.centre, *last.centre_half)]  # JSON has no nan
    return {
        "mass_kg": last.mass,
        "mass_kg_half": last.mass_half,
        "centre_m": centre[:3],
        "centre_m_half": centre[3:],
        "inertia_kg_m2": last.tensor.tolist(),
        "friction": last.friction.tolist(),
        "friction_half": last.friction_half.tolist(),
        "offset_Nm": last.offset.tolist(),
        "offset_Nm_half": last.offset_half.tolist(),
        "rests": last.rests,
        "changes_s": changes,
    }
