"""The front door: compose the config, open a run folder, call one stage with plain arguments.

Read it from the bottom: `main` composes, `STAGES` names what there is, one function per stage.
"""

import os
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

ROOT = Path(__file__).parent
OPEN = ExitStack()  # arms and emulators of this job
CONF = ROOT / "conf"


# --- what several stages need, made from the config -----------------------------------------------------------


def make_robot(cfg):
    """Return the arm of conf/robot."""
    from r2s.robot import load_robot

    return load_robot(**plain(cfg.robot))


def make_dynamics(cfg, robot):
    """Return conf/friction and conf/inertia, or what `calibration=` identified."""
    from r2s.parameters import load_parameters, nominal_dynamics

    if cfg.calibration:
        space, x = load_parameters(cfg.calibration, robot)
        return space.dynamics(x)
    return nominal_dynamics(robot, **plain(cfg.friction), inertia_scale=plain(cfg.inertia.scale))


def make_task(cfg):
    """Return conf/task."""
    from r2s.env import Task

    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in plain(cfg.task).items()}
    return Task(**settings)  # type: ignore[arg-type]


def make_draw(cfg, robot, center):
    """Return the domain randomization of conf/dr about `center`: (rng, m) -> Dynamics."""
    from r2s import randomization
    from r2s.errors import UserError
    from r2s.parameters import load_parameters, load_posterior

    settings = plain(cfg.dr)
    if settings.pop("name") == "identified":
        if not cfg.calibration:
            raise UserError("dr=identified draws from what was identified: give calibration=RUN_FOLDER as well")
        space, _ = load_parameters(cfg.calibration, robot)
        samples = load_posterior(cfg.calibration, space)
        return lambda rng, m: randomization.draw_identified(rng, space, samples, m)
    return lambda rng, m: randomization.draw(rng, center, m, **settings)


def make_arm(cfg, robot):
    """Return conf/arm; what has to be closed is in OPEN."""
    from functools import partial

    from r2s.errors import UserError

    name, arm = cfg.arm.name, cfg.arm
    if name == "twin":
        from r2s.arm.twin import Twin

        return Twin(robot, arm.seed, arm.payload, arm.stiffness)
    if name == "none":
        raise UserError("arm: none cannot be commanded; allowed: twin, panda_emulated, fr3_emulated, panda, fr3")
    from r2s.arm.fr3 import FR3
    from r2s.arm.panda import Panda

    make = Panda if name.startswith("panda") else FR3
    if name.endswith("_emulated"):
        from r2s.arm.emulator import Emulator
        from r2s.arm.twin import Twin

        version = 5 if name.startswith("panda") else 10
        emulator = Emulator(partial(Twin, robot, arm.seed), version=version, realtime=arm.realtime)
        client = make(robot, OPEN.enter_context(emulator), clear=lambda reason: True)
    else:
        client = make(robot, arm.address, clear=operator_agrees, realtime=arm.realtime)
    OPEN.callback(client.close)
    return client


def make_engine(cfg, robot):
    """Return Dynamics -> the engine of simulator=dart or gazebo, of an arm with these links."""
    if cfg.simulator.name == "gazebo":
        from r2s.engines.gazebo import GazeboEngine, bindings

        sim = bindings()
        return lambda d: GazeboEngine(robot, d, sim)
    from r2s.engines.dart import DartEngine

    return lambda d: DartEngine(robot, gravity=False, masses=d.mass, coms=d.com, inertias=d.inertia)


def operator_agrees(reason):
    """Ask whether a stop of the arm may be cleared; nobody at the terminal: no."""
    if not sys.stdin.isatty():
        return False
    return input(f"\nthe arm has stopped itself: {reason}\nis it safe to go on? [y/N] ").strip().lower() == "y"


def open_run(cfg, overrides, inputs=(), parents=()):
    """Return the run folder of this job, open."""
    from omegaconf import OmegaConf

    from r2s.runs import Run

    return Run(
        Path(cfg.root),
        cfg.stage,
        cfg.name,
        config=OmegaConf.to_yaml(cfg),
        overrides=overrides,
        seed=cfg.seed,
        threads=cfg.threads,
        inputs=inputs,
        parents=parents,
        resume=cfg.resume,
    )


