"""stage=train: train one policy in simulation, evaluate it, and save it as policy.pt and policy.onnx."""

import copy
import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from r2s.errors import UserError, check_number
from r2s.stages.build import (
    all_threads,
    console,
    device,
    is_learner,
    make_controller,
    make_draw,
    make_dynamics,
    make_robot,
    make_task,
    open_run,
    set_threads,
)
from r2s.stages.parts import called, part, plain, target

WHY = {
    "friction": "the friction comes from calibration=",
    "inertia": "the link parameters come from calibration=",
    "budget": "nothing is trained with this algo",
    "reward": "nothing is trained with this algo",
    "costs": "nothing is trained with this algo",
    "adapt": "adapters work on an arm, with stage=transfer",
    "arm": "a training uses no arm; stage=transfer does",
    "simulator": "it trains in MuJoCo; stage=transfer uses other engines",
    "data": "only stage=identify records or reads a motion",
    "identify": "only stage=identify identifies; calibration= loads its result",
    "search": "only stage=identify searches; calibration= loads its result",
}
CALIBRATION = ("parameters.yaml", "posterior.npz")  # files of an identification that a training copies
SURFACE = ("contact.yaml", "contact_posterior.npz")  # files of dr.surface= that a training copies
UPDATE_THREADS = 4  # largest number of threads for updates; networks of 128 units cannot use more


def reads(cfg):
    """Return the config keys that stage=train reads."""
    keys = {"robot", "dr", "algo", "task", "control", "safety", "evaluation.episodes", "calibration"}
    if not cfg.calibration:
        keys |= {"friction", "inertia"}
    if "n_envs" in cfg.algo:  # the algorithm learns
        keys |= {"budget", "reward", "costs", "evaluation", "compile", "matmul", "device"}
    return keys


@dataclass(frozen=True)
class Parts:
    """Objects for a training, made before the run folder, so that a config error creates no folder.

    For a controller without learning, `algo` is the controller, and `env` and all later attributes are None.
    """

    robot: Any
    task: Any
    draw: Any
    episodes: int
    algo: Any
    env: Any = None
    evaluate: Any = None
    loop: Any = None
    budget: Any = None
    demonstrator: Any = None


def make_parts(cfg):
    """Return the `Parts` of the training that a config describes.

    Raises:
        UserError: a setting is invalid.
    """
    import torch

    from r2s.learning.demonstrations import make_demonstrator
    from r2s.learning.env import TaskEnv
    from r2s.learning.evaluate import SELECTION, make_evaluation
    from r2s.learning.policy import normalization
    from r2s.learning.train import Budget
    from r2s.tasks.costs import ConstrainedReward

    episodes, learns = cfg.evaluation.episodes, is_learner(cfg)
    check_number("evaluation.episodes", episodes, "[1, inf)", whole=True)
    if learns:
        n_envs, demonstrations, residual_l2, loop, settings = split_algo(cfg)
        budget = called(Budget, "budget", plain(cfg.budget))
    robot, model = make_robot(cfg), with_own_calibration(cfg)
    center = make_dynamics(model, robot, announce=True)
    task, draw = make_task(cfg, robot, center), make_draw(model, robot, center)
    if not learns:
        return Parts(robot, task, draw, episodes, make_controller(cfg, robot, task, center))
    reward = part(cfg.reward, "reward")
    if limits := {k: v for k, v in plain(cfg.get("costs") or {}).items() if v is not None}:
        reward = ConstrainedReward(reward, robot, limits)
    learning, stepping = share_threads(cfg)
    set_threads(cfg, learning)
    env = TaskEnv(robot, task, draw, n_envs, nthread=stepping, seed=cfg.seed, stagger=True, reward=reward)
    evaluate = make_evaluation(robot, task, draw, episodes=episodes, nthread=cfg.threads, seed=SELECTION)
    action_scale = torch.from_numpy(task.control(robot).action_scale)
    demonstrator = make_demonstrator(robot, task, center) if demonstrations else None
    loop = replace(loop, learning_starts=demonstrations) if demonstrator else loop
    residual = demonstrator is not None and demonstrator.at_zero
    settings |= {"action_l2": residual_l2} if residual and residual_l2 is not None else {}
    algo = called(target(cfg.algo, "algo"), "algo", settings, normalization(robot, task), action_scale)
    if residual:
        algo.begin_at_zero()
    check_length(budget, loop, n_envs, "demonstrations" if demonstrator else "learning_starts")
    return Parts(robot, task, draw, episodes, algo.to(device(cfg)), env, evaluate, loop, budget, demonstrator)


