"""Make MODEL_CARD.md, which describes the training, the measured performance and the limits of a policy."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from r2s.reporting.document import Item
from r2s.reporting.measures import measures_of
from r2s.reporting.tables import measure_rows

NOT_SHOWN = ("_target_", "name")
PHYSICAL = ("panda", "fr3")  # options of conf/arm that are physical arms
NO_SDF = "arm.xml and arm.urdf have rotor inertias, which SDF cannot express; there is no arm.sdf."


def card(
    source: Path,
    config: Mapping[str, Any],
    meta: Mapping[str, Any],
    contract: Mapping[str, Any],
    bundle: Path,
    places: Sequence[str],
) -> dict[str, list[Item]]:
    """Return the sections of the model card, {title: items}.

    Args:
        source: run folder of the training. config, meta: contents of the training's config.yaml and meta.json.
        contract: the bundle's contract. bundle: folder of the unfinished bundle. places: names of all simulators and
            arms.
    """
    best, measures = json.loads((source / "summary.json").read_text())["best"], measures_of(source)
    rates, commit = contract["rates"], (meta.get("git") or {}).get("commit")
    measured = transfers(source, measures.selection[0])
    rows = {"MuJoCo, as trained, goals without selection": best} | measured
    trained: list[Item] = [
        [
            f"algorithm: {settings(config['algo'])}",
            f"task: {settings(config['task'])}",
            f"randomization: {settings(config['dr'])}",
            f"{best['env_steps']:,} env steps, {best['updates']:,} updates; seed {meta.get('seed')}; r2s commit "
            f"{commit or 'unknown'}",
            model(source, config),
        ]
    ]
    if not (bundle / "model" / "arm.sdf").is_file():
        trained.append(NO_SDF)
    stops = [
        f"{place}: stopped in {row['stops']} of {row['asked']} episodes"
        for place, row in measured.items()
        if row.get("stops")
    ]
    table = measure_rows(measures, {k: {"episodes": None, "asked": None} | dict(v) for k, v in rows.items()})
    return {
        f"{config['algo']['name']} for {contract['robot']}, {source.name}": [
            f"Observation to torque at {rates['policy_hz']} Hz, {contract['torque']['convention']}. The safety "
            f"filter turns it into a torque that the arm accepts at {rates['cycle_hz']} Hz. contract.json has all "
            "numbers.",
            f"{measures.description} It has no knowledge of obstacles, people or its own links: it may collide with "
            "itself.",
        ],
        "Trained on": trained,
        "Measured": [table, *([stops] if stops else [])],
        "Not tried": not_tried(measured, places),
        **({} if contract["goal"]["kind"] == "point" else {"Plans": plans(contract)}),
        "Limits": [
            f"The training had no goals outside `goal.trained` of contract.json, no payload, {contacts(contract)} "
            "and no other end effector. The safety filter keeps torque, speed and position within the arm's limits; "
            "it does not make a motion sensible.",
            *pushing(contract),
        ],
    }


def contacts(contract: Mapping[str, Any]) -> str:
    """Return a phrase for the model card that names the contacts that did not occur in the training."""
    return "no contact but of the tip" if contract["goal"]["kind"] == "surface" else "no contact"


def pushing(contract: Mapping[str, Any]) -> list[str]:
    """Return sentences on the limits of contact force and closing speed."""
    push, on_surface = contract["law"]["push"], contract["goal"]["kind"] == "surface"
    if push is None:
        return ["Nothing but the torque limit bounds a force: safety.force_max was null."] if on_surface else []
    return [
        f"The command builds up at most {push['force_max']:g} N against the nominal plane, and the tip meets it at "
        f"{push['overshoot'] * push['speed_near']:.3g} m/s at most; a stop does this with a force: {push['stop']}."
    ]


def not_tried(measured: Mapping[str, Any], places: Sequence[str]) -> list[Item]:
    """Return sentences on the simulators and arms to which the policy was not transferred."""
    names = {place.split(" ")[0] for place in measured}
    missing = sorted(p for p in places if p not in names and p not in ("none", "mujoco"))
    items: list[Item] = [
        f"Not tried: {', '.join(missing)}." if missing else "Tried in all simulators and on all arms."
    ]
    if any(p in PHYSICAL for p in missing):
        items.append(
            "No physical arm has run it. Begin slowly, a hand on the stop button: see docs/explanation/safety.md."
        )
    return items


def plans(contract: Mapping[str, Any]) -> list[Item]:
    """Return the text that explains the format of a plan, and ways to make a plan."""
    goal, n = contract["goal"], len(contract["joints"])
    rows, columns = goal["shape"]
    if goal["kind"] == "surface":
        row = (
            f"A goal is a plan, {rows} rows of {columns} numbers, one per {1e3 / goal['row_hz']:g} ms: "
            f"{', '.join(goal['columns'])}; `goal.columns` of contract.json says where. The arm starts at its q."
        )
        return [[row, f"{goal['examples']} has plans of the training's family, plan.npy the first of them."]]
    words = [
        f"A goal is a plan, {rows} rows of {columns} numbers, one per {1e3 / goal['row_hz']:g} ms: position and "
        "velocity of the end effector, m and m/s in the arm's base, then positions, velocities and accelerations of "
        f"the {n} joints, rad. {goal['steps'] / goal['row_hz']:g} s are the path; the policy observes "
        f"{contract['observation']['preview']} more rows ahead. A path begins and ends at rest; the arm starts at "
        "its first row.",
        f"{goal['examples']} has plans of the training's family. `runtime.plan(q, dq, ddq)` makes a plan of a joint "
        "motion; `TrackTask.plan` of r2s/tasks/track.py makes one of a curve of the end effector, slow enough for "
        "the arm's limits.",
    ]
    if contract["control"]["model"] is not None:
        words.append(
            "The policy's torque is added to computed torque with the model `control.model` of contract.json. Both "
            "are wrong for another arm, and for a payload outside that model."
        )
    return [words]


def settings(group: Mapping[str, Any]) -> str:
    """Return a config group as a text "name, key value, ..."."""
    name = group.get("name") or group.get("_target_", "").rsplit(".", 1)[-1]
    own = (f"{k} {v}" for k, v in group.items() if k not in NOT_SHOWN and v is not None)
    return ", ".join([*([name] if name else []), *own])


def model(source: Path, config: Mapping[str, Any]) -> str:
    """Return a line on the source of the training's model, either nominal or identified."""
    path = source / "parameters.yaml"
    if not path.is_file():
        return f"model: nominal, friction {settings(config['friction'])}; not identified from a recording"
    origin = yaml.safe_load(path.read_text()).get("source", {})
    return f"model: identified, from {', '.join(f'{k} {v}' for k, v in origin.items())} (parameters.yaml)"


def transfers(source: Path, measure: str) -> dict[str, dict[str, Any]]:
    """Return {"simulator or arm (run)": measures} for each finished or stopped transfer of the policy.

    Leave out rows in which `measure` is missing or not finite.
    """
    found: dict[str, dict[str, Any]] = {}
    for path in sorted(source.resolve().parent.parent.glob("transfer/*/summary.json")):
        try:
            meta = json.loads((path.parent / "meta.json").read_text())
            # the root may have been moved, so compare only the last two parts of the path
            parents = [Path(p).resolve().parts[-2:] for p in meta["parents"]]
            if meta["status"] not in ("done", "stopped") or source.resolve().parts[-2:] not in parents:
                continue
            for place, row in json.loads(path.read_text()).items():
                if place != "predicted" and np.isfinite(row.get(measure, np.nan)):
                    found[f"{place} ({path.parent.name})"] = row
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue  # incomplete, or not a run of r2s
    return found
