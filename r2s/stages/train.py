"""stage=train: train one policy in simulation, evaluate it, save it as policy.pt and policy.onnx."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from r2s.errors import check_number
from r2s.stages.adapting import is_taught, is_told, make_lessons, teach, teach_latent, told_draw, told_of
from r2s.stages.build import (
    Evaluation,
    called,
    check_words,
    console,
    device,
    is_learner,
    make_controller,
    make_draw,
    make_dynamics,
    make_robot,
    make_task,
    open_run,
    plain,
    set_threads,
    target,
)

WHY = {
    "friction": "calibration= says what friction is",
    "inertia": "calibration= says what the links are",
    "budget": "nothing is trained with this algo",
    "reward": "nothing is trained with this algo",
    "adapt": "adapters work on an arm, with stage=transfer; of them history is trained, osi and rma with a policy",
    "arm": "a training meets no arm; stage=transfer does",
    "simulator": "it trains in MuJoCo; stage=transfer goes to another engine",
    "data": "only stage=identify records or reads a motion",
    "identify": "only stage=identify does that; calibration= brings what it found",
    "search": "only stage=identify searches; calibration= brings what it found",
}
CALIBRATION = ("parameters.yaml", "posterior.npz")  # of an identification, kept by what was trained on it


def reads(cfg):
    """Return the keys of the config that this stage reads."""
    if is_taught(cfg):
        return {"robot", "task", "calibration", "adapt"}
    keys = {"robot", "dr", "algo", "task", "evaluation.episodes", "calibration"}
    if not cfg.calibration:
        keys |= {"friction", "inertia"}
    if "n_envs" in cfg.algo:  # else it is a controller
        keys |= {"budget", "reward", "evaluation", "compile", "matmul", "device"}
        keys |= {"adapt"} if is_told(cfg) else set()
    return keys


@dataclass(frozen=True)
class Parts:
    """What a training is made of. What a config says wrongly of it is said while they are made, before any folder."""

    robot: Any
    center: Any
    task: Any
    identified: Any
    draw: Any
    told: Any
    weights: Any
    env: Any
    evaluate: Any
    algo: Any
    loop: Any
    budget: Any
    episodes: int
    device: str


def make_parts(cfg):
    """Return the parts of the training that a config asks for.

    Raises:
        UserError: it asks for none that there can be.
    """
    import torch

    from r2s.learning.env import TaskEnv
    from r2s.learning.evaluate import SELECTED, make_evaluation
    from r2s.learning.policy import observation_scale
    from r2s.tasks.rewards import Curriculum

    evaluation = called(Evaluation, "evaluation", plain(cfg.evaluation))
    n_envs, loop, settings = split(cfg)
    budget = make_budget(cfg)
    robot, model = make_robot(cfg), own_model(cfg)
    center = make_dynamics(model, robot)
    task, draw = make_task(cfg, robot, center), make_draw(model, robot, center)
    identified, told = draw, told_of(cfg, robot)
    if told:
        draw = told_draw(cfg, robot, center, draw)
    weights = called(Curriculum, "reward", plain(cfg.reward))
    set_threads(cfg)
    env = TaskEnv(robot, task, draw, n_envs, nthread=cfg.threads, seed=cfg.seed, stagger=True)
    evaluate = make_evaluation(robot, task, draw, episodes=evaluation.episodes, nthread=cfg.threads, seed=SELECTED)
    torque = torch.from_numpy(task.share * task.torque(robot))
    scale = observation_scale(robot, task, told)
    given = (scale, torque, told) if told else (scale, torque)
    algo = called(target(cfg.algo, "algo"), "algo", settings, *given)
    many, on = evaluation.episodes, device(cfg)
    return Parts(robot, center, task, identified, draw, told, weights, env, evaluate, algo, loop, budget, many, on)


def check(cfg):
    """Raise UserError where stage=train would refuse this config before it makes a run folder."""
    if is_taught(cfg):
        make_lessons(cfg)
    elif is_learner(cfg):
        make_parts(cfg)
    else:
        make_reference(cfg)


def train(cfg, overrides):
    """Train one policy in simulation, evaluate it, save it as policy.pt and policy.onnx."""
    import copy

    from r2s.learning.checkpoint import Checkpoint
    from r2s.learning.evaluate import make_evaluation
    from r2s.learning.policy import export_onnx, load_policy, save_policy
    from r2s.learning.train import Listeners
    from r2s.learning.train import train as run_train
    from r2s.progress import Progress
    from r2s.reporting import pages
    from r2s.reporting.measures import in_short
    from r2s.reporting.tables import reach_table

    if is_taught(cfg):
        return teach(cfg, overrides, keep_calibration)
    if not is_learner(cfg):
        return reference(cfg, overrides)
    made = make_parts(cfg)
    robot, task, algo = made.robot, made.task, made.algo.to(made.device)
    best: dict = {}
    last: dict = {}

    def is_best(row):
        nonlocal best, last
        last = row
        better = not best or task.score(row) >= task.score(best)
        best = row if better else best
        return better

    with open_run(cfg, overrides, parents=[cfg.calibration] if cfg.calibration else []) as run:
        keep_calibration(cfg, run.folder)
        progress = Progress(f"train {cfg.algo.name}")
        checkpoint = Checkpoint(run.folder / "checkpoints")
        if cfg.resume:
            run.rewind("metrics", "env_steps", checkpoint.env_steps)
            for row in run.rewind("evaluations", "env_steps", checkpoint.env_steps):
                is_best(row)

        def evaluated(row):
            if is_best(run.log("evaluations", row)):
                save_policy(run.folder, copy.deepcopy(algo.policy).cpu())

        def show(share, row):
            text = f"{row['env_steps'] / 1e3:.0f}k env steps, {row['updates']} updates"
            progress(share, ", ".join([text, *in_short(row)]))

        run_train(
            made.env,
            algo,
            made.evaluate,
            made.weights,
            made.loop,
            made.budget,
            checkpoint=checkpoint,
            dump=run.folder / "dump.pt",
            listeners=Listeners(lambda row: run.log("metrics", row), evaluated, show),
        )
        progress.close()
        policy = load_policy(run.folder, robot, task)
        export_onnx(run.folder / "policy.onnx", policy, robot, task)
        judge = make_evaluation(robot, task, made.draw, episodes=made.episodes, nthread=cfg.threads)
        judged = {"best": best | task.measures(judge(policy))}
        judged["last"] = last | task.measures(judge(copy.deepcopy(algo.policy).cpu()))
        more = {"best on the goals it was chosen on": best}
        if made.told and made.told.latent:
            arms = made.center, made.identified
            more["student"] = teach_latent(cfg, run.folder, robot, task, *arms, policy)
        checkpoint.clear()
        run.summary(judged | more)
        pages.training(run, robot)
        reach_table(console(), judged, f"{title(cfg)}; on goals that nothing was chosen on")
    print(f"written: {run.folder}")


def split(cfg):
    """Return what conf/algo says of the environment, of the loop, and of the learner: arms, `Loop`, dict."""
    from r2s.learning.train import Loop

    settings = {k: v for k, v in plain(cfg.algo).items() if k not in ("_target_", "name")}
    n_envs = settings.pop("n_envs", 32)
    check_number("algo.n_envs", n_envs, "[1, inf)", whole=True)
    words = {f.name: settings.pop(f.name) for f in fields(Loop) if f.name in settings}
    check_words(Loop, "algo", words)
    words |= {"eval_env_steps": cfg.evaluation.env_steps, "compile": cfg.compile, "matmul": cfg.matmul}
    return n_envs, Loop(**words), settings


def make_budget(cfg):
    """Return when the training ends."""
    from r2s.learning.train import Budget

    return called(Budget, "budget", plain(cfg.budget))


def own_model(cfg):
    """Return the config that says what the arm is: of a training that goes on, with the calibration that it kept."""
    if not (cfg.calibration and cfg.resume and (Path(cfg.resume) / CALIBRATION[0]).is_file()):
        return cfg
    model = cfg.copy()
    model.calibration = cfg.resume  # its first place may be gone
    return model


def keep_calibration(cfg, folder):
    """Copy what was identified into the run folder: it transfers without the one that it came from."""
    import shutil

    from r2s.files import whole

    if not cfg.calibration or (folder / CALIBRATION[0]).is_file():
        return
    source = Path(cfg.calibration)
    for name in reversed(CALIBRATION):  # where the first is, all are
        path = source / name if source.is_dir() else source.with_name(name)
        path = source if name == CALIBRATION[0] and not source.is_dir() else path
        if path.is_file():
            with whole(folder / name) as part:
                shutil.copyfile(path, part)


def title(cfg):
    """Return what the table of a training says above it."""
    spread = ", ".join(f"{k} {v}" for k, v in plain(cfg.dr).items() if k != "_target_" and v is not None)
    return f"{cfg.algo.name} in MuJoCo, dr: {spread}"


def make_reference(cfg):
    """Return robot, task, controller, and how it is evaluated: of an algo that is not trained."""
    from r2s.learning.evaluate import make_evaluation

    evaluation = called(Evaluation, "evaluation", plain(cfg.evaluation))
    robot = make_robot(cfg)
    center = make_dynamics(cfg, robot)
    task, draw = make_task(cfg, robot, center), make_draw(cfg, robot, center)
    controller = make_controller(cfg, robot, task, center)
    evaluate = make_evaluation(robot, task, draw, episodes=evaluation.episodes, nthread=cfg.threads)
    return robot, task, controller, evaluate


def reference(cfg, overrides):
    """Evaluate the model-based controller, which is not trained, as a training is evaluated."""
    from r2s.reporting import pages
    from r2s.reporting.tables import reach_table

    name, (robot, task, controller, evaluate) = cfg.algo.name, make_reference(cfg)
    with open_run(cfg, overrides, parents=[cfg.calibration] if cfg.calibration else []) as run:
        keep_calibration(cfg, run.folder)
        done = evaluate(controller)
        row = {"env_steps": 0, "updates": 0, "wall_clock_s": 0.0} | task.measures(done)
        run.log("evaluations", row)
        run.summary({"best": row, "last": row})
        pages.transfer(run, robot, {name: done}, {name: row}, task.torque(robot))
        reach_table(console(), {name: row}, title(cfg))
    print(f"written: {run.folder}")
