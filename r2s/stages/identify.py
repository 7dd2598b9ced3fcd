"""stage=identify: recording -> parameters.yaml, errors on training and validation motion, figures."""

import os

from r2s.stages.build import OPEN, console, make_dynamics, make_robot, make_source, open_run, plain


def record_motion(cfg, robot, motion, seed, label):
    """Return the recording of a motion; without one, of the best that was found for data.seconds."""
    from r2s.arm.tracking import record
    from r2s.excitation.fourier import fourier
    from r2s.progress import Progress

    progress = Progress(label)
    if motion is None:
        motion = fourier(robot, duration=cfg.data.seconds, seed=seed, gravity=cfg.data.torque == "measured")
    arm = make_source(cfg, robot, seed)
    out = record(arm, motion, torque=cfg.data.torque, progress=lambda k, n: progress(k / n, f"{k / 1000:.1f} s"))
    progress.close(f"{out.duration:.1f} s of motion")
    OPEN.close()  # an arm has one client at a time, and the next recording is another
    return motion, out


def record_ramps(cfg, robot):
    """Return the ramps of the breakaway protocol about the home posture, or None where none are asked for."""
    from r2s.arm.ramp import poses_about, ramp
    from r2s.progress import Progress

    if not cfg.data.ramp_poses or cfg.data.torque != "commanded":
        return None
    progress = Progress("ramp the joints until they move")
    out = ramp(
        make_source(cfg, robot, cfg.data.excitation_seed + 2),
        poses_about(robot, cfg.data.ramp_poses),
        progress=lambda k, n: progress(k / n, f"{k} ramps"),
    )
    progress.close(f"{out.recording.duration:.1f} s of ramps")
    OPEN.close()
    return out


def read_motion(cfg, robot):
    """Return training and validation motion of data.path and data.validation; they must not share motion."""
    from dataclasses import replace

    import numpy as np

    from r2s.errors import UserError
    from r2s.identification.checks import check_recording
    from r2s.recordings.readers import read

    how = {k: plain(cfg.data[k]) for k in ("torque", "columns", "period", "max_gap_s", "topic", "joints")}
    names = [robot.model(gravity=False).joint(i).name for i in range(robot.n)]
    how |= {"n_joints": robot.n, "model_joints": names if all(names) else None}
    recording = read(cfg.data.path, **how)
    check_recording(robot, recording)
    if not cfg.data.validation:
        if how["period"] is None and (period := recording.repeats_after()):
            print(f"the motion repeats itself after {period:.2f} s: what validates is held out in every repetition")
            recording = replace(recording, period=period)
        return recording.split(cfg.identify.validation_fraction)
    if os.path.realpath(cfg.data.validation) == os.path.realpath(cfg.data.path):
        raise UserError("data.validation is the training file itself: it must hold other motion")
    validation = read(cfg.data.validation, **how)
    check_recording(robot, validation)
    rows = {row.tobytes() for row in np.column_stack([recording.q, recording.dq])}
    same = sum(row.tobytes() in rows for row in np.column_stack([validation.q, validation.dq]))
    if same > 0.01 * len(validation.t):
        raise UserError(
            f"data.validation: {same} of its {len(validation.t)} rows are rows of the training file; it must hold "
            "other motion"
        )
    return recording, validation


def identify(cfg, overrides):
    """Recording -> parameters.yaml, errors on training and validation motion, figures."""
    from hydra.utils import instantiate

    from r2s.arm.interface import ArmStopped
    from r2s.errors import UserError
    from r2s.excitation.motion import load
    from r2s.identification.identify import identify as run_identify
    from r2s.identification.parameter_file import save_parameters
    from r2s.identification.prediction import prediction_errors
    from r2s.identification.problem import check_choices
    from r2s.physics.description import write_description
    from r2s.progress import Progress
    from r2s.recordings.ramps import Ramps
    from r2s.recordings.readers import files_of, read
    from r2s.reporting import pages
    from r2s.reporting.identification_tables import identification_table

    robot, settings = make_robot(cfg), plain(cfg.identify)
    nominal = make_dynamics(cfg, robot)
    for terms in settings["terms"].values():
        check_choices(cfg.friction.family, terms)
    inputs, ramps, motion = [], None, None
    if cfg.data.kind == "recording":
        train, validation = read_motion(cfg, robot)
        inputs = [f for p in (cfg.data.path, cfg.data.validation) if p for f in files_of(p)]
        if cfg.data.ramps:
            ramps = Ramps.load(cfg.data.ramps)
            inputs.append(cfg.data.ramps)
    elif cfg.data.excitation:
        motion = load(cfg.data.excitation, robot)  # a wrong file is said before a folder is made
        inputs = [cfg.data.excitation]
    with open_run(cfg, overrides, inputs) as run:
        if cfg.data.kind != "recording":

            def recorded(name, motion, seed):
                path = run.folder / f"{name}.npz"
                if not path.is_file():
                    motion, out = record_motion(cfg, robot, motion, seed, f"record {name} motion")
                    motion.save(run.folder / f"excitation_{name}.csv")
                    out.save(path)
                return read(path, torque=cfg.data.torque)

            try:
                train = recorded("train", motion, cfg.data.excitation_seed)
                validation = recorded("validation", None, cfg.data.excitation_seed + 1)
                path = run.folder / "ramps.npz"
                ramps = Ramps.load(path) if path.is_file() else record_ramps(cfg, robot)
                if ramps is not None and not path.is_file():
                    ramps.save(path)
            except ArmStopped as stop:
                raise UserError(f"the arm stopped while it was recorded: {stop}") from None
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
            [instantiate(s) for s in cfg.search],
            bounds=settings["bounds"],
            prior=settings["prior"][train.torque],
            terms=settings["terms"][train.torque],
            family=cfg.friction.family,
            ramps=ramps,
            window_s=settings["window_s"],
            stride=settings["stride"],
            cutoff_hz=settings["cutoff_hz"],
            breakaway_max=settings["breakaway"],
            folds=settings["folds"],
            keep_nominal=settings["keep_nominal"],
            seed=cfg.seed,
            nthread=cfg.threads,
            report=told,
            memo=run.memo,
        )
        progress.close()
        how = {"window_s": settings["window_s"], "cutoff_hz": settings["cutoff_hz"], "nthread": cfg.threads}
        summary = {
            side: prediction_errors(robot, nominal, found.dynamics, data, **how)
            for side, data in (("train", train), ("validation", validation))
        }
        source = {"recording": train.name, "torque": train.torque, "run": str(run.folder)}
        note = {
            "unseen_and_left_nominal": found.unseen,
            "decided_by_the_prior": [{"share_of_prior_left": round(s, 2), **v} for s, v in found.null_directions],
            "families_compared": found.families,
        }
        save_parameters(run.folder / "parameters.yaml", *found.saved, source, note)
        found.history.to_csv(run.folder / "metrics.csv", index=False)
        write_description(run.folder / "model", robot, found.dynamics)
        run.summary(summary)
        drawn = {k: settings[k] for k in ("window_s", "cutoff_hz")}
        pages.identification(run, robot, nominal, found, validation, summary, **drawn)
        identification_table(console(), robot, found, summary)
    print(f"written: {run.folder}")
