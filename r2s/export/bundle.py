"""Write the bundle of `r2s export`: a folder with everything that another program needs to run a policy."""

import ast
import builtins
import inspect
import json
import os
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2s import export
from r2s.control.controller import Controller
from r2s.errors import UserError
from r2s.export.card import card
from r2s.export.contract import make_contract
from r2s.export.control import LAWS
from r2s.export.header import header
from r2s.export.runtime import BundleError, seal_of
from r2s.export.surface_contract import surface_plans
from r2s.identification.contact.contact_file import load_contact
from r2s.identification.contact.exchange import write_surface
from r2s.learning.networks import Policy
from r2s.physics.description import write_description
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface
from r2s.provenance import packages, sha256
from r2s.reporting.document import report_markdown
from r2s.runs import read_meta
from r2s.tasks.surface_task import SurfaceTask
from r2s.tasks.task import Task

IDENTIFIED = ("parameters.yaml", "posterior.npz")
# modules whose code r2s_runtime.py of a bundle contains in this order, in addition to the code of runtime.py
HERE, PARTS = "r2s.export.", ("law", "arm", "push", "control", "inverse_dynamics", "plan", "surface", "fences")
EXAMPLES = 4  # number of example plans in a bundle
PLAN = "plan.npy"  # first example plan, which the C++ control loop reads; only for plans on a surface
SAME = 1e-4  # allowed difference between the actions of policy.onnx and policy.pt, as a share of action_scale


