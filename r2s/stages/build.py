"""Make robot, dynamics, task, randomization, arm and run folder from the config."""

import inspect
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from r2s.errors import FAILED, Stopped, UserError, check_number, choices, instead_of
from r2s.stages.parts import called, check_types, part, plain, target
from r2s.stages.run_config import CONF, modules

DRIVE_KEYS = ("soft_start_s", "live")  # keys of conf/arm for the policy runner, not for the arm's class
STAGES = ("train", "identify", "transfer", "compare", "pipeline", "tune", "estimate", "excite", "results")
COMMON = (
    *("stage", "root", "name", "skip_completed", "resume", "experiment", "grid", "seed", "threads", "tracker"),
    "trust",
)
GROUP = "R2S_GROUP"  # environment variable: name under which trackers group the jobs of a sweep


def unread(name: str, cfg: Any) -> str | None:
    """Return the reason why the stage of `cfg` does not read the option `name`; None if the stage reads it."""
    from importlib import import_module

    stage = import_module(f"r2s.stages.{cfg.stage}")
    keys = stage.reads(cfg)
    if any(name == key or name.startswith(f"{key}.") or key.startswith(f"{name}.") for key in (*COMMON, *keys)):
        head, _, own = name.partition(".")
        if head != "algo" or not own or "algo" not in keys or is_learner(cfg) or own not in training_keys():
            return None
        return f"{name}: nothing is trained with algo={cfg.algo.name}; leave it out"
    head = name.split(".")[0]
    why = stage.WHY.get(name) or stage.WHY.get(head) or f"it reads {choices(sorted(keys))}"
    return f"{name}: stage={cfg.stage} does not read it: {why}; leave it out"


def make_robot(cfg):
    """Return the robot that conf/robot describes."""
    from r2s.physics.robot import OF_TASKS

    for key in OF_TASKS:
        if key.endswith("fraction") and isinstance(cfg.robot, Mapping) and key in cfg.robot:
            share = plain(cfg.robot)[key]
            for value in share if isinstance(share, list) and share else [share]:
                check_number(f"robot.{key}", value, "[1e-6, 1]")
    settings, task = plain(cfg.robot), plain(cfg.get("task"))
    if isinstance(settings, dict) and settings.get("tool") is None and isinstance(task, Mapping):
        settings = {**settings, "tool": task.get("tool")}
    return part(settings, "robot", beside=OF_TASKS)


def make_dynamics(cfg, robot, announce=False):
    """Return the dynamics of `base_dynamics`, prepared for contact if the task of conf/task touches a surface.

    During contact, friction of resting joints opposes contact forces; see `Dynamics.holding_contact`. If `announce`
    is set, print a change of the stiction model.
    """
    dynamics = base_dynamics(cfg, robot)
    if not getattr(target(cfg.task, "task"), "touches", False):
        return dynamics
    held = dynamics.holding_contact()
    if announce and held.stiction_model != dynamics.stiction_model:
        models = f"{held.stiction_model} instead of {dynamics.stiction_model}"
        print(f"friction.stiction_model={models}, so that friction at rest also holds contact forces")
    return held


def base_dynamics(cfg, robot):
    """Return the identified dynamics of `calibration=`, or by default the dynamics of conf/friction and conf/inertia.

    Unlike `make_dynamics`, this function does not import the task, which imports torch (190 MB).
    """
    from r2s.identification.parameter_file import load_parameters

    if not cfg.calibration:
        return dynamics_of(robot, plain(cfg.friction), plain(cfg.inertia))
    typed = str(cfg.friction.get("family") or "").split(".")[0]
    space, x = load_parameters(cfg.calibration, robot, (*modules(cfg.get("trust")), typed))
    return space.dynamics(x)


