"""What several stages make from the config: parts by their `_target_`, robot, dynamics, draws, arms, run folders."""

import inspect
import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args, get_type_hints

from r2s.errors import UserError, check_number, choices, nearest

PACKAGE = Path(__file__).parent.parent
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"  # in a wheel, in a checkout
BESIDE = ("soft_start_s", "live")  # of conf/arm, how it is driven
STAGES = ("train", "identify", "transfer", "compare", "pipeline", "tune", "watch")
COMMON = ("stage", "root", "name", "only_missing", "resume", "experiment", "grid", "seed", "threads", "tracker")
GROUP = "R2S_GROUP"  # in the environment of the jobs of a sweep: what they are called together


@dataclass(frozen=True)
class Evaluation:
    """`evaluation` of the config.

    Attributes:
        episodes: goals of an evaluation. env_steps: between two evaluations of a training.

    Raises:
        UserError: one of them is no positive whole number.
    """

    episodes: int
    env_steps: int

    def __post_init__(self):
        check_number("evaluation.episodes", self.episodes, "[1, inf)", whole=True)
        check_number("evaluation.env_steps", self.env_steps, "[1, inf)", whole=True)


def part(node: Any, group: str, *given: Any, beside: Iterable[str] = ()) -> Any:
    """Make the part that a config node names by `_target_`.

    Args:
        node: of the config; its keys are arguments of the part.
        group: where the node is in the config, for error messages.
        given: further arguments, which come from code and go first.
        beside: keys of the node that are no arguments of the part.

    Raises:
        UserError: there is no such part, or not with these arguments.
    """
    make = target(node, group)
    settings = plain(node)
    settings = {k: v for k, v in settings.items() if k not in ("_target_", "name", *beside)}
    return called(make, group, settings, *given)


def target(node: Any, group: str) -> Callable[..., Any]:
    """Return what a config node's `_target_` names: a class or a function of an importable module."""
    from hydra.utils import get_object

    path = node.get("_target_") if isinstance(node, Mapping) else None
    if not isinstance(path, str) or not path:
        raise UserError(f"{group}: its yaml has no _target_, the dotted path of what makes it")
    logging.getLogger("hydra.utils").disabled = True  # it would say it, too
    try:
        return get_object(path)
    except Exception as error:  # importing a user's module may fail in any way
        cause = error.__cause__ or error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        seen = " ".join(str(cause).split())
        raise UserError(f"{group}._target_: cannot load '{path}': {type(cause).__name__}: {seen}") from None


def called(make: Callable[..., Any], group: str, settings: Mapping[str, Any], *given: Any) -> Any:
    """Call `make` with arguments from code and with `settings` of a config group, whose mistakes are named as typed.

    Raises:
        UserError: an argument that it does not take or misses, a word where its annotation asks for a number, or
            whatever it says itself.
    """
    check_words(make, group, settings)
    try:
        inspect.signature(make).bind(*given, **settings)
    except TypeError as error:
        raise UserError(f"{group}: {getattr(make, '__name__', make)}: {error}") from None
    try:
        return make(*given, **settings)
    except UserError as error:
        first = str(error).split(":")[0].split(".")[0]
        if first in settings and first != group:  # a part does not know the name of its group
            raise UserError(f"{group}.{error}") from None
        raise


def check_words(make: Callable[..., Any], group: str, settings: Mapping[str, Any]) -> None:
    """Raise UserError where a word stands for what `make` wants as a number or as a list of numbers."""
    try:
        hints = get_type_hints(make.__init__ if inspect.isclass(make) else make)
    except NameError:  # annotations that only a type checker can resolve
        return
    for key, value in settings.items():
        kinds = set(_kinds(hints.get(key)))
        words = [v for v in (value if isinstance(value, list) else [value]) if isinstance(v, str)]
        if words and kinds & {int, float} and not kinds & {str, Any}:
            raise UserError(f"{group}.{key}: '{words[0]}' is not a number")


def _kinds(hint: Any) -> Iterator[Any]:
    inner = get_args(hint)
    for kind in inner:
        yield from _kinds(kind)
    if not inner:
        yield hint


def unread(name: str, cfg: Any) -> str | None:
    """Return why the stage of `cfg` does not read the typed key or group `name`; None where it does."""
    from importlib import import_module

    stage = import_module(f"r2s.stages.{cfg.stage}")
    keys = stage.reads(cfg)
    if any(name == key or name.startswith(f"{key}.") or key.startswith(f"{name}.") for key in (*COMMON, *keys)):
        head, _, own = name.partition(".")
        if head != "algo" or not own or "algo" not in keys or is_learner(cfg) or own not in of_trainings():
            return None
        return f"{name}: nothing is trained with algo={cfg.algo.name}; leave it out"
    head = name.split(".")[0]
    why = stage.WHY.get(name) or stage.WHY.get(head) or f"it reads {choices(sorted(keys))}"
    return f"{name}: stage={cfg.stage} does not read it: {why}; leave it out"