def write_bundle(
    to: Path,
    source: Path,
    robot: Robot,
    task: Task,
    dynamics: Dynamics,
    policy: Policy,
    config: Mapping[str, Any],
    places: Sequence[str],
) -> None:
    """Write the bundle of a finished training atomically into the new folder `to`.

    Args:
        to: the new folder. source: run folder of the training.
        robot, task, policy, config: robot, task, policy and config of the training.
        dynamics: dynamics of one arm, at the center of the training's domain randomization.
        places: names of all simulators and arms; the model card lists those on which the policy has not run.

    Raises:
        UserError: `to` exists, the run has no policy.onnx, or policy.onnx and policy.pt compute different actions.
    """
    if to.exists():
        raise UserError(f"export: {to} exists; remove it, or choose another to=FOLDER")
    contract = make_contract(robot, task, dynamics.level, dynamics.armature)
    meta = read_meta(source)
    part = to.with_name(f".{to.name}.{os.getpid()}.part")
    try:
        part.mkdir(parents=True)
        copy_policy(source, part, policy, contract)
        for name in IDENTIFIED:
            if (source / name).is_file():
                shutil.copyfile(source / name, part / name)
        for line in write_description(part / "model", robot, dynamics):
            print(line)
        if (surface := surface_of(source, robot, task, dynamics)) is not None:
            write_surface(part / "model", robot, surface)
        (part / "r2s_runtime.py").write_text(one_file(task.control(robot)))
        if contract["goal"]["kind"] != "point":
            plans = task.goals(robot, np.random.default_rng(0), EXAMPLES)
            if isinstance(task, SurfaceTask):
                plans = surface_plans(robot, task, plans)
                np.save(part / PLAN, plans[0])
            np.savez_compressed(part / contract["goal"]["examples"], plans=plans)
        if contract["goal"]["kind"] != "plan" and task.control(robot).cpp:
            (part / "contract.hpp").write_text(
                header(contract, sha256(part / "policy.onnx"), task.control(robot).cpp)
            )
        report_markdown(part / "MODEL_CARD.md", card(source, config, meta, contract, part, places))
        contract["files"] = {
            p.relative_to(part).as_posix(): sha256(p) for p in sorted(part.rglob("*")) if p.is_file()
        }
        contract["versions"] = packages()
        contract["trained"] = {"run": source.name} | {k: meta.get(k) for k in ("start", "seed", "git", "packages")}
        contract["seal"] = seal_of(contract)
        (part / "contract.json").write_text(json.dumps(contract, indent=1, allow_nan=False) + "\n")
        check_with_own_runtime(part)
        os.rename(part, to)
    except BundleError as error:
        raise UserError(f"export: {error}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)


def surface_of(source: Path, robot: Robot, task: Task, dynamics: Dynamics) -> Surface | None:
    """Return the surface that a run identified, or the task's nominal surface; None if the task has no contact."""
    if not task.touches:
        return None
    if (source / "contact.yaml").is_file():
        return load_contact(source, "dr.surface").simulated.surface
    return task.expected(robot, dynamics).surface


def check_with_own_runtime(folder: Path) -> None:
    """Raise BundleError if the bundle's r2s_runtime.py, which contains the control law, refuses the contract."""
    command = [sys.executable, "-B", str(folder / "r2s_runtime.py"), str(folder)]  # -B: no __pycache__ in the bundle
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BundleError(done.stderr.strip().removeprefix("error: "))


def copy_policy(source: Path, part: Path, policy: Policy, contract: Mapping[str, Any]) -> None:
    """Copy policy.onnx; check that its actions agree with policy.pt, and its metadata with the contract."""
    import onnx
    from onnx.reference import ReferenceEvaluator

    if not (source / "policy.onnx").is_file():
        raise UserError(f"export: {source} has no policy.onnx")
    shutil.copyfile(source / "policy.onnx", part / "policy.onnx")
    try:
        model = onnx.load(part / "policy.onnx")
        agree(dict(contract), {p.key: p.value for p in model.metadata_props})
        mean, std = policy.normalizer.mean.numpy(), policy.normalizer.std.numpy()
        seen = (mean + std * np.random.default_rng(0).normal(size=(64, len(mean)))).astype(np.float32)
        (actions,) = ReferenceEvaluator(model).run(None, {"observation": seen})
        with torch.no_grad():
            expected = policy(torch.from_numpy(seen)).numpy()
        off = np.abs(actions - expected).max(0) / np.array(contract["control"]["action_scale"])
    except BundleError:
        raise
    except Exception as error:  # a damaged file may raise any error
        seen_ = " ".join(str(error).split())[:100]
        raise UserError(f"export: {source / 'policy.onnx'} is damaged ({seen_})") from None
    if not off.max() < SAME:
        raise UserError(f"export: policy.onnx of {source} is not its policy.pt: actions differ by {off.max():.2g}")


def agree(contract: dict[str, Any], metadata: dict[str, str]) -> None:
    """Raise BundleError if the metadata of policy.onnx differ from the contract."""
    limits, torque, rates, control = (contract[k] for k in ("limits", "torque", "rates", "control"))

    def words(values: Sequence[float | None], none: str = "inf") -> str:
        return " ".join(none if v is None else f"{v:g}" for v in values)

    expected = {"joints": " ".join(contract["joints"]), "observation": contract["observation"]["words"]}
    expected |= {"policy_hz": str(rates["policy_hz"]), "low_pass_hz": str(rates["low_pass_hz"])}
    expected |= {"q_min_rad": words(limits["q_min_rad"], "-inf"), "q_max_rad": words(limits["q_max_rad"])}
    expected |= {"dq_max_rad_per_s": words(limits["dq_max_rad_per_s"]), "torque_max_Nm": words(torque["max_Nm"])}
    expected["torque_rate_max_Nm_per_s"] = words(torque["max_rate_Nm_per_s"])
    expected |= {"control": control["name"], "action_scale": words(control["action_scale"])}
    for name, value in expected.items():
        if metadata.get(name) != value:
            raise BundleError(f"{name}: '{value}' in contract.json, '{metadata.get(name)}' in policy.onnx")
    if not metadata.get("torque", "").startswith(torque["convention"]):
        raise BundleError(
            f"torque: '{torque['convention']}' in contract.json, '{metadata.get('torque')}' in policy.onnx"
        )


def one_file(control: Controller) -> str:
    """Return the text of r2s_runtime.py: the code of runtime.py and of the r2s modules that runtime.py imports.

    Raises:
        UserError: the control law uses names that a bundle does not contain.
    """
    here = Path(export.__file__).parent

    def imports(text: str) -> list[ast.Import | ast.ImportFrom]:
        return [node for node in ast.parse(text).body if isinstance(node, ast.Import | ast.ImportFrom)]

    def own(name: str) -> str:
        text = (here / f"{name}.py").read_text()
        body = "".join(text.splitlines(keepends=True)[imports(text)[-1].end_lineno :]).strip()
        return f"{laws}\n\n\n{body}\n\n\n{extra}".strip() if name == "control" else body

    laws = "\n\n\n".join(law_source(law)[1] for law in LAWS.values())
    extra = ""
    if control.law not in LAWS.values():
        name, source = law_source(control.law)
        extra = f"{source}\n\n\nLAWS[{control.name!r}] = {name}"
    text = (here / "runtime.py").read_text()
    lines = text.splitlines(keepends=True)
    ours = [node for node in imports(text) if isinstance(node, ast.ImportFrom) and f"{node.module}".startswith(HERE)]
    for node in ours:
        lines[node.lineno - 1 : node.end_lineno] = [""] * (1 + (node.end_lineno or 0) - node.lineno)
    words = {ast.unparse(node) for name in PARTS for node in imports((here / f"{name}.py").read_text())}
    others = "\n".join(sorted(line for line in words if not line.startswith("from r2s")))
    lines[ours[0].lineno - 1] = others + "\n\n\n" + "\n\n\n".join(map(own, PARTS)) + "\n\n\n"
    return "".join(lines)


def law_source(law: Any) -> tuple[str, str]:
    """Return the name and the source of a control law as plain Python, without decorators.

    If the law uses a module's functions or numbers, the source is a function that defines them and returns the law.

    Raises:
        UserError: the law uses a name that is neither a function, a number, a builtin nor NumPy's `np`.
    """
    function = getattr(law, "py_func", law)
    sources: dict[str, str] = {}
    _collect(function, function.__name__, sources)
    own = sources.pop(function.__name__)
    if not sources:
        return function.__name__, own
    name = f"_{function.__name__}"
    body = textwrap.indent("\n\n".join([*sources.values(), own, f"return {function.__name__}"]), "    ")
    return f"{name}()", f"def {name}():\n{body}"


def _collect(function: Any, law: str, sources: dict[str, str]) -> None:
    """Add to `sources` {name: source} the functions and numbers that `function` uses, then `function` itself."""
    node = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(node, ast.FunctionDef)
    node.decorator_list = []
    used = set(function.__code__.co_names) & set(function.__globals__) - {"np", *dir(builtins)}
    foreign = []
    for name in sorted(used - set(sources)):
        value = getattr(function.__globals__[name], "py_func", function.__globals__[name])
        if isinstance(value, int | float):
            sources[name] = f"{name} = {value!r}"
        elif inspect.isfunction(value):
            _collect(value, law, sources)
        else:
            foreign.append(name)
    if foreign:
        raise UserError(f"export: control law {law} uses {', '.join(foreign)}; a bundle has np alone")
    sources[function.__name__] = ast.unparse(node)