def dynamics_of(robot, friction, inertia):
    """Return the dynamics of `friction` and `inertia`: contents of files in conf/friction and conf/inertia."""
    from r2s.physics.dynamics import nominal_dynamics

    for group, settings in (("friction", friction), ("inertia", inertia)):
        if not isinstance(settings, Mapping):
            raise UserError(f"{group}: expected settings by name, got {settings!r}")
    if "scale" not in inertia:
        raise UserError(f"inertia: expected the key scale, got {choices(inertia) or 'no keys'}")
    check_types(nominal_dynamics, "inertia", {"scale": inertia["scale"]})
    return called(nominal_dynamics, "friction", {**friction, "inertia_scale": inertia["scale"]}, robot)


def make_task(cfg, robot, dynamics, safety=None):
    """Return the task of conf/task with the arm's model, the controller of conf/control and the safety limits.

    safety: safety settings of a transfer, or None. Each setting that is not None replaces the setting of the
    training's config `cfg`.
    """
    if "control" not in cfg:
        raise UserError("control: an earlier r2s wrote this config, without control=; train the policy again")
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in plain(cfg.task).items() if k != "_target_"}
    task = called(target(cfg.task, "task"), "task", settings).with_model(robot, dynamics)
    if "_target_" in cfg.control:  # control=default means the task's own controller
        task = task.controlled_by(part(cfg.control, "control", robot, task, dynamics))
    given = {k: v for k, v in (plain(safety) or {}).items() if v is not None}
    safety = {**(plain(cfg.get("safety")) or {}), **given}
    if not any(value is not None for value in safety.values()):
        if getattr(task, "stop", None) is not None:
            raise UserError(
                f"task.stop: {task.stop} needs the estimate of the force that safety.force_max makes; set it, in N"
            )
        return task
    return task.pushing_within(robot, dynamics.level, safety.get("force_max"), safety.get("speed_near"))


def make_draw(cfg, robot, center):
    """Return the domain randomization of conf/dr: a function (rng, m) -> Dynamics that draws m arms near `center`."""
    return part(cfg.dr, "dr", robot, center)


def _arm_target(cfg) -> Callable[..., Any]:
    """Return the class or function that makes the arm of conf/arm; raise UserError for arm=none."""
    if "_target_" not in cfg.arm:
        allowed = sorted(p.stem for p in (CONF / "arm").glob("*.yaml") if p.stem != "none")
        raise UserError(f"arm: {cfg.arm.name} cannot be commanded; allowed: {choices(allowed)}")
    return target(cfg.arm, "arm")


def _arm_settings(cfg, robot, task=None):
    """Return the settings of conf/arm; compute unset reflex thresholds from the task's contact forces."""
    settings = plain(cfg.arm)
    if "collision_force" in settings and None in (settings["collision_torque"], settings["collision_force"]):
        from r2s.arm.clients.collision_thresholds import thresholds_for

        own = thresholds_for(robot, task)
        given = {k: v for k, v in settings.items() if v is not None}
        settings = {**settings, "collision_torque": own.torque, "collision_force": own.force, **given}
    return settings


@contextmanager
def opened_arm(cfg, robot, noise=0, task=None, adapter=None, **more):
    """Yield the arm of conf/arm; close the arm afterwards if its class is a context manager.

    Ctrl-C and similar signals stop the motion of the arm, unless the arm is a twin.

    Args:
        noise: index of the random stream for a twin's sensor noise. task, adapter: task and adapter of the policy, or
            None if no policy runs. more: further arguments of the arm's class.
    """
    from r2s.arm.interface import ArmStopped
    from r2s.arm.stop_request import handled_signals, pipeline
    from r2s.arm.warm_up import warm_up

    if not is_twin(cfg):  # a twin needs no warm-up: its clock waits while code compiles
        warm_up(robot, task, adapter)
    stream = {"noise": noise} if "noise" in inspect.signature(_arm_target(cfg)).parameters else {}
    with ExitStack() as stack:
        if not is_twin(cfg):
            stack.enter_context(handled_signals(parent=pipeline()))
        try:
            arm = part({**_arm_settings(cfg, robot, task), **stream, **more}, "arm", robot, beside=DRIVE_KEYS)
            arm = stack.enter_context(arm) if hasattr(arm, "__enter__") else arm
        except ArmStopped as stop:
            raise UserError(f"arm={cfg.arm.name}: {stop}") from None
        with ends_sweep(cfg):
            yield arm