def plain(node):
    """Return a config node as dicts, lists and numbers."""
    from omegaconf import OmegaConf

    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def console():
    """Return where tables go."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 110)


def learner(name):
    """Return the class of conf/algo."""
    from r2s.ddpg import DDPG
    from r2s.sac import SAC
    from r2s.td3 import TD3
    from r2s.tqc import TQC

    return {"ddpg": DDPG, "td3": TD3, "sac": SAC, "tqc": TQC}[name]


def set_threads(cfg):
    """Give torch its threads and seed; the physics gets its own from cfg.threads."""
    import torch

    torch.set_num_threads(cfg.threads or os.cpu_count() or 1)
    torch.manual_seed(cfg.seed)


def device(cfg):
    """Return where learner and replay buffer live; the physics stays on the processor."""
    import torch

    from r2s.errors import UserError

    if cfg.device not in ("cpu", "cuda"):
        raise UserError(f"device: '{cfg.device}' is not allowed; cpu and cuda are")
    if cfg.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device: cuda is not there; torch sees no GPU, device=cpu works")
    return cfg.device


# --- stages ---------------------------------------------------------------------------------------------------


def make_source(cfg, robot, seed):
    """Return what is recorded: conf/arm, or a simulated arm of known truth."""
    if cfg.data.kind != "simulated":
        return make_arm(cfg, robot)
    from dataclasses import replace

    from omegaconf import OmegaConf

    from r2s.arm.simulated import SimulatedArm
    from r2s.parameters import nominal_dynamics

    truth = plain(OmegaConf.load(CONF / "friction" / f"{cfg.data.truth}.yaml"))
    scale = plain(OmegaConf.load(CONF / "inertia" / f"{cfg.data.truth}.yaml"))["scale"]
    dynamics = replace(nominal_dynamics(robot, **truth, inertia_scale=scale), delay=cfg.data.delay, lag=cfg.data.lag)
    noise = {"position_noise": cfg.data.position_noise, "velocity_noise": cfg.data.velocity_noise}
    return SimulatedArm(robot, dynamics, **noise, seed=seed)


def record_motion(cfg, robot, motion, seed, label):
    """Return the recording of a motion; without one, of the best that was found for data.seconds."""
    from r2s.arm.record import record
    from r2s.excitation import fourier
    from r2s.runs import Progress

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
    from r2s.runs import Progress

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
    from r2s.identify import check_recording
    from r2s.readers import read

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

    from r2s import report, tell
    from r2s.arm.interface import ArmStopped
    from r2s.breakaway import Ramps
    from r2s.engines.description import write_description
    from r2s.errors import UserError
    from r2s.excitation import load
    from r2s.identify import identify as run_identify
    from r2s.parameters import save_parameters
    from r2s.problem import check_choices
    from r2s.readers import files_of, read
    from r2s.runs import Progress
    from r2s.validation import prediction_errors

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
        tell.identification(run, robot, nominal, found, validation, summary, **drawn)
        report.identification_table(console(), robot, found, summary)
    print(f"written: {run.folder}")


def train(cfg, overrides):
    """Train one policy in simulation, evaluate it, save it as policy.pt and policy.onnx."""
    import copy
    from functools import partial

    import torch

    from r2s import report, tell
    from r2s.checkpoint import Checkpoint
    from r2s.env import ReachEnv, observation_scale
    from r2s.errors import UserError
    from r2s.evaluate import make_evaluation
    from r2s.policy import export_onnx, load_policy, save_policy
    from r2s.rewards import curriculum
    from r2s.runs import Progress
    from r2s.train import Budget, check_loop
    from r2s.train import train as run_train

    if cfg.algo.name == "oracle":
        return reference(cfg, overrides)
    if cfg.matmul not in ("medium", "high", "highest"):
        raise UserError(f"matmul: '{cfg.matmul}' is not allowed; medium, high and highest are")
    budget = Budget(cfg.budget.minutes, cfg.budget.env_steps)
    robot, task, settings = make_robot(cfg), make_task(cfg), plain(cfg.algo)
    center = make_dynamics(cfg, robot)
    draw = make_draw(cfg, robot, center)
    set_threads(cfg)
    loop = {k: settings.pop(k) for k in LOOP}
    check_loop(**loop)
    n_envs, name = settings.pop("n_envs"), settings.pop("name")
    env = ReachEnv(robot, task, draw, n_envs, nthread=cfg.threads, seed=cfg.seed, stagger=True)
    evaluate = make_evaluation(robot, task, draw, episodes=cfg.evaluation.episodes, nthread=cfg.threads)
    torque = torch.from_numpy(task.torque(robot))
    mean, std = (torch.from_numpy(s) for s in observation_scale(robot, task))
    algo = learner(name)((mean, std), torque, **settings).to(device(cfg))
    weights = partial(curriculum, **plain(cfg.reward))
    best: dict = {}
    last: dict = {}

    def is_best(row):
        nonlocal best, last
        last = row
        better = not best or worth(row) >= worth(best)
        best = row if better else best
        return better

    with open_run(cfg, overrides, parents=[cfg.calibration] if cfg.calibration else []) as run:
        progress = Progress(f"train {name}")
        checkpoint = Checkpoint(run.folder / "checkpoints")
        if cfg.resume:
            run.rewind("metrics", "env_steps", checkpoint.env_steps)
            for row in run.rewind("evaluations", "env_steps", checkpoint.env_steps):
                is_best(row)

        def evaluated(row):
            run.log("evaluations", row)
            if is_best(row):
                save_policy(run.folder, copy.deepcopy(algo.policy).cpu())

        def show(share, row):
            text = f"{row['env_steps'] / 1e3:.0f}k env steps, {row['updates']} updates"
            if "success_1cm" in row:
                text += f", {100 * row['success_1cm']:.0f} % < 1 cm, return {row['return_paper']:.0f}"
            progress(share, text)

        run_train(
            env,
            algo,
            evaluate,
            weights,
            budget=budget,
            **loop,
            compile=cfg.compile,
            matmul=cfg.matmul,
            eval_env_steps=cfg.evaluation.env_steps,
            checkpoint=checkpoint,
            dump=run.folder / "dump.pt",
            log=lambda row: run.log("metrics", row),
            evaluated=evaluated,
            progress=show,
        )
        progress.close()
        checkpoint.clear()
        export_onnx(run.folder / "policy.onnx", load_policy(run.folder, robot, task), robot, task)
        run.summary({"best": best, "last": last})
        tell.training(run, robot)
        report.reach_table(console(), {"best": best, "last": last}, f"{name} in MuJoCo, dr: {plain(cfg.dr)}")
    print(f"written: {run.folder}")


def worth(row):
    """Return what makes one evaluation better than another: 1 % more within 1 cm is worth 1 of the return."""
    return 100 * row["success_1cm"] + row["return_paper"]


def reference(cfg, overrides):
    """Evaluate the model-based controller, which is not trained, as a training is evaluated."""
    from r2s import report, tell
    from r2s.evaluate import make_evaluation, measures

    robot, task = make_robot(cfg), make_task(cfg)
    draw = make_draw(cfg, robot, make_dynamics(cfg, robot))
    with open_run(cfg, overrides, parents=[cfg.calibration] if cfg.calibration else []) as run:
        evaluate = make_evaluation(robot, task, draw, episodes=cfg.evaluation.episodes, nthread=cfg.threads)
        done = evaluate(oracle(cfg, robot, task))
        row = {"env_steps": 0, "updates": 0, "wall_clock_s": 0.0} | measures(done)
        run.log("evaluations", row)
        run.summary({"best": row, "last": row})
        tell.transfer(run, robot, {"oracle": done}, {"oracle": row}, task.torque(robot))
        report.reach_table(console(), {"oracle": row}, f"oracle in MuJoCo, dr: {plain(cfg.dr)}")
    print(f"written: {run.folder}")


def oracle(cfg, robot, task):
    """Return the controller of algo=oracle."""
    from r2s.oracle import Oracle

    return Oracle(robot, task, make_dynamics(cfg, robot), cfg.algo.move_s)


def transfer(cfg, overrides):
    """Evaluate a trained policy in simulators and on an arm, on the same goals."""
    from omegaconf import OmegaConf

    from r2s import report, tell
    from r2s.arm.deploy import reach
    from r2s.arm.interface import ArmStopped
    from r2s.arm.simulated import SimulatedArm
    from r2s.engines.episodes import reach as engine_reach
    from r2s.errors import UserError, nearest
    from r2s.evaluate import fixed_episodes, gap, make_evaluation, measures
    from r2s.policy import load_policy
    from r2s.runs import Progress

    source = Path(cfg.policy) if cfg.policy else None
    if source is None or not (source / "summary.json").is_file():
        names = [p.name for p in source.parent.glob("*")] if source and source.parent.is_dir() else []
        raise UserError(
            f"policy: '{cfg.policy}' is no finished run folder of stage=train"
            f"{nearest(source.name, names) if source else ''}"
        )
    trained = OmegaConf.load(source / "config.yaml")
    robot, task = make_robot(trained), make_task(trained)
    set_threads(cfg)
    policy = oracle(trained, robot, task) if trained.algo.name == "oracle" else load_policy(source, robot, task)
    starts, goals = fixed_episodes(robot, task, cfg.evaluation.episodes)
    if cfg.simulator.name == cfg.arm.name == "none":
        raise UserError("simulator=none and arm=none leave nothing to do; allowed is one of both")
    dynamics = draw = None
    if cfg.simulator.name != "none":
        dynamics = make_dynamics(trained, robot)
        draw = make_draw(trained, robot, dynamics)
    engine = make_engine(cfg, robot) if cfg.simulator.name in ("dart", "gazebo") else None
    try:
        arm = None if cfg.arm.name == "none" else make_arm(cfg, robot)
    except ArmStopped as stop:
        raise UserError(f"arm={cfg.arm.name}: {stop}") from None
    rows, episodes, timing = {}, {}, None
    stops: list = []

    def counted(what):
        progress = Progress(what)
        return progress, lambda k, n: progress(k / n, f"{k} goals")

    with open_run(cfg, overrides, parents=[str(source)]) as run:
        if draw is not None:
            done = make_evaluation(robot, task, draw, episodes=len(goals), nthread=cfg.threads)(policy)
            rows["mujoco"], episodes["mujoco"] = measures(done), done
            if engine is not None:
                progress, shown = counted(f"reach in {cfg.simulator.name}")
                done = engine_reach(policy, engine, robot, task, draw, starts, goals, shown)
                progress.close()
                rows[cfg.simulator.name] = measures(done) | gap(done, episodes["mujoco"])
                episodes[cfg.simulator.name] = done
        if arm is not None:
            fade = cfg.arm.soft_start_s
            if dynamics is not None:  # what the model says of this arm, behind the same driver
                progress, shown = counted("predict from the model")
                model = SimulatedArm(arm.robot, dynamics, position_noise=0.0, velocity_noise=0.0)
                done, ends, _ = reach(policy, model, task, starts, goals, shown, soft_start_s=fade)
                progress.close()
                rows["predicted"], episodes["predicted"] = measures(done) | {"stops": len(ends)}, done
            progress, shown = counted(f"reach on {cfg.arm.name}")
            done, stops, timing = reach(policy, arm, task, starts, goals, shown, soft_start_s=fade)
            progress.close()
            rows[cfg.arm.name], episodes[cfg.arm.name] = measures(done) | {"stops": len(stops)}, done
            if "predicted" in rows:
                rows[cfg.arm.name] |= gap(done, episodes["predicted"])
            for row in timing.table():
                run.log("timing", row)
            (run.folder / "stops.txt").write_text("".join(f"{stop}\n" for stop in stops) or "none\n")
        run.summary(rows)
        tell.transfer(run, robot, episodes, rows, task.torque(robot), timing, stops)
        report.reach_table(console(), rows, f"{source.name} on {len(goals)} goals")
    print(f"written: {run.folder}")


def compare(cfg, overrides):
    """Put runs of stage=train side by side: tables with intervals over seeds, learning curves."""
    from glob import glob

    from r2s import report, tell
    from r2s.comparison import read_runs
    from r2s.errors import UserError

    folders = sorted(glob(cfg.runs or ""))
    if not folders:
        raise UserError(f"runs: nothing matches '{cfg.runs}'; such as runs='runs/train/*'")
    runs = read_runs(folders)
    with open_run(cfg, overrides, parents=[str(r.folder) for r in runs]) as run:
        tables = tell.compare(run, make_robot(cfg), runs)
        run.summary({name: table.to_dict("records") for name, table in tables.items()})
        title = f"{len(runs)} runs, last evaluation: interquartile mean [95 % interval over seeds]"
        report.print_table(console(), report.scores_rows(tables["scores"]), title)
    print(f"written: {run.folder} (look: {run.folder / 'report.md'})")


def pipeline(cfg, overrides):
    """Every stage on the embedded default, each a process of its own; one table, one recording, one report."""
    from r2s import tell
    from r2s.pipeline import check_free, run_chain
    from r2s.report import reach_table
    from r2s.runs import read_summary

    robot = make_robot(cfg)
    if cfg.name and not (Path(cfg.root) / "pipeline" / cfg.name).exists():
        check_free(Path(cfg.root), cfg.name)
    with open_run(cfg, overrides) as run:
        program = [sys.executable, str(ROOT / "run.py")]
        name, minutes = run.folder.name, cfg.pipeline.train_minutes
        identified, trained, transferred = run_chain(program, Path(cfg.root), name, overrides, minutes)
        rows = {}
        for label, folder in transferred.items():
            for where, row in read_summary(folder, "transfer").items():
                rows[f"{label} model, {where}"] = row
        run.summary({"identify": read_summary(identified, "identify"), "reach": rows})
        tell.pipeline(run, robot, identified, trained, transferred, rows)
        reach_table(console(), rows, "policies trained on the identified and on the nominal model")
    print(f"written: {run.folder} (look: rerun {run.folder / 'recording.rrd'})")


# what conf/algo says of the loop rather than of the learner
LOOP = ("batch_size", "learning_starts", "updates_per_step", "replay_size", "lr_decay", "lr_end")
STAGES = {
    "train": train,
    "identify": identify,
    "transfer": transfer,
    "compare": compare,
    "pipeline": pipeline,
}


# --- the front door -------------------------------------------------------------------------------------------


def check_overrides(words):
    """Raise UserError for an option that the config does not have, with the nearest one that it has.

    Hydra would stop too, with several lines; a sweep is checked value by value before its first job starts.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from r2s.errors import UserError, choices, nearest

    def keys(node, prefix=""):
        for k in node:
            yield prefix + str(k)
            if not OmegaConf.is_missing(node, k) and isinstance(node[k], DictConfig):
                yield from keys(node[k], f"{prefix}{k}.")

    groups = {p.name: sorted(f.stem for f in p.glob("*.yaml")) for p in CONF.iterdir() if p.is_dir()}
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        cfg = compose("config")
        known = [*keys(cfg), *groups]
        base: list[str] = []
        for word in words:
            if word.lstrip("+~").startswith(("hydra.", "hydra/")):
                continue  # Hydra's own
            try:
                parsed = OverridesParser.create().parse_override(word)
                name = parsed.key_or_group
                if parsed.is_add() and name not in groups:  # Hydra would take it, and nothing would read it
                    raise UserError(f"unknown option '{name}'{nearest(name, known)}")
                values = list(parsed.sweep_string_iterator()) if parsed.is_sweep_override() else [None]
                trials = [word if v is None else f"{word.split('=', 1)[0]}={v}" for v in values]
                for trial in trials:
                    before, cfg = cfg, compose("config", [*base, trial])
                    check_type(name, before, cfg)
                if not parsed.is_sweep_override() and name in ("data", "arm", "simulator"):
                    known = [*keys(cfg), *groups]
                base.append(trials[0])
            except (HydraException, OmegaConfBaseException) as error:
                if "=" not in word:
                    raise UserError(f"'{word}' is not KEY=VALUE{nearest(word, groups)}") from None
                key, value = word.split("=", 1)
                bare = key.lstrip("+~")
                if bare in groups:
                    options = groups[bare]
                    raise UserError(
                        f"{bare}: no option '{value}'; allowed: {choices(options)}{nearest(value, options)}"
                    ) from None
                if bare not in known:
                    raise UserError(
                        f"unknown option '{bare}'{nearest(bare, known) or '; see python run.py --help'}"
                    ) from None
                raise UserError(f"{word}: {' '.join(str(error).split())}") from None
    GlobalHydra.instance().clear()


