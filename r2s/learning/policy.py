"""A policy on disk: policy.pt for r2s, policy.onnx for everything else. SI units in, torque in Nm out."""

import contextlib
import io
import logging
import warnings
from pathlib import Path

import numpy as np
import torch

from r2s.adaptation.telling import SAID, said_scale
from r2s.errors import UserError
from r2s.files import whole
from r2s.learning.checkpoint import load_tensors, save_tensors
from r2s.learning.networks import Actor, Normalizer, Policy, Told
from r2s.physics.robot import Robot
from r2s.tasks.task import Task


def make_policy(robot: Robot, task: Task, hidden: tuple[int, ...], told: Told | None = None) -> Policy:
    """Return an untrained policy of this arm and task; told: what it is told beside, None: nothing."""
    mean, std = observation_scale(robot, task, told)
    torque = torch.from_numpy(task.share * task.torque(robot)).float()
    return Policy(Normalizer(mean, std), Actor(len(mean), robot.n, hidden, told=told), torque)


def observation_scale(robot: Robot, task: Task, told: Told | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mean and standard deviation (d,) of what a policy observes, and then of what it is told."""
    mean, std = task.observation_scale(robot)
    if told:
        mean = np.concatenate([mean, np.zeros(told.numbers)])
        std = np.concatenate([std, said_scale(robot.n)])
    return torch.from_numpy(mean), torch.from_numpy(std)


def save_policy(folder: Path, policy: Policy) -> None:
    """Write policy.pt: the state dict and the sizes that it fits."""
    linear = [m.out_features for m in policy.actor.body if isinstance(m, torch.nn.Linear)]
    told = {"told": list(policy.told)} if policy.told else {}
    save_tensors(folder / "policy.pt", {"state": policy.state_dict(), "hidden": linear[:-1]} | told)


def load_policy(folder: Path, robot: Robot, task: Task) -> Policy:
    """Return the policy of a run folder.

    Raises:
        UserError: no policy.pt there, a damaged one, or one of another arm.
    """
    path = Path(folder) / "policy.pt"
    if not path.is_file():
        raise UserError(f"policy: no policy.pt in {folder}")
    saved = load_tensors(path, "policy")
    try:
        told = Told(*saved["told"]) if "told" in saved else None
        policy = make_policy(robot, task, tuple(saved["hidden"]), told)
        policy.load_state_dict(saved["state"])
    except KeyError as error:
        raise UserError(f"policy: {path} is not what r2s wrote: it has no {error}") from None
    except RuntimeError:
        raise UserError(f"policy: {path} does not fit {robot.name} with {robot.n} joints") from None
    return policy.eval()


def export_onnx(path: Path, policy: Policy, robot: Robot, task: Task) -> None:
    """Write policy.onnx: `observation` (B, d) in SI units -> `torque` (B, n) Nm, normalisation inside.

    Its metadata carries what a driver needs: joint count and order, policy rate, torque limits, low-pass.
    """
    import onnx

    example = torch.zeros(2, len(policy.normalizer.mean))
    quiet = contextlib.redirect_stdout(io.StringIO())
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with whole(path) as part:
        with warnings.catch_warnings(), quiet:
            warnings.simplefilter("ignore")  # the exporter warns of its own internals
            torch.onnx.export(
                policy,
                (example,),
                str(part),
                input_names=["observation"],
                output_names=["torque"],
                dynamic_shapes={"observation": {0: torch.export.Dim("batch")}},
                external_data=False,
                verbose=False,
            )
        model = onnx.load(part)
        for key, value in _facts(policy, robot, task).items():
            model.metadata_props.add(key=key, value=value)
        onnx.save(model, part)


def _facts(policy: Policy, robot: Robot, task: Task) -> dict[str, str]:
    """Return what a driver has to know."""
    arm = robot.model(gravity=False)
    return {
        "robot": robot.name,
        "joints": " ".join(arm.joint(j).name or f"joint{j + 1}" for j in range(robot.n)),
        "observation": task.observed + (f"; told: {SAID}" if policy.told else ""),
        "policy_hz": str(task.ctrl_hz),
        "q_min_rad": " ".join(f"{q:g}" for q in robot.q_min),
        "q_max_rad": " ".join(f"{q:g}" for q in robot.q_max),
        "dq_max_rad_per_s": " ".join(f"{v:g}" for v in robot.dq_max),
        "torque_max_Nm": " ".join(f"{t:g}" for t in robot.tau_max),
        "torque_rate_max_Nm_per_s": " ".join(f"{t:g}" for t in robot.dtau_max),
        "torque_scale_Nm": " ".join(f"{t:g}" for t in policy.torque_scale.tolist()),
        "low_pass_hz": str(task.cutoff_hz),
        "torque": "without gravity, before low-pass, clip and rate limit"
        + ("" if task.share == 1.0 else "; to be added to the task's base"),
    }
