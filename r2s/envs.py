"""Make environments for Gymnasium (`gymnasium.make("r2s/PandaReach-v0", calibration=RUN)`) and TorchRL.

If Gymnasium is installed, importing this module registers r2s/PandaReach-v0 and likewise PandaTrack, PandaPress,
PandaWipe and PandaPush. `gymnasium.make("r2s.envs:r2s/PandaReach-v0")` imports this module automatically.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from r2s.cli import MOST_THREADS
from r2s.errors import UserError, check_number, instead_of, optional_import
from r2s.override_checks import check_overrides
from r2s.stages.build import CONF, make_draw, make_dynamics, make_robot, make_task
from r2s.stages.parts import part

TASKS = ("reach", "track", "press", "wipe", "push")
SETTINGS = ("task", "robot", "friction", "inertia", "calibration", "dr", "reward", "control", "threads")
READ = (*SETTINGS, "safety")  # top-level keys that `overrides` may set


def gym_env(*, overrides: Sequence[str] = (), **settings: Any) -> Any:
    """Return a Gymnasium environment of one arm, `r2s.learning.gym_env.ArmEnv`; see `parts` for the arguments."""
    optional_import("gymnasium", "r2s.envs.gym_env", "gym")
    from r2s.learning.gym_env import ArmEnv

    robot, task, draw, reward, _ = parts(settings, overrides)
    return ArmEnv(robot, task, draw, reward=reward)


def gym_vector_env(
    num_envs: int = 1, *, autoreset_mode: Any = "NextStep", overrides: Sequence[str] = (), **settings: Any
) -> Any:
    """Return a Gymnasium vector environment, `ArmVectorEnv`, of `num_envs` arms; see `parts` for the arguments."""
    optional_import("gymnasium", "r2s.envs.gym_vector_env", "gym")
    from r2s.learning.gym_env import ArmVectorEnv

    robot, task, draw, reward, threads = parts(settings, overrides)
    check_number("num_envs", num_envs, "[1, inf)", whole=True)
    return ArmVectorEnv(robot, task, draw, num_envs, nthread=threads, reward=reward, autoreset_mode=autoreset_mode)


def torchrl_env(num_envs: int = 32, *, seed: int = 0, overrides: Sequence[str] = (), **settings: Any) -> Any:
    """Return a TorchRL environment, `TaskEnv`, of `num_envs` arms with staggered episodes; see `parts`."""
    from r2s.learning.env import TaskEnv

    robot, task, draw, reward, threads = parts(settings, overrides)
    check_number("num_envs", num_envs, "[1, inf)", whole=True)
    return TaskEnv(robot, task, draw, num_envs, nthread=threads, seed=seed, stagger=True, reward=reward)


def parts(settings: dict[str, Any], overrides: Sequence[str]) -> tuple[Any, Any, Any, Any, int]:
    """Return robot, task, domain randomization, reward and number of threads for a training with the given options.

    Args:
        settings: {option: value} of SETTINGS, such as {"task": "reach", "calibration": RUN, "dr": "identified"}.
        overrides: further options as on the command line, such as "task.episode_s=3".

    Raises:
        TypeError: a name in `settings` is not in SETTINGS. UserError: a value or an override is wrong.
    """
    for name in settings:
        if name not in SETTINGS:  # stable-baselines3 passes render_mode, and omits it after a TypeError
            raise TypeError(f"unexpected keyword argument '{name}'; {instead_of(name, SETTINGS)}")
    words = [_word(k, v) for k, v in settings.items() if v is not None]
    if isinstance(overrides, str):
        raise UserError(f"overrides: expected a list of KEY=VALUE, got {overrides!r}")
    for word in overrides:
        key = word.lstrip("+~").split("=", 1)[0].split(".")[0]
        if key not in READ:
            raise UserError(f"overrides: an environment does not read '{word}'; {instead_of(key, READ)}")
    cfg = _composed([*words, *overrides])
    check_number("threads", cfg.threads, f"[0, {MOST_THREADS}]", whole=True)
    robot = make_robot(cfg)
    center = make_dynamics(cfg, robot)
    task = make_task(cfg, robot, center)
    return robot, task, make_draw(cfg, robot, center), part(cfg.reward, "reward"), cfg.threads


def _word(name: str, value: Any) -> str:
    """Return an option as a word of the command line, with quotes around a path, which may contain any character."""
    from hydra.core.override_parser.types import Quote, QuotedString

    is_path = name == "calibration"
    return f"{name}={QuotedString(str(value), Quote.single).with_quotes() if is_path else value}"


def _composed(words: list[str]) -> Any:
    """Return the config of a training with the overrides `words`."""
    from hydra import compose, initialize_config_dir

    with _aside():
        check_overrides(words, None)
        with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
            return compose("config", words)


@contextmanager
def _aside() -> Iterator[None]:
    """Hide the calling program's Hydra state inside the `with` block; the program may itself be a Hydra job."""
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.singleton import Singleton
    from hydra.core.utils import JobRuntime
    from hydra.version import VersionBase

    instances: dict[type, Any] = Singleton._instances
    state = (GlobalHydra, JobRuntime, VersionBase)
    kept: dict[type, Any] = {kind: instances.pop(kind) for kind in state if kind in instances}
    try:
        yield
    finally:
        for kind in state:
            instances.pop(kind, None)
        instances.update(kept)


def register() -> None:
    """Register the environments with Gymnasium."""
    import gymnasium

    for task in TASKS:
        gymnasium.register(
            f"r2s/Panda{task.title()}-v0",
            entry_point="r2s.envs:gym_env",
            vector_entry_point="r2s.envs:gym_vector_env",
            kwargs={"task": task},
        )


if find_spec("gymnasium"):
    register()