def make_robot(cfg):
    """Return the arm of conf/robot; what a task takes from there is checked with it."""
    from r2s.physics.robot import OF_TASKS

    for key in OF_TASKS:
        if key.endswith("fraction") and isinstance(cfg.robot, Mapping) and key in cfg.robot:
            share = plain(cfg.robot)[key]
            for value in share if isinstance(share, list) and share else [share]:
                check_number(f"robot.{key}", value, "[1e-6, 1]")
    return part(cfg.robot, "robot", beside=OF_TASKS)


def make_dynamics(cfg, robot):
    """Return conf/friction and conf/inertia, or what `calibration=` identified."""
    from r2s.identification.parameter_file import load_parameters

    if cfg.calibration:
        space, x = load_parameters(cfg.calibration, robot)
        return space.dynamics(x)
    return dynamics_of(robot, plain(cfg.friction), plain(cfg.inertia))


def dynamics_of(robot, friction, inertia):
    """Return the dynamics that a file of conf/friction and one of conf/inertia describe."""
    from r2s.physics.dynamics import nominal_dynamics

    for group, settings in (("friction", friction), ("inertia", inertia)):
        if not isinstance(settings, Mapping):
            raise UserError(f"{group}: {settings!r} is no group of settings")
    if "scale" not in inertia:
        raise UserError(f"inertia: it has no scale; it has {choices(inertia) or 'nothing'}")
    check_words(nominal_dynamics, "inertia", {"scale": inertia["scale"]})
    return called(nominal_dynamics, "friction", {**friction, "inertia_scale": inertia["scale"]}, robot)


def make_task(cfg, robot, dynamics):
    """Return conf/task, told of the model; its lists are tuples there, a task is a fixed thing."""
    make = target(cfg.task, "task")
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in plain(cfg.task).items() if k != "_target_"}
    return called(make, "task", settings).believing(robot, dynamics)


def make_draw(cfg, robot, center):
    """Return the domain randomization of conf/dr about `center`: (rng, m) -> Dynamics."""
    return part(cfg.dr, "dr", robot, center)


@contextmanager
def opened_arm(cfg, robot, noise=0):
    """Give the arm of conf/arm inside a `with`; one that has to be closed is a context manager itself.

    noise: which stream of noise the sensors of a twin have; a real arm has its own.
    """
    from r2s.arm.interface import ArmStopped

    if "_target_" not in cfg.arm:
        raise UserError(f"arm: {cfg.arm.name} cannot be commanded; allowed: {choices(_arms())}")
    with ExitStack() as stack:
        try:
            stream = {"noise": noise} if "noise" in inspect.signature(target(cfg.arm, "arm")).parameters else {}
            arm = part({**plain(cfg.arm), **stream}, "arm", robot, beside=BESIDE)
            arm = stack.enter_context(arm) if hasattr(arm, "__enter__") else arm
        except ArmStopped as stop:
            raise UserError(f"arm={cfg.arm.name}: {stop}") from None
        yield arm


def is_twin(cfg):
    """Return whether conf/arm is made from a seed, as often as one likes, with streams of noise."""
    made = {"_target_", "seed"} <= cfg.arm.keys()
    return made and "noise" in inspect.signature(target(cfg.arm, "arm")).parameters


def arm_maker(cfg, robot):
    """Return what opens the arm of conf/arm in another process: with `part`, which names mistakes as typed."""
    if "_target_" not in cfg.arm:
        raise UserError(f"arm: {cfg.arm.name} cannot be commanded; allowed: {choices(_arms())}")
    target(cfg.arm, "arm")  # what cannot be loaded is said here
    return partial(part, plain(cfg.arm), "arm", robot, beside=list(BESIDE))


@contextmanager
def opened_arms(cfg, robot, task, dynamics, noise=0, adapter=None):
    """Give the arm of conf/arm behind its driver, for episodes of `task`: a `DrivenArm`, or a `LiveArm` where
    `live` says that the arm's clock does not wait. It is stopped at the end whatever happens.

    dynamics: of one arm, what the policy learned on. adapter: as of `DrivenArm`. noise: as of `opened_arm`.
    """
    from r2s.arm.deploy import DrivenArm
    from r2s.arm.interface import ArmStopped
    from r2s.arm.live import LiveArm

    how = {"soft_start_s": cfg.arm.get("soft_start_s", 0.0), "rotors": dynamics.armature, "adapter": adapter}
    if not cfg.arm.get("live", False):
        with opened_arm(cfg, robot, noise) as arm:
            try:
                yield DrivenArm(arm, task, dynamics.level, **how)
            finally:
                arm.stop()
        return
    with ExitStack() as stack:
        try:
            arms = stack.enter_context(LiveArm(arm_maker(cfg, robot), robot, task, dynamics.level, **how))
        except ArmStopped as stop:
            raise UserError(f"arm={cfg.arm.name}: {stop}") from None
        yield arms