@contextmanager
def ends_sweep(cfg):
    """End the whole sweep, not only this job, if the `with` block raises an error and the arm is not a twin.

    If the sweep continued, the next job could move the arm before the operator knows the cause of the error.
    """
    try:
        yield
    except (UserError, FloatingPointError, OSError, MemoryError) as error:
        if FAILED not in os.environ or is_twin(cfg):
            raise
        raise Stopped(f"arm={cfg.arm.name}: {error}; the sweep ends with the job that failed") from error


def is_simulated(cfg):
    """Return whether the arm of conf/arm is a twin, alone or behind an emulated control box."""
    made = {"_target_", "seed"} <= cfg.arm.keys()
    return made and "noise" in inspect.signature(target(cfg.arm, "arm")).parameters


def is_twin(cfg):
    """Return whether conf/arm is a twin without an emulated control box; only such a twin needs no operator."""
    return is_simulated(cfg) and "operator" not in cfg.arm


@contextmanager
def opened_runner(cfg, robot, task, dynamics, noise=0, adapter=None):
    """Yield a `PolicyRunner` for the arm of conf/arm, or a `RealtimeRunner` if arm.live; stop the arm afterwards.

    Args:
        dynamics: center of the training's domain randomization. noise: index of the random stream for sensor noise.
    """
    from r2s.arm.interface import ArmStopped
    from r2s.arm.policy_runner import PolicyRunner
    from r2s.arm.realtime_process import RealtimeRunner

    how = {"soft_start_s": cfg.arm.get("soft_start_s", 0.0), "rotors": dynamics.armature, "adapter": adapter}
    if not cfg.arm.get("live", False):
        with opened_arm(cfg, robot, noise, task, adapter) as arm:
            try:
                yield PolicyRunner(arm, task, dynamics.level, **how)
            finally:
                arm.stop()
        return
    _arm_target(cfg)  # raise UserError in this process, not in the process of the arm
    make = partial(part, _arm_settings(cfg, robot, task), "arm", robot, beside=list(DRIVE_KEYS))
    with ExitStack() as stack:
        try:
            arms = stack.enter_context(RealtimeRunner(make, robot, task, dynamics.level, **how))
        except ArmStopped as stop:
            raise UserError(f"arm={cfg.arm.name}: {stop}") from None
        try:
            with ends_sweep(cfg):
                yield arms
        except ArmStopped as stop:  # the process of the arm has ended
            raise Stopped(f"arm={cfg.arm.name}: {stop}") from None


@contextmanager
def opened_source(cfg, robot, noise):
    """Yield the arm to record: a simulated arm with known parameters for data=simulated, else the arm of conf/arm.

    noise: index of the random stream for sensor noise; successive recordings of a run use 0, 1, 2, ...
    """
    if cfg.data.kind != "simulated":
        with opened_arm(cfg, robot, noise) as arm:
            yield arm
        return
    from r2s.arm.simulated import SimulatedArm

    dynamics = replace(make_truth(cfg, robot), delay=cfg.data.delay, lag=cfg.data.lag)
    sensors = {"position_noise": cfg.data.position_noise, "velocity_noise": cfg.data.velocity_noise}
    yield SimulatedArm(robot, dynamics, **sensors, seed=cfg.data.excitation_seed + noise)


def planned_speed_share(cfg):
    """Return arm.speed_share, which scales the speed limits of a planned motion; 1 unless data=arm."""
    share = cfg.arm.get("speed_share", 1.0) if cfg.data.kind == "arm" else 1.0
    check_number("arm.speed_share", share, "(0, 1]")
    return share


def within_speed_share(cfg, robot):
    """Return the robot with speed limits scaled by arm.speed_share, for planning a motion to record."""
    return replace(robot, dq_max=planned_speed_share(cfg) * robot.dq_max)


