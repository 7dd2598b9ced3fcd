"""What several stages make from the config: robot, dynamics, task, draws, arms, engines, run folders."""

import os
import sys
from contextlib import ExitStack
from pathlib import Path

PACKAGE = Path(__file__).parent.parent
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"  # in a wheel, in a checkout
OPEN = ExitStack()  # arms and emulators of this job


def make_robot(cfg):
    """Return the arm of conf/robot."""
    from r2s.physics.robot import load_robot

    return load_robot(**plain(cfg.robot))


def make_dynamics(cfg, robot):
    """Return conf/friction and conf/inertia, or what `calibration=` identified."""
    from r2s.identification.parameter_file import load_parameters
    from r2s.physics.dynamics import nominal_dynamics

    if cfg.calibration:
        space, x = load_parameters(cfg.calibration, robot)
        return space.dynamics(x)
    return nominal_dynamics(robot, **plain(cfg.friction), inertia_scale=plain(cfg.inertia.scale))


def make_task(cfg):
    """Return conf/task."""
    from r2s.tasks.reach import ReachTask

    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in plain(cfg.task).items()}
    return ReachTask(**settings)  # type: ignore[arg-type]


def make_draw(cfg, robot, center):
    """Return the domain randomization of conf/dr about `center`: (rng, m) -> Dynamics."""
    from r2s.errors import UserError
    from r2s.identification.parameter_file import load_parameters, load_posterior
    from r2s.learning import randomization

    settings = plain(cfg.dr)
    if settings.pop("name") == "identified":
        if not cfg.calibration:
            raise UserError("dr=identified draws from what was identified: give calibration=RUN_FOLDER as well")
        space, _ = load_parameters(cfg.calibration, robot)
        samples = load_posterior(cfg.calibration, space)
        return lambda rng, m: randomization.draw_identified(rng, space, samples, m)
    return lambda rng, m: randomization.draw(rng, center, m, **settings)


def make_arm(cfg, robot):
    """Return conf/arm; what has to be closed is in OPEN."""
    from functools import partial

    from r2s.errors import UserError

    name, arm = cfg.arm.name, cfg.arm
    if name == "twin":
        from r2s.arm.twin import Twin

        return Twin(robot, arm.seed, arm.payload, arm.stiffness)
    if name == "none":
        raise UserError("arm: none cannot be commanded; allowed: twin, panda_emulated, fr3_emulated, panda, fr3")
    from r2s.arm.fr3 import FR3
    from r2s.arm.panda import Panda

    make = Panda if name.startswith("panda") else FR3
    if name.endswith("_emulated"):
        from r2s.arm.emulator.process import Emulator
        from r2s.arm.twin import Twin

        version = 5 if name.startswith("panda") else 10
        emulator = Emulator(partial(Twin, robot, arm.seed), version=version, realtime=arm.realtime)
        client = make(robot, OPEN.enter_context(emulator), clear=lambda reason: True)
    else:
        client = make(robot, arm.address, clear=operator_agrees, realtime=arm.realtime)
    OPEN.callback(client.close)
    return client


def make_engine(cfg, robot):
    """Return Dynamics -> the engine of simulator=dart or gazebo, of an arm with these links."""
    if cfg.simulator.name == "gazebo":
        from r2s.engines.gazebo import GazeboEngine, bindings

        sim = bindings()
        return lambda d: GazeboEngine(robot, d, sim)
    from r2s.engines.dart import DartEngine

    return lambda d: DartEngine(robot, gravity=False, masses=d.mass, coms=d.com, inertias=d.inertia)


def operator_agrees(reason):
    """Ask whether a stop of the arm may be cleared; nobody at the terminal: no."""
    if not sys.stdin.isatty():
        return False
    return input(f"\nthe arm has stopped itself: {reason}\nis it safe to go on? [y/N] ").strip().lower() == "y"


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
        resume=cfg.resume,
    )


def plain(node):
    """Return a config node as dicts, lists and numbers."""
    from omegaconf import OmegaConf

    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def console():
    """Return where tables go."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 110)


def learner(name):
    """Return the class of conf/algo."""
    from r2s.learning.ddpg import DDPG
    from r2s.learning.sac import SAC
    from r2s.learning.td3 import TD3
    from r2s.learning.tqc import TQC

    return {"ddpg": DDPG, "td3": TD3, "sac": SAC, "tqc": TQC}[name]


def set_threads(cfg):
    """Give torch its threads and seed; the physics gets its own from cfg.threads."""
    import torch

    torch.set_num_threads(cfg.threads or os.cpu_count() or 1)
    torch.manual_seed(cfg.seed)


def device(cfg):
    """Return where learner and replay buffer live; the physics stays on the processor."""
    import torch

    from r2s.errors import UserError

    if cfg.device not in ("cpu", "cuda"):
        raise UserError(f"device: '{cfg.device}' is not allowed; cpu and cuda are")
    if cfg.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device: cuda is not there; torch sees no GPU, device=cpu works")
    return cfg.device


def make_source(cfg, robot, seed):
    """Return what is recorded: conf/arm, or a simulated arm of known truth."""
    if cfg.data.kind != "simulated":
        return make_arm(cfg, robot)
    from dataclasses import replace

    from omegaconf import OmegaConf

    from r2s.arm.simulated import SimulatedArm
    from r2s.physics.dynamics import nominal_dynamics

    truth = plain(OmegaConf.load(CONF / "friction" / f"{cfg.data.truth}.yaml"))
    scale = plain(OmegaConf.load(CONF / "inertia" / f"{cfg.data.truth}.yaml"))["scale"]
    dynamics = replace(nominal_dynamics(robot, **truth, inertia_scale=scale), delay=cfg.data.delay, lag=cfg.data.lag)
    noise = {"position_noise": cfg.data.position_noise, "velocity_noise": cfg.data.velocity_noise}
    return SimulatedArm(robot, dynamics, **noise, seed=seed)


def oracle(cfg, robot, task):
    """Return the controller of algo=oracle."""
    from r2s.learning.computed_torque import Oracle

    return Oracle(robot, task, make_dynamics(cfg, robot), cfg.algo.move_s)
