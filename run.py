"""The front door: compose the config, open a run folder, call one stage with plain arguments.

Read it from the bottom: `main` composes, `STAGES` names what there is, one function per stage.
"""

import os
import sys
from pathlib import Path

ROOT = Path(__file__).parent
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
        return load_parameters(cfg.calibration, robot)
    return nominal_dynamics(robot, **plain(cfg.friction), inertia_scale=plain(cfg.inertia.scale))


def make_task(cfg):
    """Return conf/task."""
    from r2s.env import Task

    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in plain(cfg.task).items()}
    return Task(**settings)  # type: ignore[arg-type]


def make_draw(cfg, center):
    """Return the domain randomization of conf/dr about `center`: (rng, m) -> Dynamics."""
    from r2s import randomization

    settings = plain(cfg.dr)
    return lambda rng, m: randomization.draw(rng, center, m, **settings)


def make_arm(cfg, robot):
    """Return conf/arm."""
    from r2s.errors import UserError, nearest

    if cfg.arm.name == "twin":
        from r2s.arm.twin import Twin

        return Twin(robot, cfg.arm.seed)
    raise UserError(f"arm: '{cfg.arm.name}' cannot be commanded; allowed: twin{nearest(cfg.arm.name, ['twin'])}")


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
    )


def plain(node):
    """Return a config node as dicts, lists and numbers."""
    from omegaconf import OmegaConf

    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def console():
    """Return where tables go."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 110)


def set_threads(cfg):
    """Give torch its threads and seed; the physics gets its own from cfg.threads."""
    import torch

    torch.set_num_threads(cfg.threads or os.cpu_count() or 1)
    torch.manual_seed(cfg.seed)


# --- stages ---------------------------------------------------------------------------------------------------


def record_motion(cfg, robot, seed, label):
    """Return a recording of an excitation on conf/arm, or on a simulated arm of known truth."""
    from r2s.arm.interface import ArmStopped
    from r2s.arm.record import record
    from r2s.errors import UserError
    from r2s.excitation import fourier
    from r2s.runs import Progress

    if cfg.data.kind == "simulated":
        from omegaconf import OmegaConf

        from r2s.arm.simulated import SimulatedArm
        from r2s.parameters import nominal_dynamics

        truth = plain(OmegaConf.load(CONF / "friction" / f"{cfg.data.truth}.yaml"))
        scale = plain(OmegaConf.load(CONF / "inertia" / f"{cfg.data.truth}.yaml"))["scale"]
        noise = {"position_noise": cfg.data.position_noise, "velocity_noise": cfg.data.velocity_noise}
        arm = SimulatedArm(robot, nominal_dynamics(robot, **truth, inertia_scale=scale), **noise, seed=seed)
    else:
        arm = make_arm(cfg, robot)
    progress = Progress(label)
    motion = fourier(robot, duration=cfg.data.seconds, seed=seed)
    try:
        out = record(arm, motion, torque=cfg.data.torque, progress=lambda k, n: progress(k / n, f"{k / 1000:.1f} s"))
    except ArmStopped as stop:
        raise UserError(f"the arm stopped while it was recorded: {stop}") from None
    progress.close(f"{out.duration:.1f} s of motion")
    return out


def identify(cfg, overrides):
    """Recording -> parameters.yaml, errors on training and validation motion, figures."""
    from dataclasses import replace

    from hydra.utils import instantiate

    from r2s import report, tell
    from r2s.errors import UserError
    from r2s.identify import identify as run_identify
    from r2s.identify import prediction_errors
    from r2s.parameters import save_parameters
    from r2s.readers import read
    from r2s.runs import Progress

    robot, settings = make_robot(cfg), plain(cfg.identify)
    nominal = make_dynamics(cfg, robot)
    inputs = []
    if cfg.data.kind == "recording":
        how = {k: plain(cfg.data[k]) for k in ("torque", "columns", "period", "max_gap_s")} | {"n_joints": robot.n}
        recording = read(cfg.data.path, **how)
        if how["period"] is None and not cfg.data.validation and (period := recording.repeats_after()):
            print(f"the motion repeats itself after {period:.2f} s: what validates is held out in every repetition")
            recording = replace(recording, period=period)
        inputs = [cfg.data.path]
        if cfg.data.validation:
            if os.path.realpath(cfg.data.validation) == os.path.realpath(cfg.data.path):
                raise UserError("data.validation is the training file itself: it must hold other motion")
            train, validation = recording, read(cfg.data.validation, **how)
            inputs.append(cfg.data.validation)
        else:
            train, validation = recording.split(settings["validation_fraction"])
    with open_run(cfg, overrides, inputs) as run:
        if cfg.data.kind != "recording":
            train = record_motion(cfg, robot, cfg.data.excitation_seed, "record training motion")
            validation = record_motion(cfg, robot, cfg.data.excitation_seed + 1, "record validation motion")
            train.save(run.folder / "train.npz")
            validation.save(run.folder / "validation.npz")
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
            window_s=settings["window_s"],
            stride=settings["stride"],
            cutoff_hz=settings["cutoff_hz"],
            breakaway=settings["breakaway"],
            folds=settings["folds"],
            nthread=cfg.threads,
            report=told,
        )
        progress.close()
        how = {"window_s": settings["window_s"], "cutoff_hz": settings["cutoff_hz"], "nthread": cfg.threads}
        summary = {
            side: prediction_errors(robot, nominal, found.dynamics, data, **how)
            for side, data in (("train", train), ("validation", validation))
        }
        source = {"recording": train.name, "torque": train.torque, "run": str(run.folder)}
        result = found.space, found.x, found.interval, found.identifiable
        save_parameters(run.folder / "parameters.yaml", robot, *result, source)
        found.history.to_csv(run.folder / "metrics.csv", index=False)
        run.summary(summary)
        drawn = {k: settings[k] for k in ("window_s", "cutoff_hz")}
        tell.identification(run, robot, nominal, found, validation, summary, **drawn)
        report.identification_table(console(), robot, found, summary)
    print(f"written: {run.folder}")


def train(cfg, overrides):
    """Train one policy in simulation, evaluate it, save it as policy.pt and policy.onnx."""
    from functools import partial

    import torch

    from r2s import report, tell
    from r2s.env import ReachEnv, observation_scale
    from r2s.errors import UserError
    from r2s.evaluate import make_evaluation
    from r2s.policy import export_onnx, load_policy, save_policy
    from r2s.rewards import curriculum
    from r2s.runs import Progress
    from r2s.tqc import TQC
    from r2s.train import Budget
    from r2s.train import train as run_train

    if not cfg.budget.minutes and not cfg.budget.env_steps:
        raise UserError("budget: set budget.minutes or budget.env_steps; a training needs an end")
    robot, task, settings = make_robot(cfg), make_task(cfg), plain(cfg.algo)
    center = make_dynamics(cfg, robot)
    draw = make_draw(cfg, center)
    set_threads(cfg)
    loop = {k: settings.pop(k) for k in LOOP}
    n_envs, name = settings.pop("n_envs"), settings.pop("name")
    env = ReachEnv(robot, task, draw, n_envs, nthread=cfg.threads, seed=cfg.seed, stagger=True)
    evaluate = make_evaluation(robot, task, draw, episodes=cfg.evaluation.episodes, nthread=cfg.threads)
    torque = torch.from_numpy(task.torque(robot))
    mean, std = (torch.from_numpy(s) for s in observation_scale(robot, task))
    algo = TQC((mean, std), torque, **settings)
    weights = partial(curriculum, **plain(cfg.reward))
    best: dict = {}
    last: dict = {}

    with open_run(cfg, overrides, parents=[cfg.calibration] if cfg.calibration else []) as run:
        progress = Progress(f"train {name}")

        def evaluated(row):
            nonlocal best, last
            last = row
            run.log("evaluations", row)
            rank = (row["success_1cm"], -row["distance_median_m"])
            if not best or rank >= (best["success_1cm"], -best["distance_median_m"]):
                best = row
                save_policy(run.folder, algo.policy)

        def show(share, row):
            text = f"{row['env_steps'] / 1e3:.0f}k env steps, {row['updates']} updates"
            if "success_1cm" in row:
                text += f", {100 * row['success_1cm']:.0f} % < 1 cm, return {row['return_paper']:.0f}"
            progress(share, text)

        budget = Budget(cfg.budget.minutes, cfg.budget.env_steps)
        run_train(
            env,
            algo,
            evaluate,
            weights,
            budget=budget,
            **loop,
            eval_env_steps=cfg.evaluation.env_steps,
            log=lambda row: run.log("metrics", row),
            evaluated=evaluated,
            progress=show,
        )
        progress.close()
        export_onnx(run.folder / "policy.onnx", load_policy(run.folder, robot, task), robot, task)
        run.summary({"best": best, "last": last})
        tell.training(run, robot)
        report.reach_table(console(), {"best": best, "last": last}, f"{name} in MuJoCo, dr: {plain(cfg.dr)}")
    print(f"written: {run.folder}")


def transfer(cfg, overrides):
    """Evaluate a trained policy in simulators and on an arm, on the same goals."""
    import numpy as np
    from omegaconf import OmegaConf

    from r2s import report, tell
    from r2s.arm.deploy import reach
    from r2s.errors import UserError, nearest
    from r2s.evaluate import fixed_episodes, make_evaluation, measures
    from r2s.policy import load_policy
    from r2s.runs import Progress

    source = Path(cfg.policy) if cfg.policy else None
    if source is None or not (source / "policy.pt").is_file():
        names = [p.name for p in source.parent.glob("*")] if source and source.parent.is_dir() else []
        raise UserError(
            f"policy: '{cfg.policy}' is no run folder with a policy.pt{nearest(source.name, names) if source else ''}"
        )
    trained = OmegaConf.load(source / "config.yaml")
    robot, task = make_robot(trained), make_task(trained)
    set_threads(cfg)
    policy = load_policy(source, robot, task)
    starts, goals = fixed_episodes(robot, task, cfg.evaluation.episodes)
    rows, episodes = {}, {}
    with open_run(cfg, overrides, parents=[str(source)]) as run:
        if cfg.simulator.name == "mujoco":
            draw = make_draw(trained, make_dynamics(trained, robot))
            done = make_evaluation(robot, task, draw, episodes=len(goals), nthread=cfg.threads)(policy)
            rows["mujoco"], episodes["mujoco"] = measures(done), done
        if cfg.arm.name != "none":
            progress = Progress(f"reach on {cfg.arm.name}")
            done, stops = reach(
                policy, make_arm(cfg, robot), task, starts, goals, lambda k, n: progress(k / n, f"{k} goals")
            )
            progress.close()
            rows[cfg.arm.name] = measures(done) | {"stops": len(stops)}
            episodes[cfg.arm.name] = done
            (run.folder / "stops.txt").write_text("\n".join(stops) + "\n" if stops else "none\n")
            if cfg.simulator.name == "mujoco":
                path = np.linalg.norm(done.ee - episodes["mujoco"].ee, axis=-1)
                rows[cfg.arm.name]["ee_path_rmse_mm"] = float(1e3 * np.sqrt((path**2).mean()))
        run.summary(rows)
        tell.transfer(run, robot, episodes)
        report.reach_table(console(), rows, f"{source.name} on {len(goals)} goals")
    print(f"written: {run.folder}")


def compare(cfg, overrides):
    """Put runs of stage=train side by side: table, learning curves."""
    from glob import glob

    from r2s import report, tell
    from r2s.errors import UserError
    from r2s.runs import read_summary

    folders = [f for f in sorted(glob(cfg.runs or "")) if (Path(f) / "summary.json").is_file()]
    folders = [f for f in folders if (Path(f) / "evaluations.csv").is_file()]
    if not folders:
        raise UserError(f"runs: no finished run of stage=train matches '{cfg.runs}'; such as runs='runs/train/*'")
    with open_run(cfg, overrides, parents=folders) as run:
        rows = {Path(f).name: read_summary(f, "runs")["last"] for f in folders}
        run.summary(rows)
        tell.comparison(run, make_robot(cfg), folders)
        report.reach_table(console(), rows, f"{len(rows)} runs, last evaluation")
    print(f"written: {run.folder}")


def pipeline(cfg, overrides):
    """Every stage on the embedded default, each a process of its own; one table, one recording, one report."""
    from r2s import tell
    from r2s.pipeline import run_chain
    from r2s.report import reach_table
    from r2s.runs import read_summary

    robot = make_robot(cfg)
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
            try:
                parsed = OverridesParser.create().parse_override(word)
                name = parsed.key_or_group
                if parsed.is_add() and name not in groups:  # Hydra would take it, and nothing would read it
                    raise UserError(f"unknown option '{name}'{nearest(name, known)}")
                values = list(parsed.sweep_string_iterator()) if parsed.is_sweep_override() else [None]
                trials = [word if v is None else f"{word.split('=', 1)[0]}={v}" for v in values]
                for trial in trials:
                    before, cfg = cfg, compose("config", [*base, trial])
                    check_number(name, before, cfg)
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


def check_number(key, before, after):
    """Raise UserError where a number of the config was replaced by a word."""
    from omegaconf import OmegaConf

    from r2s.errors import UserError

    def number(value):
        return isinstance(value, (int, float)) and not isinstance(value, bool)

    old, new = OmegaConf.select(before, key, throw_on_missing=False), OmegaConf.select(after, key)
    if number(old) and isinstance(new, str):
        raise UserError(f"{key}: '{new}' is not a number, such as {old:g}")


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
            STAGES[cfg.stage](cfg, overrides)
        except (UserError, FloatingPointError) as error:
            sys.exit(stop(error))
        except MissingMandatoryValue as error:
            sys.exit(stop(f"{error.full_key} must be given: {error.full_key}=..."))
        except KeyboardInterrupt:
            print("\ninterrupted; what was written stays in the run folder", file=sys.stderr)
            sys.exit(130)

    try:
        if not asked_for_help:
            check_overrides(words)
        job()
    except UserError as error:
        sys.exit(stop(error))


def stop(error):
    """Print a user's mistake as one line and return the exit status."""
    print(f"error: {error}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    main()