def check_length(budget, loop, n_envs, key):
    """Raise UserError if the budget ends before the first update; the error names the setting algo.`key`."""
    before = n_envs * max(1, math.ceil(loop.learning_starts / n_envs))
    if budget.env_steps is not None and budget.env_steps <= before:
        raise UserError(
            f"budget.env_steps: expected more than {before}, the env steps before the first update of "
            f"algo.{key}={loop.learning_starts} and algo.n_envs={n_envs}, got {budget.env_steps}"
        )


class Selection:
    """The best and the last evaluation of a training; of equally good evaluations, the latest is the best."""

    def __init__(self, task):
        self._task, self.best, self.last = task, {}, {}

    def add(self, row):
        """Add a row of evaluations.csv; return whether this evaluation is the best so far."""
        self.last = row
        better = not self.best or self._task.score(row) >= self._task.score(self.best)
        self.best = row if better else self.best
        return better


def train(cfg, overrides):
    """Train one policy in simulation, evaluate it, and save it; a controller without learning is only evaluated."""
    from r2s.learning.checkpoint import Checkpoint
    from r2s.learning.policy import save_policy
    from r2s.learning.train import Callbacks
    from r2s.learning.train import train as run_train
    from r2s.progress import Progress
    from r2s.tasks.measures import write_measures

    parts = make_parts(cfg)
    if parts.env is None:
        return evaluate_reference(cfg, overrides, parts)
    algo, measures, selection = parts.algo, parts.task.measure_table, Selection(parts.task)
    with open_run(cfg, overrides) as run:
        keep_calibration(cfg, run.folder)
        write_measures(run.folder, measures)
        progress = Progress(f"train {cfg.algo.name}")
        checkpoint = Checkpoint(run.folder / "checkpoints")
        if cfg.resume:
            run.rewind("metrics", "env_steps", checkpoint.env_steps)
            for row in run.rewind("evaluations", "env_steps", checkpoint.env_steps):
                selection.add(row)

        def evaluated(row):
            if selection.add(run.log("evaluations", row)):
                save_policy(run.folder, copy.deepcopy(algo.policy).cpu())

        def show(share, row):
            text = f"{row['env_steps'] / 1e3:.0f}k env steps, {row['updates']} updates"
            progress(share, ", ".join([text, *measures.in_words(row)]))

        callbacks = Callbacks(lambda row: run.log("metrics", row), evaluated, show)
        given = parts.env, algo, parts.evaluate, parts.loop, parts.budget
        run_train(*given, demonstrator=parts.demonstrator, checkpoint=checkpoint, callbacks=callbacks)
        progress.close()
        conclude(cfg, run, parts, selection)
        checkpoint.clear()
    print(f"written: {run.folder}")


def conclude(cfg, run, parts, selection):
    """Evaluate best and last policy on goals not used for selection; write policy.onnx, summary.json, figure."""
    from r2s.learning.evaluate import make_evaluation
    from r2s.learning.policy import export_onnx, load_policy
    from r2s.reporting import pages
    from r2s.reporting.tables import print_measures

    robot, task = parts.robot, parts.task
    policy = load_policy(run.folder, robot, task)
    export_onnx(run.folder / "policy.onnx", policy, robot, task)
    evaluate = make_evaluation(robot, task, parts.draw, episodes=parts.episodes, nthread=cfg.threads)
    rows = {"best": selection.best | task.measures(evaluate(policy))}
    rows["last"] = selection.last | task.measures(evaluate(copy.deepcopy(parts.algo.policy).cpu()))
    run.summary(rows | {"best on the selection goals": selection.best})
    pages.training(run, robot)
    print_measures(console(), task.measure_table, rows, f"{title(cfg)}; on goals without selection")