def check_source(cfg, robot):
    """If the arm to record is simulated, raise UserError for wrong settings; never connect to a physical arm."""
    if cfg.data.kind == "simulated" or is_simulated(cfg):
        with opened_source(cfg, robot, 0):
            pass


def make_truth(cfg, robot):
    """Return the true dynamics of a simulated arm from the files <data.truth>.yaml in conf/friction and conf/inertia.

    Raises:
        UserError: conf/friction or conf/inertia has no file <data.truth>.yaml.
    """
    from omegaconf import OmegaConf

    both = [CONF / group / f"{cfg.data.truth}.yaml" for group in ("friction", "inertia")]
    if "/" in str(cfg.data.truth) or not all(path.is_file() for path in both):
        known = sorted({p.stem for p in both[0].parent.glob("*")} & {p.stem for p in both[1].parent.glob("*")})
        raise UserError(
            f"data.truth: no '{cfg.data.truth}' in friction and inertia; {instead_of(cfg.data.truth, known)}"
        )
    return dynamics_of(robot, *(plain(OmegaConf.load(path)) for path in both))


def is_learner(cfg):
    """Return whether conf/algo describes a learner, rather than a controller that needs no training."""
    from r2s.learning.learner import Learner

    kind = target(cfg.algo, "algo")
    return inspect.isclass(kind) and issubclass(kind, Learner)


def training_keys():
    """Return the keys of conf/algo that trainings use, and that controllers without training ignore."""
    from r2s.learning.train import Loop

    return ("n_envs", "demonstrations", "residual_l2", "hidden", *(f.name for f in fields(Loop)))


def make_controller(cfg, robot, task, dynamics):
    """Return the controller of conf/algo with `dynamics` as its model of the arm."""
    return part(cfg.algo, "algo", robot, task, dynamics, beside=training_keys())


def open_run(cfg, overrides, inputs=(), parents=()):
    """Return the open run folder of this job and start the trackers; a resumed run stays in its tracker group.

    inputs, parents: files and run folders that the job reads and that the config does not name.
    """
    from omegaconf import OmegaConf

    from r2s.runs import Job, Run
    from r2s.stages.inputs import files_of, parents_of

    trackers = {k: part(node, f"tracker.{k}") for k, node in (cfg.get("tracker") or {}).items() if node}
    config = OmegaConf.to_yaml(cfg)
    parents = list(dict.fromkeys([*map(str, parents), *parents_of(cfg)]))
    inputs = [*inputs, *files_of(cfg, parents)]
    how = {"inputs": inputs, "parents": parents, "device": cfg.get("device", "cpu")}
    job = Job(cfg.stage, cfg.name, config, list(overrides), cfg.seed, cfg.threads, **how)
    run = Run(Path(cfg.root), job, resume=cfg.resume, exact_name=cfg.skip_completed)
    if not trackers:
        return run
    from r2s.reporting.trackers.async_tracker import Trackers
    from r2s.reporting.trackers.tracker import Tracked

    tracked = Tracked(run.folder, cfg.stage, os.environ.get(GROUP), plain(cfg), run.meta, bool(cfg.resume))
    if tracked.resumed:
        tracked = replace(tracked, group=tracked.kept("group"))
    else:
        tracked.keep("group", tracked.group)
    run.tracker = Trackers(trackers, tracked)
    return run


def console():
    """Return a console for printing tables."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 100)


def all_threads(cfg):
    """Return the number of threads that a stage may use."""
    return cfg.threads or os.cpu_count() or 1


def set_threads(cfg, threads=None):
    """Set torch's seed and number of threads (default: all threads); the physics has separate threads."""
    import torch

    torch.set_num_threads(threads or all_threads(cfg))
    torch.manual_seed(cfg.seed)


def device(cfg):
    """Return the device (cpu or cuda) of learner and replay buffer; the physics always runs on the CPU."""
    import torch

    if cfg.device not in ("cpu", "cuda"):
        raise UserError(f"device: expected cpu or cuda, got {cfg.device!r}")
    if cfg.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device: torch finds no GPU for device=cuda; device=cpu works")
    return cfg.device