def check_counts(cfg):
    """Raise UserError where what counts something is no such number."""
    from omegaconf import OmegaConf

    from r2s.errors import check_number

    least = {"seed": 0, "threads": 0, "arm.seed": 0, "evaluation.episodes": 1, "evaluation.env_steps": 1}
    for key, low in (least | {"algo.n_envs": 1}).items():
        if (value := OmegaConf.select(cfg, key)) is not None:
            check_number(key, value, f"[{low}, inf)", whole=True)


def check_type(key, before, after):
    """Raise UserError where a number of the config was replaced by a word."""
    from omegaconf import OmegaConf

    from r2s.errors import UserError

    def number(value):
        return isinstance(value, (int, float)) and not isinstance(value, bool)

    old, new = OmegaConf.select(before, key, throw_on_missing=False), OmegaConf.select(after, key)
    if number(old) and isinstance(new, str):
        raise UserError(f"{key}: '{new}' is not a number, such as {old:g}")


def resumed(cfg, overrides):
    """Return config and overrides of the run folder `resume=`, which then goes on where it stopped."""
    from omegaconf import OmegaConf

    from r2s.errors import UserError, nearest
    from r2s.runs import is_done

    folder = Path(cfg.resume)
    if not (folder / "config.yaml").is_file():
        names = [p.name for p in folder.parent.glob("*")] if folder.parent.is_dir() else []
        raise UserError(f"resume: '{cfg.resume}' is no run folder{nearest(folder.name, names)}")
    if extra := [o for o in overrides if not o.startswith("resume=")]:
        raise UserError(f"resume: a run goes on with its own config; leave out {' '.join(extra)}")
    before = OmegaConf.load(folder / "config.yaml")
    if before.stage not in ("identify", "train"):
        raise UserError(f"resume: {folder} is a run of stage={before.stage}; allowed: identify, train")
    if is_done(folder):
        raise UserError(f"resume: {folder} is finished")
    before.resume = str(folder)
    return before, OmegaConf.to_container(OmegaConf.load(folder / "overrides.yaml"))


