"""`r2s export`: a folder that holds all that another program needs to run a policy, and that says so of itself."""

import ast
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2s import export
from r2s.errors import UserError
from r2s.export.card import card
from r2s.export.contract import make_contract
from r2s.export.header import header
from r2s.export.runtime import BundleError, agree, load, seal_of
from r2s.learning.networks import Policy
from r2s.physics.description import write_description
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.provenance import packages, sha256
from r2s.reporting.document import report_markdown
from r2s.runs import read_meta
from r2s.tasks.task import Task

IDENTIFIED = ("parameters.yaml", "posterior.npz")
HERE, PARTS = "r2s.export.", ("law", "base", "plan")  # what the one file is made of beside runtime.py, in this order
EXAMPLES = 4  # plans that a bundle has
SAME = 1e-4  # of the torque that an action of 1 asks for: policy.onnx against policy.pt


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
    """Write the bundle of a finished training into the new folder `to`; it has that name only once it is whole.

    Args:
        to: where. source: the run folder of the training.
        robot, task, dynamics, policy: of it; dynamics of one arm, the centre of what it was trained on.
        config: of it. places: names of the simulators and arms there are, for what was not tried.

    Raises:
        UserError: `to` is there already, the run has no policy.onnx, or one that is not its policy.pt.
    """
    if to.exists():
        raise UserError(f"export: {to} is there already; remove it, or say another to=FOLDER")
    contract = make_contract(robot, task, dynamics.level, dynamics.armature)
    meta = read_meta(source)
    part = to.with_name(f".{to.name}.{os.getpid()}.part")
    try:
        part.mkdir(parents=True)
        copy_policy(source, part, policy, contract)
        for name in IDENTIFIED:
            if (source / name).is_file():
                shutil.copyfile(source / name, part / name)
        write_description(part / "model", robot, dynamics)
        (part / "r2s_runtime.py").write_text(one_file())
        if contract["goal"]["kind"] == "plan":
            plans = task.goals(robot, np.random.default_rng(0), EXAMPLES)
            np.savez_compressed(part / contract["goal"]["examples"], plans=plans)
        else:
            (part / "contract.hpp").write_text(header(contract, sha256(part / "policy.onnx")))
        report_markdown(part / "MODEL_CARD.md", card(source, config, meta, contract, part, places))
        contract["files"] = {
            p.relative_to(part).as_posix(): sha256(p) for p in sorted(part.rglob("*")) if p.is_file()
        }
        contract["versions"] = packages()
        contract["trained"] = {"run": source.name} | {k: meta.get(k) for k in ("start", "seed", "git", "packages")}
        contract["seal"] = seal_of(contract)
        (part / "contract.json").write_text(json.dumps(contract, indent=1, allow_nan=False) + "\n")
        load(part)
        os.rename(part, to)
    except BundleError as error:
        raise UserError(f"export: {error}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)


def copy_policy(source: Path, part: Path, policy: Policy, contract: Mapping[str, Any]) -> None:
    """Copy policy.onnx, which has to give what policy.pt gives, and to say what the contract says."""
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
        (said,) = ReferenceEvaluator(model).run(None, {"observation": seen})
        with torch.no_grad():
            wanted = policy(torch.from_numpy(seen)).numpy()
        off = np.abs(said - wanted).max(0) / np.array(contract["torque"]["action_Nm"])
    except BundleError:
        raise
    except Exception as error:  # reading what is damaged may fail in any way
        seen_ = " ".join(str(error).split())[:100]
        raise UserError(f"export: {source / 'policy.onnx'} is damaged ({seen_})") from None
    if not off.max() < SAME:
        raise UserError(f"export: policy.onnx of {source} is not its policy.pt: actions differ by {off.max():.2g}")


def one_file() -> str:
    """Return r2s_runtime.py: r2s/export/runtime.py, with what its parts define where it imports them."""
    here = Path(export.__file__).parent

    def imports(text: str) -> list[ast.Import | ast.ImportFrom]:
        return [node for node in ast.parse(text).body if isinstance(node, ast.Import | ast.ImportFrom)]

    def own(name: str) -> str:
        text = (here / f"{name}.py").read_text()
        return "".join(text.splitlines(keepends=True)[imports(text)[-1].end_lineno :]).strip()

    text = (here / "runtime.py").read_text()
    lines = text.splitlines(keepends=True)
    ours = [node for node in imports(text) if isinstance(node, ast.ImportFrom) and f"{node.module}".startswith(HERE)]
    for node in ours:
        lines[node.lineno - 1 : node.end_lineno] = [""] * (1 + (node.end_lineno or 0) - node.lineno)
    lines[ours[0].lineno - 1] = "\n\n\n".join(map(own, PARTS)) + "\n\n\n"
    return "".join(lines)