def _arms():
    return sorted(p.stem for p in (CONF / "arm").glob("*.yaml") if p.stem != "none")


@contextmanager
def opened_source(cfg, robot, noise):
    """Give what is recorded: conf/arm, or with data=simulated an arm of known truth.

    noise: 0, 1, 2, ... for each recording of a run: each has noise of its own.
    """
    if cfg.data.kind != "simulated":
        with opened_arm(cfg, robot, noise) as arm:
            yield arm
        return
    from r2s.arm.simulated import SimulatedArm

    dynamics = replace(make_truth(cfg, robot), delay=cfg.data.delay, lag=cfg.data.lag)
    sensors = {"position_noise": cfg.data.position_noise, "velocity_noise": cfg.data.velocity_noise}
    yield SimulatedArm(robot, dynamics, **sensors, seed=cfg.data.excitation_seed + noise)


def check_source(cfg, robot):
    """Say what is wrong with an arm that is recorded before there is a run folder; a real one is not touched."""
    if cfg.data.kind == "simulated" or is_twin(cfg):
        with opened_source(cfg, robot, 0):
            pass


def make_truth(cfg, robot):
    """Return the dynamics of data.truth: a file of conf/friction, with the one of conf/inertia of that name.

    Raises:
        UserError: there is no such file.
    """
    from omegaconf import OmegaConf

    both = [CONF / group / f"{cfg.data.truth}.yaml" for group in ("friction", "inertia")]
    if not all(path.is_file() for path in both):
        known = sorted({p.stem for p in both[0].parent.glob("*")} & {p.stem for p in both[1].parent.glob("*")})
        raise UserError(
            f"data.truth: no '{cfg.data.truth}' in friction and inertia; allowed: "
            f"{choices(known)}{nearest(str(cfg.data.truth), known)}"
        )
    return dynamics_of(robot, *(plain(OmegaConf.load(path)) for path in both))


def is_learner(cfg):
    """Return whether conf/algo is trained; what is not is a controller made of robot, task and dynamics."""
    from r2s.learning.learner import Learner

    kind = target(cfg.algo, "algo")
    return inspect.isclass(kind) and issubclass(kind, Learner)


def of_trainings():
    """Return the keys of conf/algo that say how to train, which an experiment may set for a controller, too."""
    from r2s.learning.train import Loop

    return ("n_envs", "hidden", *(f.name for f in fields(Loop)))


def make_controller(cfg, robot, task, dynamics):
    """Return the controller of conf/algo, with the model that it believes in."""
    return part(cfg.algo, "algo", robot, task, dynamics, beside=of_trainings())


def open_run(cfg, overrides, inputs=(), parents=()):
    """Return the run folder of this job, open."""
    from omegaconf import OmegaConf

    from r2s.runs import Run

    trackers = {k: part(node, f"tracker.{k}") for k, node in (cfg.get("tracker") or {}).items() if node}
    run = Run(
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
        only=cfg.only_missing,
    )
    if trackers:
        run.watcher = watched(cfg, run, trackers)
    return run


def watched(cfg, run, trackers):
    """Return the trackers of a run, started; a resumed run stays in the group that it was in."""
    from r2s.reporting.trackers.behind import Trackers
    from r2s.reporting.trackers.tracker import Tracked

    tracked = Tracked(run.folder, cfg.stage, os.environ.get(GROUP), plain(cfg), run.meta, bool(cfg.resume))
    if tracked.resumed:
        tracked = replace(tracked, group=tracked.kept("group"))
    else:
        tracked.keep("group", tracked.group)
    return Trackers(trackers, tracked)


def plain(node):
    """Return a config node as dicts, lists and numbers."""
    from omegaconf import OmegaConf

    if not OmegaConf.is_config(node):
        return node
    return OmegaConf.to_container(node, resolve=True, throw_on_missing=True)


def console():
    """Return where tables go."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 110)


def loaded(path):
    """Return a YAML file of a run folder as a config.

    Raises:
        UserError: it cannot be read, or is no YAML.
    """
    import yaml
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        return OmegaConf.load(path)
    except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise UserError(f"{path} cannot be read: {' '.join(str(error).split())}") from None


def set_threads(cfg):
    """Give torch its threads and seed; the physics gets its own from cfg.threads."""
    import torch

    torch.set_num_threads(cfg.threads or os.cpu_count() or 1)
    torch.manual_seed(cfg.seed)


def device(cfg):
    """Return where learner and replay buffer live; the physics stays on the processor."""
    import torch

    if cfg.device not in ("cpu", "cuda"):
        raise UserError(f"device: '{cfg.device}' is not allowed; cpu and cuda are")
    if cfg.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device: cuda is not there; torch sees no GPU, device=cpu works")
    return cfg.device
