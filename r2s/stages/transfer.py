"""stage=transfer: run one policy on the same goals in simulators and on an arm."""

import shutil
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from r2s.errors import Stopped, UserError, check_number, nearest_file
from r2s.progress import Progress
from r2s.stages.adapter_factory import make_adapter
from r2s.stages.build import (
    all_threads,
    console,
    is_learner,
    is_simulated,
    is_twin,
    make_controller,
    make_draw,
    make_dynamics,
    make_robot,
    make_task,
    open_run,
    opened_arm,
    opened_runner,
    set_threads,
)
from r2s.stages.parts import part
from r2s.stages.run_config import run_config

REST_GAP = 0.05  # r2s warns if the share of episodes that end at rest on the arm is this much lower than predicted
FROM_POLICY = ("robot", "friction", "inertia", "calibration", "dr", "task", "control", "algo", "reward", "costs")
WHY = {k: "it comes from the policy's run" for k in FROM_POLICY}
WHY |= {"budget": "nothing is trained", "evaluation.env_steps": "nothing is trained", "data": "nothing is recorded"}


def reads(cfg):
    """Return the config keys that stage=transfer reads."""
    return {"policy", "simulator", "arm", "adapt", "safety", "evaluation.episodes"}


def trained_config(cfg, option="policy"):
    """Return the run folder that `policy=` names, and the run's config; error messages begin with `option`.

    The config names the run folder's copies of calibration and surface, so that a transfer needs no other folder.

    Raises:
        UserError: the folder contains no finished training.
    """
    if not cfg.policy:
        raise UserError(f"{option} must be given: {option}=RUN_FOLDER, of a finished stage=train")
    source = Path(cfg.policy)
    if not all((source / name).is_file() for name in ("summary.json", "config.yaml")):
        raise UserError(f"{option}: '{cfg.policy}' is no finished run folder of stage=train{nearest_file(source)}")
    trained = run_config(source, getattr(cfg, "trust", None))
    if trained.stage != "train":
        raise UserError(f"{option}: expected a run of stage=train, got stage={trained.stage} ({source})")
    for node in (trained, trained.dr):  # dr=identified draws from the same calibration
        if node.get("calibration"):
            node.calibration = str(source)
    if trained.dr.get("surface"):
        trained.dr.surface = str(source)
    return source, trained


@dataclass(frozen=True)
class Request:
    """A policy with the start postures and goals of its episodes, which all simulators and the arm share.

    Attributes:
        robot, task: robot and task of the training. center: model at the center of the randomization.
        source: run folder of the training. policy: trained policy or controller. starts, goals: one per episode.
        draw: domain randomization in training; None for simulator=none. soft_start_s: s, duration of the soft start.
    """

    robot: Any
    task: Any
    center: Any
    source: Path
    policy: Any
    starts: Any
    goals: Any
    draw: Any
    soft_start_s: float


def make_request(cfg):
    """Return the `Request`; for a transfer to an arm, first check that the arm can safely reach each start posture.

    Raises:
        UserError: the training is unfinished, simulator and arm are none, the arm is unsuitable, or a path is unsafe.
    """
    from r2s.excitation.motion_checks import Space
    from r2s.excitation.paths import approach
    from r2s.learning.evaluate import fixed_episodes
    from r2s.learning.policy import load_policy

    source, trained = trained_config(cfg)
    check_number("evaluation.episodes", cfg.evaluation.episodes, "[1, inf)", whole=True)
    robot = make_robot(trained)
    center = make_dynamics(trained, robot, announce=True)
    task = make_task(trained, robot, center, cfg.get("safety"))
    set_threads(cfg)
    learned = is_learner(trained)
    policy = load_policy(source, robot, task) if learned else make_controller(trained, robot, task, center)
    starts, goals = fixed_episodes(robot, task, cfg.evaluation.episodes)
    if cfg.simulator.name == cfg.arm.name == "none":
        raise UserError("simulator: expected a simulator or an arm, got simulator=none and arm=none")
    if task.touches and is_simulated(cfg) and not cfg.arm.get("surface"):
        raise UserError(
            f"arm.surface: {type(task).__name__} touches a surface, and this arm has none; "
            f"{'box' if task.moves_box else 'true'} is allowed"
        )
    if task.moves_box and cfg.arm.name != "none" and not (is_twin(cfg) and has_box(cfg.arm.surface)):
        raise UserError(
            f"arm: {type(task).__name__} needs the pose of a box, which arm={cfg.arm.name} does not report; arm=twin "
            "arm.surface=box is allowed"
        )
    if cfg.arm.name != "none":
        space = Space(robot)
        for k, start in enumerate(starts, 1):
            approach(robot, robot.q_home, start, what=f"the start of episode {k}", space=space)
    soft_start_s = cfg.arm.get("soft_start_s", 0.0)
    check_number("arm.soft_start_s", soft_start_s, "[0, inf)")
    draw = make_draw(trained, robot, center) if cfg.simulator.name != "none" else None
    return Request(robot, task, center, source, policy, starts, goals, draw, soft_start_s)


