"""stage=transfer: the same policy and goals in simulators and on an arm."""

import os
from contextlib import nullcontext
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

from r2s.errors import Stopped, UserError, check_number, nearest
from r2s.stages.adapting import is_told, make_adapter
from r2s.stages.build import (
    console,
    is_learner,
    is_twin,
    loaded,
    make_controller,
    make_draw,
    make_dynamics,
    make_robot,
    make_task,
    open_run,
    opened_arm,
    opened_arms,
    part,
    set_threads,
)

FROM_POLICY = "it comes from the policy's run"
WHY = {k: FROM_POLICY for k in ("robot", "friction", "inertia", "calibration", "dr", "task", "algo", "reward")}
WHY |= {"budget": "nothing is trained", "evaluation.env_steps": "nothing is trained", "data": "nothing is recorded"}


def some(episodes, which):
    """Return those of these episodes that `which` (., ) numbers."""
    of_each = {f.name for f in fields(episodes)} - {"t"}
    return replace(episodes, **{name: getattr(episodes, name)[which] for name in of_each})


def reads(cfg):
    """Return the keys of the config that this stage reads."""
    return {"policy", "simulator", "arm", "adapt", "evaluation.episodes"}


def trained_config(cfg, what="policy"):
    """Return the run folder of `policy=` and the config that it was made with; `what` names it in an error.

    What it was calibrated with lies in that folder too, so that it needs no other.

    Raises:
        UserError: it is no finished training.
    """
    source = Path(cfg.policy) if cfg.policy else None
    if source is None or not all((source / name).is_file() for name in ("summary.json", "config.yaml")):
        names = [p.name for p in source.parent.glob("*")] if source and source.parent.is_dir() else []
        near = nearest(source.name, names) if source else ""
        raise UserError(f"{what}: '{cfg.policy}' is no finished run folder of stage=train{near}")
    trained = loaded(source / "config.yaml")
    if trained.stage != "train":
        raise UserError(f"{what}: {source} is a run of stage={trained.stage}; allowed: train")
    if trained.calibration:
        trained.calibration = str(source)
    return source, trained


def transfer(cfg, overrides):
    """Evaluate a trained policy in simulators and on an arm, on the same goals; adapters act on the arm alone."""
    import numpy as np

    from r2s.arm.spread import spread
    from r2s.engines.episodes import EngineArms
    from r2s.excitation.paths import approach
    from r2s.excitation.safety import Space
    from r2s.learning.batch import ArmBatch
    from r2s.learning.evaluate import fixed_episodes, make_evaluation
    from r2s.learning.policy import load_policy
    from r2s.progress import Progress
    from r2s.reporting import pages
    from r2s.reporting.tables import reach_table
    from r2s.tasks.episode import gap, rollout

    source, trained = trained_config(cfg)
    check_number("evaluation.episodes", cfg.evaluation.episodes, "[1, inf)", whole=True)
    robot = make_robot(trained)
    center = make_dynamics(trained, robot)
    task = make_task(trained, robot, center)
    set_threads(cfg)
    learned = is_learner(trained)
    policy = load_policy(source, robot, task) if learned else make_controller(trained, robot, task, center)
    starts, goals = fixed_episodes(robot, task, cfg.evaluation.episodes)
    if cfg.simulator.name == cfg.arm.name == "none":
        raise UserError("simulator=none and arm=none leave nothing to do; allowed is one of both")
    if cfg.arm.name != "none":
        space = Space(robot)
        for k, start in enumerate(starts, 1):
            approach(robot, robot.q_home, start, what=f"the start of episode {k}", space=space)
    fade = cfg.arm.get("soft_start_s", 0.0)
    check_number("arm.soft_start_s", fade, "[0, inf)")
    adapter = make_adapter(cfg, robot, source)
    if is_told(cfg) and policy.told and policy.told.latent:
        policy = policy.by_latent()
    dynamics, draw = None, None
    if cfg.simulator.name != "none":
        dynamics = center
        draw = make_draw(trained, robot, dynamics)
    engine = part(cfg.simulator, "simulator", robot) if "_target_" in cfg.simulator else None
    rows, episodes, timing = {}, {}, None
    stops: list = []

    def counted(what):
        progress = Progress(what)
        return progress, lambda k, n: progress(k / n, f"{k} goals")

    if twin := is_twin(cfg):
        with opened_arm(cfg, robot):
            pass  # what is wrong with it is said before there is a run folder
    opens = partial(opened_arms, cfg, robot, task, center, adapter=adapter)
    opened = nullcontext() if cfg.arm.name == "none" or twin else opens()
    with opened as driven, open_run(cfg, overrides, parents=[str(source)]) as run:
        on_twin = None
        if twin:  # first: it forks, and then there are no threads yet
            progress, shown = counted(f"on {cfg.arm.name}")
            on_twin = spread(opens, policy, task, starts, goals, cfg.threads or os.cpu_count() or 1, shown)
            progress.close()
        if draw is not None:
            done = make_evaluation(robot, task, draw, episodes=len(goals), nthread=cfg.threads)(policy)
            rows["mujoco"], episodes["mujoco"] = task.measures(done), done
            if engine is not None:
                progress, shown = counted(f"in {cfg.simulator.name}")
                arms = EngineArms(engine, robot, task, draw, len(goals))
                done = rollout(policy, arms, task, starts, goals, shown)
                progress.close()
                rows[cfg.simulator.name] = task.measures(done) | gap(done, episodes["mujoco"])
                episodes[cfg.simulator.name] = done
        halted = None
        if cfg.arm.name != "none":
            if dynamics is not None or driven is not None:  # what the model says of this arm
                model = ArmBatch(driven.robot if driven else robot, task, center, len(goals), cfg.threads, fade)
                predicted = rollout(policy, model, task, starts, goals)
            if dynamics is not None:
                rows["predicted"], episodes["predicted"] = task.measures(predicted) | {"stops": 0}, predicted
            tried = np.arange(len(goals))
            if on_twin is not None:
                done, stops, timing = on_twin
            elif driven is not None:
                tried = np.flatnonzero(predicted.collision == "")
                for e, what in enumerate(predicted.collision, 1):
                    if what:
                        print(f"episode {e} is left out: the arm would touch something, {what}")
            if driven is not None and len(tried):
                progress, shown = counted(f"on {cfg.arm.name}")
                done = rollout(policy, driven, task, starts[tried], goals[tried], shown)
                stops = [replace(stop, episode=int(tried[stop.episode])) for stop in driven.stops]
                timing, halted, tried = driven.timing, driven.halted, tried[: driven.done]
                progress.close()
            row: dict = {"stops": len(stops), "episodes": len(tried), "asked": len(goals)}
            if len(tried):  # what was not done is no failure
                done = some(done, slice(len(tried)))
                row = task.measures(done) | row
                episodes[cfg.arm.name] = done
                if "predicted" in rows:
                    row |= gap(done, some(predicted, tried))
            rows[cfg.arm.name] = row
            for row in timing.table() if timing else []:
                run.log("timing", row)
            (run.folder / "stops.txt").write_text("".join(f"{stop}\n" for stop in stops) or "none\n")
        run.summary(rows)
        if episodes:
            pages.transfer(run, robot, episodes, rows, task.torque(robot), timing, stops, halted)
        reach_table(console(), rows, f"{source.name} on {len(goals)} goals")
        if halted is not None:
            count = rows[cfg.arm.name]["episodes"]
            raise Stopped(f"{count} of {len(goals)} goals done on arm={cfg.arm.name}: {halted}; see {run.folder}")
    print(f"written: {run.folder}")
