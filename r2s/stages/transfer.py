"""stage=transfer: the same policy and goals in simulators and on an arm."""

import os
import shutil
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from r2s.errors import Stopped, UserError, check_number, nearest
from r2s.progress import Progress
from r2s.stages.adapting import is_told, make_adapter, trained_minutes
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

RESTLESS = 0.05  # of the episodes: this many more than predicted that do not end at rest are told
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


@dataclass(frozen=True)
class Asked:
    """What is taken where: one policy, on the same goals everywhere.

    Attributes:
        robot, task, center: the arm and task of its training, and the centre of the arms that it was trained on.
        source: its run folder. policy: it, or a controller. starts, goals: of all episodes.
        draw: the arms of its training; None where nothing is asked of a simulator. fade: s, `arm.soft_start_s`.
    """

    robot: Any
    task: Any
    center: Any
    source: Path
    policy: Any
    starts: Any
    goals: Any
    draw: Any
    fade: float


def asked_for(cfg):
    """Return what a transfer is asked for, checked: an arm is not moved before every start is known to be reached.

    Raises:
        UserError: no finished training, nowhere to go, or a start that no safe way leads to.
    """
    from r2s.excitation.paths import approach
    from r2s.excitation.safety import Space
    from r2s.learning.evaluate import fixed_episodes
    from r2s.learning.policy import load_policy

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
    draw = make_draw(trained, robot, center) if cfg.simulator.name != "none" else None
    return Asked(robot, task, center, source, policy, starts, goals, draw, fade)


@contextmanager
def counted(what):
    """Show how many goals are done while it is open."""
    progress = Progress(what)
    yield lambda k, n: progress(k / n, f"{k} goals")
    progress.close()


def in_simulators(cfg, asked, engine):
    """Return {name: measures} and {name: Episodes} of MuJoCo and, where there is an engine, of that beside it."""
    from r2s.engines.episodes import EngineArms
    from r2s.learning.evaluate import make_evaluation
    from r2s.tasks.episode import gap, rollout

    robot, task, count = asked.robot, asked.task, len(asked.goals)
    first = make_evaluation(robot, task, asked.draw, episodes=count, nthread=cfg.threads)(asked.policy)
    rows, episodes = {"mujoco": task.measures(first)}, {"mujoco": first}
    if engine is not None:
        with counted(f"in {cfg.simulator.name}") as shown:
            arms = EngineArms(engine, robot, task, asked.draw, count)
            done = rollout(asked.policy, arms, task, asked.starts, asked.goals, shown)
        rows[cfg.simulator.name] = task.measures(done) | gap(done, first)
        episodes[cfg.simulator.name] = done
    return rows, episodes


@dataclass(frozen=True)
class OnArm:
    """What came of the episodes on an arm.

    Attributes:
        tried: (k,) numbers of the goals that were begun. episodes: theirs; None where there are none.
        stops: what ended episodes. timing: of the cycles, None where nothing is known of it.
        halted: why no more was done; None where all was.
    """

    tried: Any
    episodes: Any
    stops: list
    timing: Any
    halted: Any


def on_arm(cfg, asked, driven, predicted):
    """Return what an arm did with the goals at which it is predicted to touch nothing."""
    import numpy as np

    from r2s.tasks.episode import rollout

    tried = np.flatnonzero(predicted.collision == "")
    for e, what in enumerate(predicted.collision, 1):
        if what:
            print(f"episode {e} is left out: the arm would touch something, {what}")
    if not len(tried):
        return OnArm(tried, None, [], None, None)
    with counted(f"on {cfg.arm.name}") as shown:
        done = rollout(asked.policy, driven, asked.task, asked.starts[tried], asked.goals[tried], shown)
    stops = [replace(stop, episode=int(tried[stop.episode])) for stop in driven.stops]
    tried = tried[: driven.done]  # what was not done is no failure
    return OnArm(tried, some(done, slice(len(tried))), stops, driven.timing, driven.halted)