def has_box(surface):
    """Return whether `surface`, a value of arm.surface, describes a box."""
    return surface == "box" or (hasattr(surface, "get") and surface.get("box") is not None)


@contextmanager
def goal_progress(label):
    """Yield a callback with the arguments (goals done, total) that shows progress."""
    progress = Progress(label)
    yield lambda k, n: progress(k / n, f"{k} goals")
    progress.close()


def run_in_simulators(cfg, request, engine):
    """Run the episodes in MuJoCo, and in `engine` unless it is None; return {name: measures} and {name: Episodes}."""
    from r2s.engines.episodes import EngineArms
    from r2s.learning.evaluate import make_evaluation
    from r2s.tasks.rollout import gap, rollout

    robot, task, count = request.robot, request.task, len(request.goals)
    first = make_evaluation(robot, task, request.draw, episodes=count, nthread=cfg.threads)(request.policy)
    rows, episodes = {"mujoco": task.measures(first)}, {"mujoco": first}
    if engine is not None:
        with goal_progress(f"in {cfg.simulator.name}") as progress:
            arms = EngineArms(engine, robot, task, request.draw, count)
            done = rollout(request.policy, arms, task, request.starts, request.goals, progress)
        rows[cfg.simulator.name] = task.measures(done) | gap(done, first)
        episodes[cfg.simulator.name] = done
    return rows, episodes


@dataclass(frozen=True)
class ArmResult:
    """Result of running the episodes on an arm.

    Attributes:
        tried: (k,) indices of the goals whose episodes began. episodes: the k episodes that began; None if k = 0.
        stops: stops that ended episodes early. timing: durations of the 1 kHz cycles; None if unknown.
        halted: reason why the remaining episodes did not run, or None if all episodes ran.
        blocked: reason of the last episode's stop if the operator must confirm this stop, else None.
    """

    tried: Any = ()
    episodes: Any = None
    stops: Any = ()
    timing: Any = None
    halted: Any = None
    blocked: Any = None


def run_on_arm(cfg, request, runner, predicted):
    """Run the episodes for which no collision or near collision is predicted; return the `ArmResult`."""
    import numpy as np

    from r2s.physics.collision import CollisionCheck
    from r2s.physics.fence import first_breaches
    from r2s.physics.safety_filter import filter_limits
    from r2s.tasks.rollout import rollout, select_episodes

    robot, task = runner.robot, request.task
    check = CollisionCheck(robot, table=None, may_touch=task.may_touch)
    limits = filter_limits(robot, task.torque_limit(robot), speed_share(cfg))
    near = first_breaches(check, limits, predicted.q, predicted.dq)
    tried = np.flatnonzero((predicted.collision == "") & (near < 0))
    for e, (contact, pair) in enumerate(zip(predicted.collision, near, strict=True), 1):
        if contact:
            print(f"episode {e} is skipped: predicted contact, {contact}")
        elif pair >= 0:
            print(f"episode {e} is skipped: {check.names[pair]} would come too near")
    if not len(tried):
        return ArmResult(tried)
    with goal_progress(f"on {cfg.arm.name}") as progress:
        done = rollout(request.policy, runner, request.task, request.starts[tried], request.goals[tried], progress)
    stops = [replace(stop, episode=int(tried[stop.episode])) for stop in runner.stops]
    tried = tried[: runner.done]  # goals whose episodes did not begin are not failures
    episodes = select_episodes(done, slice(len(tried)))
    return ArmResult(tried, episodes, stops, runner.timing, runner.halted, runner.blocked)


def run_on_twins(cfg, request, open_runner):
    """Run the episodes on copies of one twin in parallel processes; return the `ArmResult`."""
    import numpy as np

    from r2s.arm.parallel_episodes import run_parallel_episodes

    with goal_progress(f"on {cfg.arm.name}") as progress:
        workers = all_threads(cfg)
        done, stops, timing = run_parallel_episodes(
            open_runner, request.policy, request.task, request.starts, request.goals, workers, progress
        )
    return ArmResult(np.arange(len(request.goals)), done, stops, timing)


def speed_share(cfg):
    """Return arm.speed_share, the driver's factor on the speed limits; 1 for arms without this setting."""
    return cfg.arm.get("speed_share", 1.0)


