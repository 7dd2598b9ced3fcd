"""MODEL_CARD.md: what a policy was trained on, where it was measured, and where nobody has tried it."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from r2s.reporting.document import Item
from r2s.reporting.measures import shown
from r2s.reporting.tables import reach_rows

LEFT_OUT = ("_target_", "name")
NO_SDF = "Its rotors are in arm.xml and arm.urdf; SDF cannot say them, so there is no arm.sdf."


def card(
    source: Path,
    config: Mapping[str, Any],
    meta: Mapping[str, Any],
    contract: Mapping[str, Any],
    bundle: Path,
    places: Sequence[str],
) -> dict[str, list[Item]]:
    """Return the sections of the card.

    Args:
        source: the run folder. config, meta: of it. contract: of the bundle. bundle: where it is being written.
        places: names of the simulators and arms that there are.
    """
    summary = json.loads((source / "summary.json").read_text())
    best = summary["best"]
    rates, commit = contract["rates"], (meta.get("git") or {}).get("commit")
    title = f"{config['algo']['name']} for {contract['robot']}, {source.name}"
    head: list[Item] = [
        f"Observation to torque at {rates['policy_hz']} Hz, {contract['torque']['convention']}; the driver's law "
        f"makes of it what an arm may be sent at {rates['cycle_hz']} Hz. contract.json says all of it in numbers.",
        f"{shown(best).does} It knows nothing of what stands around the arm, of people, and of its own links: it may "
        "reach through itself.",
    ]
    trained: list[Item] = [
        [
            f"algorithm: {settings(config['algo'])}",
            f"task: {settings(config['task'])}",
            f"randomization: {settings(config['dr'])}",
            f"{best['env_steps']:,} steps of the environment, {best['updates']:,} updates; seed {meta.get('seed')}; "
            f"r2s commit {commit or 'unknown'}",
            model(source, config),
        ]
    ]
    if not (bundle / "model" / "arm.sdf").is_file():
        trained.append(NO_SDF)
    rows = {"MuJoCo, as trained, goals on which nothing was chosen": best}
    measured = transfers(source, shown(best).judged[0])
    rows |= measured
    done: list[Item] = [reach_rows({k: {"episodes": None, "asked": None} | dict(v) for k, v in rows.items()})]
    stops = [
        f"{place}: stopped in {row['stops']} of {row['asked']} episodes"
        for place, row in measured.items()
        if row.get("stops")
    ]
    if stops:
        done.append(stops)
    names = {place.split(" ")[0] for place in measured}
    missing = sorted(p for p in places if p not in names and p != "none" and p != "mujoco")
    arms = [p for p in missing if p in ("panda", "fr3")]
    untried: list[Item] = [f"Not tried: {', '.join(missing)}." if missing else "It was tried wherever r2s can."]
    if arms:
        untried.append(
            "No arm of metal has run it: begin as docs/safety.md says, slowly and with a hand on the stop."
        )
    return {
        title: head,
        "Trained on": trained,
        "Measured": done,
        "Not tried": untried,
        **({"Plans": plans(contract)} if contract["goal"]["kind"] == "plan" else {}),
        "Limits": [
            "Goals outside of what contract.json calls `goal.trained`, payloads, contact and other hands were not "
            "part of the training. The law holds the arm within its limits of torque, speed and position; it does "
            "not make a motion sensible."
        ],
    }


def plans(contract: Mapping[str, Any]) -> list[Item]:
    """Return what a plan is, and how one is made."""
    goal, n = contract["goal"], len(contract["joints"])
    rows, columns = goal["shape"]
    words = [
        f"A goal is a plan, {rows} rows of {columns} numbers, one every {1e3 / goal['row_hz']:g} ms: where the hand "
        f"is to be and its velocity, m and m/s in the arm's base, then angles, speeds and accelerations of the {n} "
        f"joints, rad. {goal['steps'] / goal['row_hz']:g} s are the path; {contract['observation']['preview']} rows "
        "more are what a policy sees ahead of its end. A path begins and ends at rest, and the arm at its first row.",
        f"{goal['examples']} has some of the training's family. `runtime.plan(q, dq, ddq)` makes one of a motion of "
        "the joints that any planner gave; `TrackTask.plan` of r2s/tasks/track.py makes one of a curve of the hand, "
        "as slow as the arm's limits want it.",
    ]
    if contract["base"] is not None:
        words.append(
            "The policy's torque is added to computed torque with the model that is `base` in contract.json. Neither "
            "fits an arm that is another one, or that carries what the model does not know of."
        )
    return [words]


def settings(group: Mapping[str, Any]) -> str:
    """Return a group of a config as words."""
    name = group.get("name") or group.get("_target_", "").rsplit(".", 1)[-1]
    own = (f"{k} {v}" for k, v in group.items() if k not in LEFT_OUT and v is not None)
    return ", ".join([*([name] if name else []), *own])


def model(source: Path, config: Mapping[str, Any]) -> str:
    """Return where the model that it was trained on comes from."""
    path = source / "parameters.yaml"
    if not path.is_file():
        return f"model: nominal, friction {settings(config['friction'])}; no recording of an arm is in it"
    said = yaml.safe_load(path.read_text()).get("source", {})
    return f"model: identified, from {', '.join(f'{k} {v}' for k, v in said.items())} (parameters.yaml)"


def transfers(source: Path, measure: str) -> dict[str, dict[str, Any]]:
    """Return what the finished transfers of a policy beside it measured, by place and run: rows with `measure`."""
    found: dict[str, dict[str, Any]] = {}
    for path in sorted(source.resolve().parent.parent.glob("transfer/*/summary.json")):
        try:
            meta = json.loads((path.parent / "meta.json").read_text())
            # a folder may have been moved with its root: the last two names tell
            parents = [Path(p).resolve().parts[-2:] for p in meta["parents"]]
            if meta["status"] not in ("done", "stopped") or source.resolve().parts[-2:] not in parents:
                continue
            for place, row in json.loads(path.read_text()).items():
                if place != "predicted" and np.isfinite(row.get(measure, np.nan)):
                    found[f"{place} ({path.parent.name})"] = row
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue  # not whole, or not ours
    return found