def on_twin(cfg, asked, opens):
    """Return what twins of the same arm, one in each process, did with the goals."""
    import numpy as np

    from r2s.arm.spread import spread

    with counted(f"on {cfg.arm.name}") as shown:
        workers = cfg.threads or os.cpu_count() or 1
        done, stops, timing = spread(opens, asked.policy, asked.task, asked.starts, asked.goals, workers, shown)
    return OnArm(np.arange(len(asked.goals)), done, stops, timing, None)


def restless(rows, name):
    """Return a line where a policy rests less on an arm than was predicted; else None.

    Success and path gap do not see a policy that shakes: the hand hardly moves (docs/transfer.md).
    """
    seen, expected = (rows.get(k, {}).get("rest") for k in (name, "predicted"))
    if seen is None or expected is None or seen >= expected - RESTLESS:
        return None
    return (
        f"warning: {100 * (1 - seen):.0f} % of the episodes on arm={name} end with a joint that still moves, "
        f"{100 * (1 - expected):.0f} % were predicted: the policy creeps or shakes there. Look at its torques first"
    )


def transfer(cfg, overrides):
    """Evaluate a trained policy in simulators and on an arm, on the same goals; adapters act on the arm alone."""
    from r2s.learning.batch import ArmBatch
    from r2s.reporting import pages
    from r2s.reporting.tables import reach_table
    from r2s.tasks.episode import gap, rollout

    asked = asked_for(cfg)
    robot, task, goals, name = asked.robot, asked.task, asked.goals, cfg.arm.name
    adapter = make_adapter(cfg, robot, asked.source)
    if is_told(cfg) and asked.policy.told and asked.policy.told.latent:
        asked = replace(asked, policy=asked.policy.by_latent())
    engine = part(cfg.simulator, "simulator", robot) if "_target_" in cfg.simulator else None
    if twin := is_twin(cfg):
        with opened_arm(cfg, robot):
            pass  # what is wrong with it is said before there is a run folder
    opens = partial(opened_arms, cfg, robot, task, asked.center, adapter=adapter)
    opened = nullcontext() if name == "none" or twin else opens()
    rows: dict = {}
    episodes: dict = {}
    there = OnArm([], None, [], None, None)
    with opened as driven, open_run(cfg, overrides, parents=[str(asked.source)]) as run:
        shutil.copyfile(asked.source / "config.yaml", run.folder / "policy.yaml")
        if twin:  # first: it forks, and then there are no threads yet
            there = on_twin(cfg, asked, opens)
        if asked.draw is not None:
            rows, episodes = in_simulators(cfg, asked, engine)
        if name != "none" and (asked.draw is not None or driven):  # what the model says of this arm
            model = ArmBatch(
                driven.robot if driven else robot, task, asked.center, len(goals), cfg.threads, asked.fade
            )
            predicted = rollout(asked.policy, model, task, asked.starts, goals)
            if asked.draw is not None:
                rows["predicted"], episodes["predicted"] = task.measures(predicted) | {"stops": 0}, predicted
            if driven:
                there = on_arm(cfg, asked, driven, predicted)
        if name != "none":
            row: dict = {"stops": len(there.stops), "episodes": len(there.tried), "asked": len(goals)}
            if adapter is not None:
                row["adapter_minutes"] = trained_minutes(cfg, asked.source)
            if len(there.tried):
                row = task.measures(there.episodes) | row
                episodes[name] = there.episodes
                if "predicted" in rows:
                    row |= gap(there.episodes, some(predicted, there.tried))
            rows[name] = row
            for line in there.timing.table() if there.timing else []:
                run.log("timing", line)
            (run.folder / "stops.txt").write_text("".join(f"{stop}\n" for stop in there.stops) or "none\n")
        run.summary(rows)
        if episodes:
            limits = task.torque(robot)
            pages.transfer(run, robot, episodes, rows, limits, there.timing, there.stops, there.halted)
        reach_table(console(), rows, f"{asked.source.name} on {len(goals)} goals")
        if warning := restless(rows, name):
            print(warning)
        if there.halted is not None:
            count = rows[name]["episodes"]
            raise Stopped(f"{count} of {len(goals)} goals done on arm={name}: {there.halted}; see {run.folder}")
    print(f"written: {run.folder}")