def predict(cfg, request, robot):
    """Return the episodes that the model at the center of the training's randomization predicts for the arm."""
    from r2s.learning.vector_arms import VectorArms
    from r2s.tasks.rollout import rollout

    task, goals = request.task, request.goals
    how = {"soft_start_s": request.soft_start_s, "speed_share": speed_share(cfg)}
    model = VectorArms(robot, task, task.expected(robot, request.center), len(goals), cfg.threads, **how)
    return rollout(request.policy, model, task, request.starts, goals)


def save_arm_result(run, request, name, result, predicted):
    """Write stops.txt, timing.csv and episodes_<arm>.csv (a row per episode); return the measures on the arm.

    predicted: episodes that the model predicted; if None, the arm's episodes are not compared with a prediction.
    """
    import pandas as pd

    from r2s.tasks.rollout import episode_measures, gap, select_episodes

    task = request.task
    row = {"stops": len(result.stops), "episodes": len(result.tried), "asked": len(request.goals)}
    if len(result.tried):
        expected = None if predicted is None else select_episodes(predicted, result.tried)
        row = task.measures(result.episodes) | row | (gap(result.episodes, expected) if expected else {})
        measures = pd.DataFrame(episode_measures(task, result.episodes, expected))
        measures.to_csv(run.folder / f"episodes_{name}.csv", index=False)
    for line in result.timing.table() if result.timing else []:
        run.log("timing", line)
    (run.folder / "stops.txt").write_text("".join(f"{stop}\n" for stop in result.stops) or "none\n")
    return row


def rest_warning(rows, name):
    """Return a warning if more episodes end with a moving joint on the arm than predicted, else None.

    Episodes that were stopped do not count: they are not at rest, but the driver has braked the arm.
    Shaking joints hardly move the end effector, so success and path gap do not reveal the shaking
    (benchmarks/results/transfer.md).
    """
    row = rows.get(name, {})
    seen, expected = row.get("rest"), rows.get("predicted", {}).get("rest")
    if seen is None or expected is None:
        return None
    moving = 1 - seen - row.get("stops", 0) / max(row.get("episodes", 1), 1)
    if moving <= 1 - expected + REST_GAP:
        return None
    return (
        f"warning: {100 * moving:.0f} % of the episodes on arm={name} end with a moving joint, "
        f"{100 * (1 - expected):.0f} % were predicted: the policy creeps or shakes. Check its torques first"
    )


def transfer(cfg, overrides):
    """Run a policy on the same goals in simulators and on an arm; an adapter acts on the arm only."""
    from r2s.reporting import pages
    from r2s.reporting.tables import print_measures
    from r2s.tasks.measures import write_measures

    request = make_request(cfg)
    robot, task, goals, name = request.robot, request.task, request.goals, cfg.arm.name
    adapter = make_adapter(cfg, robot, request.source)
    engine = part(cfg.simulator, "simulator", robot) if "_target_" in cfg.simulator else None
    if twin := is_twin(cfg):
        with opened_arm(cfg, robot):
            pass  # raise UserError for a wrong setting of the twin before a run folder exists
    open_runner = partial(opened_runner, cfg, robot, task, request.center, adapter=adapter)
    opened = nullcontext() if name == "none" or twin else open_runner()
    rows, episodes, predicted, result = {}, {}, None, ArmResult()
    with opened as runner, open_run(cfg, overrides, parents=[str(request.source)]) as run:
        shutil.copyfile(request.source / "config.yaml", run.folder / "policy.yaml")
        write_measures(run.folder, task.measure_table)
        if twin:  # before any thread starts, because the twins run in forked processes
            result = run_on_twins(cfg, request, open_runner)
        if request.draw is not None:
            rows, episodes = run_in_simulators(cfg, request, engine)
        if name != "none" and (request.draw is not None or runner):
            predicted = predict(cfg, request, runner.robot if runner else robot)
        if runner:
            result = run_on_arm(cfg, request, runner, predicted)
        if request.draw is None:
            predicted = None  # the prediction was needed only to skip goals on the arm
        if predicted is not None:
            rows["predicted"], episodes["predicted"] = task.measures(predicted) | {"stops": 0}, predicted
        if name != "none":
            rows[name] = save_arm_result(run, request, name, result, predicted)
            episodes |= {name: result.episodes} if len(result.tried) else {}
        run.summary(rows)
        if episodes:
            limits = task.torque_limit(robot)
            pages.transfer(run, robot, episodes, rows, limits, result.timing, result.stops, result.halted)
        print_measures(console(), task.measure_table, rows, f"{request.source.name} on {len(goals)} goals")
        if warning := rest_warning(rows, name):
            print(warning)
        if (why := result.halted or result.blocked) is not None:  # a later job must not move a blocked arm
            count = len(result.tried)
            raise Stopped(f"{count} of {len(goals)} goals done on arm={name}: {why}; see {run.folder}")
    print(f"written: {run.folder}")
