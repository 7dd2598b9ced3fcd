"""Files of a policy: policy.pt for r2s and policy.onnx for other programs; inputs and outputs are in SI units."""

import contextlib
import io
import logging
import warnings
from pathlib import Path

import torch

from r2s.control.controller import Controller
from r2s.errors import UserError
from r2s.files import atomic_write
from r2s.learning.checkpoint import load_tensors, save_tensors
from r2s.learning.networks import Actor, Normalizer, Policy
from r2s.physics.robot import Robot
from r2s.tasks.task import Task, observation_scale


def make_policy(robot: Robot, task: Task, hidden: tuple[int, ...]) -> Policy:
    """Return an untrained policy for an arm and a task."""
    mean, std = normalization(robot, task)
    control = task.control(robot)
    scale, offset = (torch.from_numpy(x).float() for x in (control.action_scale, control.action_offset))
    return Policy(Normalizer(mean, std), Actor(len(mean), control.action_dim, hidden), scale, offset)


def normalization(robot: Robot, task: Task) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mean and standard deviation (d,) that normalize the observations of a task and its controller."""
    mean, std = observation_scale(task, robot)
    return torch.from_numpy(mean), torch.from_numpy(std)


def save_policy(folder: Path, policy: Policy) -> None:
    """Write policy.pt: the state dict and the sizes of the hidden layers."""
    linear = [m.out_features for m in policy.actor.body if isinstance(m, torch.nn.Linear)]
    save_tensors(folder / "policy.pt", {"state": policy.state_dict(), "hidden": linear[:-1]})


def load_policy(folder: Path, robot: Robot, task: Task) -> Policy:
    """Load the policy of a run folder.

    Raises:
        UserError: policy.pt is missing, damaged, or made for a different arm or task.
    """
    path = Path(folder) / "policy.pt"
    if not path.is_file():
        raise UserError(f"policy: no policy.pt in {folder}")
    saved = load_tensors(path, "policy")
    try:
        policy = make_policy(robot, task, tuple(saved["hidden"]))
        policy.load_state_dict(saved["state"])
    except KeyError as error:
        raise UserError(f"policy: {path} is damaged: it has no {error}") from None
    except RuntimeError:
        raise UserError(f"policy: {path} does not fit the task with {robot.name}, {robot.n} joints") from None
    return policy.eval()


def export_onnx(path: Path, policy: Policy, robot: Robot, task: Task) -> None:
    """Write policy.onnx, which maps `observation` (B, d) to an action (B, a), both in SI units.

    The output has the name of the controller's action, `torque` by default. Metadata for a driver describe joints,
    policy rate, limits, low-pass and controller.
    """
    import onnx

    example = torch.zeros(2, len(policy.normalizer.mean))
    quiet = contextlib.redirect_stdout(io.StringIO())
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with atomic_write(path) as part:
        with warnings.catch_warnings(), quiet:
            warnings.simplefilter("ignore")  # the exporter warns about its own internals
            torch.onnx.export(
                policy,
                (example,),
                str(part),
                input_names=["observation"],
                output_names=[task.control(robot).action.replace(" ", "_")],
                dynamic_shapes={"observation": {0: torch.export.Dim("batch")}},
                external_data=False,
                verbose=False,
            )
        model = onnx.load(part)
        for key, value in _metadata(policy, robot, task).items():
            model.metadata_props.add(key=key, value=value)
        onnx.save(model, part)


def observation_words(task: Task, control: Controller) -> str:
    """Describe an observation in one line: the names and units of its components."""
    return task.observation_summary + ("; control torque / torque limit" if control.observes_torque else "")


def _metadata(policy: Policy, robot: Robot, task: Task) -> dict[str, str]:
    """Return the metadata of policy.onnx."""
    arm, control = robot.model(gravity=False), task.control(robot)
    return {
        "robot": robot.name,
        "joints": " ".join(arm.joint(j).name or f"joint{j + 1}" for j in range(robot.n)),
        "observation": observation_words(task, control),
        "policy_hz": str(task.ctrl_hz),
        "q_min_rad": " ".join(f"{q:g}" for q in robot.q_min),
        "q_max_rad": " ".join(f"{q:g}" for q in robot.q_max),
        "dq_max_rad_per_s": " ".join(f"{v:g}" for v in robot.dq_max),
        "torque_max_Nm": " ".join(f"{t:g}" for t in robot.tau_max),
        "torque_rate_max_Nm_per_s": " ".join(f"{t:g}" for t in robot.dtau_max),
        "control": control.name,
        "action": control.action,
        "action_unit": control.unit,
        "action_scale": " ".join(f"{t:g}" for t in policy.action_scale.tolist()),
        "low_pass_hz": str(task.cutoff_hz),
        "torque": "without gravity, before low-pass, clip and rate limit",
    }