def is_there(cfg, overrides):
    """Return whether the run folder of this job is finished; where it was stopped, let the job go on in it."""
    from omegaconf import OmegaConf

    from r2s.errors import UserError
    from r2s.runs import is_done

    if not cfg.name:
        raise UserError("only_missing: give the run folder a name=, such as name='${algo.name}_${seed}'")
    folder = Path(cfg.root) / cfg.stage / cfg.name
    if not (folder / "meta.json").is_file():
        return False

    def typed(words):
        beside = ("stage=", "name=", "root=", "threads=", "only_missing=", "grid.")  # no part of what is computed
        return {w for w in words if not w.startswith(beside)}

    before = typed(OmegaConf.to_container(OmegaConf.load(folder / "overrides.yaml")))
    if other := sorted(before ^ typed(overrides)):
        raise UserError(f"only_missing: {folder} was made otherwise ({', '.join(other)}); give another name=")
    if is_done(folder):
        print(f"already there: {folder}")
        return True
    cfg.resume = str(folder)
    return False


def main():
    """Compose and run; a user's mistake is one line and exit status 2."""
    import hydra

    from r2s.errors import UserError

    words = [w for w in sys.argv[1:] if not w.startswith("-")]
    asked_for_help = any(
        w in ("--help", "-h", "--hydra-help", "--version", "--cfg", "-c", "--info", "-i") for w in sys.argv[1:]
    )

    @hydra.main(version_base="1.3", config_path=str(CONF.resolve()), config_name="config")
    def job(cfg):
        from hydra.core.hydra_config import HydraConfig
        from omegaconf.errors import MissingMandatoryValue

        overrides = list(HydraConfig.get().overrides.task)
        try:
            check_counts(cfg)
            if cfg.resume:
                cfg, overrides = resumed(cfg, overrides)
            elif cfg.only_missing and is_there(cfg, overrides):
                return
            with OPEN:
                STAGES[cfg.stage](cfg, overrides)
        except (UserError, FloatingPointError) as error:
            failed(error)
        except MissingMandatoryValue as error:
            failed(f"{error.full_key} must be given: {error.full_key}=...")
        except KeyboardInterrupt:
            print("\ninterrupted; what was written stays in the run folder", file=sys.stderr)
            sys.exit(130)

    try:
        if not asked_for_help:
            check_overrides(words)
        with tempfile.TemporaryDirectory() as folder:
            if {"-m", "--multirun"} & set(sys.argv[1:]):  # a job that fails leaves the others alone
                os.environ["R2S_FAILED"] = str(Path(folder) / "failed.txt")
            job()
            lines = Path(folder) / "failed.txt"
            if lines.is_file():
                count = len(lines.read_text().splitlines())
                sys.exit(stop(f"{count} job{'s' * (count > 1)} of the sweep failed, see above; the others are done"))
    except UserError as error:
        sys.exit(stop(error))


def failed(error):
    """End a job that cannot go on: with exit status 2, or in a sweep with a note for its end."""
    status = stop(error)
    if "R2S_FAILED" not in os.environ:
        sys.exit(status)
    with open(os.environ["R2S_FAILED"], "a") as file:
        file.write(f"{error}\n")


def stop(error):
    """Print a user's mistake as one line and return the exit status."""
    print(f"error: {error}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    main()