def share_threads(cfg):
    """Return the number of threads for network updates and the number for the physics, which run at the same time."""
    learning = max(1, min(UPDATE_THREADS, all_threads(cfg) // 2))
    return learning, max(1, all_threads(cfg) - learning)


def split_algo(cfg):
    """Split conf/algo into number of arms, env steps of demonstrations, residual_l2, `Loop` and other settings."""
    from r2s.learning.train import Loop

    settings = {k: v for k, v in plain(cfg.algo).items() if k not in ("_target_", "name")}
    n_envs = settings.pop("n_envs", 32)
    check_number("algo.n_envs", n_envs, "[1, inf)", whole=True)
    demonstrations = settings.pop("demonstrations", 0)
    check_number("algo.demonstrations", demonstrations, "[0, inf)", whole=True)
    residual_l2 = settings.pop("residual_l2", None)  # older configs lack this key
    if residual_l2 is not None:
        check_number("algo.residual_l2", residual_l2, "[0, inf)")
    loop = {f.name: settings.pop(f.name) for f in fields(Loop) if f.name in settings}
    loop |= {"eval_env_steps": cfg.evaluation.env_steps, "compile": cfg.compile, "matmul": cfg.matmul}
    loop |= {"concurrent": all_threads(cfg) > 1}
    return n_envs, demonstrations, residual_l2, Loop(**loop), settings


def with_own_calibration(cfg):
    """Return the config; in that of a resumed training, `calibration` and `dr` point to the copies in its run folder.

    The original files may no longer exist.
    """
    if not cfg.resume:
        return cfg
    model = cfg.copy()
    if cfg.calibration and (Path(cfg.resume) / CALIBRATION[0]).is_file():
        if cfg.dr.get("calibration") == cfg.calibration:  # dr=identified draws from the same calibration
            model.dr.calibration = cfg.resume
        model.calibration = cfg.resume
    if cfg.dr.get("surface") and (Path(cfg.resume) / SURFACE[0]).is_file():
        model.dr.surface = cfg.resume
    return model


def keep_calibration(cfg, folder):
    """Copy the identified parameters and surface into the run folder, so that a transfer needs no other folder."""
    import shutil

    from r2s.files import atomic_write

    for given, names in ((cfg.calibration, CALIBRATION), (cfg.dr.get("surface"), SURFACE)):
        if not given or (folder / names[0]).is_file():
            continue
        source = Path(given)
        for name in reversed(names):  # copy the first file last, because `with_own_calibration` looks for it
            path = source / name if source.is_dir() else source.with_name(name)
            path = source if name == names[0] and not source.is_dir() else path
            if path.is_file():
                with atomic_write(folder / name) as part:
                    shutil.copyfile(path, part)


def title(cfg):
    """Return the title for the table of a training's measures."""
    spread = ", ".join(f"{k} {v}" for k, v in plain(cfg.dr).items() if k != "_target_" and v is not None)
    return f"{cfg.algo.name} in MuJoCo, dr: {spread}"


def evaluate_reference(cfg, overrides, parts):
    """Evaluate a controller that needs no training, in the same way as a trained policy."""
    from r2s.learning.evaluate import make_evaluation
    from r2s.reporting import pages
    from r2s.reporting.tables import print_measures
    from r2s.tasks.measures import write_measures

    robot, task, name = parts.robot, parts.task, cfg.algo.name
    evaluate = make_evaluation(robot, task, parts.draw, episodes=parts.episodes, nthread=cfg.threads)
    with open_run(cfg, overrides) as run:
        keep_calibration(cfg, run.folder)
        write_measures(run.folder, task.measure_table)
        done = evaluate(parts.algo)
        row = {"env_steps": 0, "updates": 0, "wall_clock_s": 0.0} | task.measures(done)
        run.log("evaluations", row)
        run.summary({"best": row, "last": row})
        pages.transfer(run, robot, {name: done}, {name: row}, task.torque_limit(robot))
        print_measures(console(), task.measure_table, {name: row}, title(cfg))
    print(f"written: {run.folder}")
