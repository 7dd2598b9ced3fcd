"""stage=transfer: the same policy and goals in simulators and on an arm."""

from pathlib import Path

from r2s.stages.build import (
    console,
    make_arm,
    make_draw,
    make_dynamics,
    make_engine,
    make_robot,
    make_task,
    open_run,
    oracle,
    set_threads,
)


def transfer(cfg, overrides):
    """Evaluate a trained policy in simulators and on an arm, on the same goals."""
    from omegaconf import OmegaConf

    from r2s.arm.deploy import DrivenArm
    from r2s.arm.driven_batch import DrivenBatch
    from r2s.arm.interface import ArmStopped
    from r2s.engines.episodes import EngineArms
    from r2s.errors import UserError, nearest
    from r2s.learning.evaluate import fixed_episodes, make_evaluation
    from r2s.learning.policy import load_policy
    from r2s.progress import Progress
    from r2s.reporting import pages
    from r2s.reporting.tables import reach_table
    from r2s.tasks.episode import gap, rollout

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
            rows["mujoco"], episodes["mujoco"] = task.measures(done), done
            if engine is not None:
                progress, shown = counted(f"reach in {cfg.simulator.name}")
                arms = EngineArms(engine, robot, task, draw, len(goals))
                done = rollout(policy, arms, task, starts, goals, shown)
                progress.close()
                rows[cfg.simulator.name] = task.measures(done) | gap(done, episodes["mujoco"])
                episodes[cfg.simulator.name] = done
        if arm is not None:
            fade = cfg.arm.soft_start_s
            if dynamics is not None:  # what the model says of this arm, behind the same driver
                model = DrivenBatch(arm.robot, dynamics, task, len(goals), soft_start_s=fade, nthread=cfg.threads)
                done = rollout(policy, model, task, starts, goals)
                rows["predicted"], episodes["predicted"] = task.measures(done) | {"stops": len(model.stops)}, done
            progress, shown = counted(f"reach on {cfg.arm.name}")
            driven = DrivenArm(arm, task, soft_start_s=fade)
            done = rollout(policy, driven, task, starts, goals, shown)
            stops, timing = driven.stops, driven.timing
            progress.close()
            rows[cfg.arm.name], episodes[cfg.arm.name] = task.measures(done) | {"stops": len(stops)}, done
            if "predicted" in rows:
                rows[cfg.arm.name] |= gap(done, episodes["predicted"])
            for row in timing.table():
                run.log("timing", row)
            (run.folder / "stops.txt").write_text("".join(f"{stop}\n" for stop in stops) or "none\n")
        run.summary(rows)
        pages.transfer(run, robot, episodes, rows, task.torque(robot), timing, stops)
        reach_table(console(), rows, f"{source.name} on {len(goals)} goals")
    print(f"written: {run.folder}")
