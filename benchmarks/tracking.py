"""Measure path tracking (docs/how_to/tracking.md): computed torque and learned policies on twins and simulated arms.

Parts, each doing only what is missing:
    python benchmarks/tracking.py twins VARIANT SEED ...      computed torque with the nominal and identified model
    python benchmarks/tracking.py simulated SEED ...          the same, the true model and policies, on known truth
    python benchmarks/tracking.py learned VARIANT SEED ...    policies of training seed 0: identified, and nominal
                                                              with dr=paper; trainings=0,1,2: of three seeds
    python benchmarks/tracking.py ablation VARIANT SEED ...   previews, randomizations and pure torque, seed 0
    python benchmarks/tracking.py policy FOLDER VARIANT SEED  any training's policy on a twin
    python benchmarks/tracking.py                             the table of all rows
    python benchmarks/tracking.py page                        the same in benchmarks/results/tracking.md
VARIANT is rigid or elastic. Identifications and trainings go through run.py into run folders named track_*; each row
is a file of runs/bench/tracking/, so that parts can run at the same time. Seeds 0-3 are for development; seeds from
100 (rigid) and from 200 (elastic) for judging.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from common import (
    NEW,
    OLD,
    RESULTS,
    ROBOT,
    ROOT,
    default_task,
    load_training,
    markdown_rows,
    put_section,
    stamp,
)

from r2s.arm.interface import Arm
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.simulated import SimulatedArm
from r2s.arm.twins.make_twin import make_twin
from r2s.files import atomic_write
from r2s.identification.parameter_file import load_parameters
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.model_based import ZeroAction
from r2s.physics.dynamics import Dynamics
from r2s.tasks.rollout import PolicyLike, rollout
from r2s.tasks.track import TrackTask

RUNS = Path(os.environ.get("R2S_ROOT", ROOT / "runs"))
ROWS = RUNS / "bench" / "tracking"
TRAININGS = (0, 1, 2)  # seeds
STEPS = ("budget.minutes=null", "budget.env_steps=120_000")  # a minute of a core
NOMINAL = ("friction=gaz2019", "inertia=nominal")
LEARNED = {"identified": ("dr=identified",), "nominal, dr=paper": ("dr=paper",)}
ABLATION = {  # beyond LEARNED; later overrides win
    "identified, preview 1": ("dr=identified", "task.preview=1"),
    "identified, preview 10": ("dr=identified", "task.preview=10"),
    "identified, no DR": ("dr=none",),
    "identified, dr=paper": ("dr=paper",),
    "identified, dr=force": ("dr=force",),
    "nominal, no DR": ("dr=none",),
    "nominal, dr=force": ("dr=force",),
    "identified, torque alone": ("dr=identified", "control=torque", "budget.env_steps=800_000"),
}
PATHS = 12  # per row: each takes a second of a core on a twin
TASK = default_task("track")


def identify_arm(name: str, *words: str) -> Dynamics:
    """Return the dynamics that stage=identify finds; run it if it is missing."""
    folder = RUNS / "identify" / name
    if not (folder / "parameters.yaml").is_file():
        command = ["stage=identify", f"name={name}", f"root={RUNS}", "threads=1", "skip_completed=true", *words]
        subprocess.run([sys.executable, "run.py", *command], cwd=ROOT, check=True)
    space, x = load_parameters(folder, ROBOT)
    return space.dynamics(x)


def evaluate(arm: Arm, task: TrackTask, dynamics: Dynamics, policy: PolicyLike) -> dict:
    """Return the measures of an arm behind its driver, and the RMSE of each path."""
    starts, goals = fixed_episodes(ROBOT, task, PATHS)
    runner = PolicyRunner(arm, task, dynamics.level, rotors=dynamics.armature)
    done = rollout(policy, runner, task, starts, goals)
    each = 1e3 * np.sqrt((done.distance**2).mean(1))
    return task.measures(done) | {"stops": len(runner.stops), "each": " ".join(f"{x:.3f}" for x in each)}


def add(row: dict) -> None:
    """Save a row of the table."""
    ROWS.mkdir(parents=True, exist_ok=True)
    with atomic_write(row_file(row["arm"], row["what"])) as part:
        part.write_text(json.dumps(row))
    print(row, flush=True)


def row_file(arm: str, what: str) -> Path:
    """Return the file of a row."""
    return ROWS / f"{arm}, {what}.json".replace(" ", "_").replace("=", "_")


def has_row(arm: str, what: str) -> bool:
    """Return whether a row is saved."""
    return row_file(arm, what).is_file()


def twins(variant: str, seeds: Sequence[int]) -> None:
    """Evaluate computed torque on twins."""
    for seed in seeds:
        words = f"arm.variant={variant}", f"arm.seed={seed}"
        models = {"nominal": lambda: OLD}
        models["identified"] = lambda s=seed, w=words: identify_arm(f"track_{variant}_{s}", *w)
        for what, model in models.items():
            name = f"{variant} twin {seed}"
            if not has_row(name, f"computed torque, {what}"):
                dynamics = model()
                task = TASK.with_model(ROBOT, dynamics)
                row = evaluate(make_twin(ROBOT, variant=variant, seed=seed), task, dynamics, ZeroAction(ROBOT.n))
                add({"arm": name, "group": variant, "what": f"computed torque, {what}"} | row)


def simulated(seeds: Sequence[int]) -> None:
    """Evaluate computed torque and policies on simulated arms of known truth; a seed sets excitation and noise."""
    truth = replace(NEW, delay=0.003, lag=0.002)
    for seed in seeds:
        name, model = f"simulated {seed}", f"track_simulated_{seed}"
        arm = SimulatedArm(ROBOT, truth, position_noise=1e-5, velocity_noise=3e-3, seed=seed)
        words = "data=simulated", "data.delay=0.003", "data.lag=0.002", f"data.excitation_seed={seed}"
        found = identify_arm(model, *words, f"seed={seed}")
        for what, dynamics in {"nominal": OLD, "identified": found, "true": truth}.items():
            if not has_row(name, f"computed torque, {what}"):
                row = evaluate(arm, TASK.with_model(ROBOT, dynamics), dynamics, ZeroAction(ROBOT.n))
                add({"arm": name, "group": "simulated", "what": f"computed torque, {what}"} | row)
        for k in TRAININGS:
            if not has_row(name, f"policy, identified, seed {k}"):
                words = f"calibration={RUNS}/identify/{model}", *LEARNED["identified"]
                row = evaluate(arm, *load_tracking(train(f"{model}_identified_{k}", f"seed={k}", *words)))
                add({"arm": name, "group": "simulated", "what": f"policy, identified, seed {k}"} | row)


def learned(variant: str, seeds: Sequence[int], conditions: Mapping[str, Sequence[str]], ks: Sequence[int]) -> None:
    """Train under each condition, on the identified model of each twin or on the nominal model; score on the twin."""
    for seed in seeds:
        name, model = f"{variant} twin {seed}", f"track_{variant}_{seed}"
        identify_arm(model, f"arm.variant={variant}", f"arm.seed={seed}")
        for label, words in conditions.items():
            short = label.replace(", ", "_").replace(" ", "").replace("=", "")
            nominal = label.startswith("nominal")
            of = NOMINAL if nominal else (f"calibration={RUNS}/identify/{model}",)
            for k in ks:
                if not has_row(name, f"policy, {label}, seed {k}"):
                    folder = train(f"{'track' if nominal else model}_{short}_{k}", f"seed={k}", *of, *words)
                    policy(folder, variant, seed, f"policy, {label}, seed {k}")


def train(name: str, *words: str) -> str:
    """Return the run folder of a training of this task; train if it is missing."""
    settings = {word.split("=")[0]: word for word in (*STEPS, *words)}
    command = ["task=track", f"name={name}", f"root={RUNS}", "threads=1", "skip_completed=true", *settings.values()]
    subprocess.run([sys.executable, "run.py", *command], cwd=ROOT, check=True)
    return str(RUNS / "train" / name)


def load_tracking(folder: str) -> tuple[TrackTask, Dynamics, PolicyLike]:
    """Return task, model and policy of a training."""
    _, dynamics, task, policy = load_training(folder)
    return task, dynamics, policy


def policy(folder: str, variant: str, seed: int, what: str | None = None) -> None:
    """Evaluate a training's policy on a twin."""
    row = evaluate(make_twin(ROBOT, variant=variant, seed=seed), *load_tracking(folder))
    arm = {"arm": f"{variant} twin {seed}", "group": variant}
    add(arm | {"what": what or f"policy {Path(folder).name}"} | row)


def interval(rows: pd.DataFrame) -> str:
    """Return the mean RMSE and its 95 % bootstrap interval over arms and paths of each arm."""
    each = [np.array([float(x) for x in text.split()]) for text in rows["each"]]
    rng = np.random.default_rng(0)
    draws = []
    for _ in range(2000):
        arms = rng.integers(len(each), size=len(each))
        paths = [each[i][rng.integers(len(each[i]), size=len(each[i]))] for i in arms]
        draws.append(np.sqrt(np.mean(np.concatenate(paths) ** 2)))
    low, high = np.quantile(draws, [0.025, 0.975])
    middle = np.sqrt(np.mean(np.concatenate(each) ** 2))
    return f"{middle:.2f} [{low:.2f}, {high:.2f}]"


def report() -> str:
    """Return the table: a row per group of arms and controller."""
    table = pd.DataFrame([json.loads(path.read_text()) for path in sorted(ROWS.glob("*.json"))])
    table["what"] = table["what"].str.replace(r", seed \d+$", "", regex=True)
    rows = {}
    for (group, what), part in table.groupby(["group", "what"], sort=False):
        cells = {
            "arms": str(part["arm"].nunique()),
            "RMSE, mm": interval(part),
            "worst arm, mm": f"{part['path_rmse_mm'].max():.2f}",
        }
        cells |= {"largest, mm": f"{part['path_max_mm'].mean():.1f}"}
        cells |= {f"< {k} mm, %": f"{100 * part[f'within_{k}mm'].mean():.1f}" for k in (2, 5, 10)}
        cells |= {"torque, Nm": f"{part['torque_rms_Nm'].mean():.2f}", "jerk, m/s^3": f"{part['jerk'].mean():.0f}"}
        rows[f"{group}: {what}"] = cells | {"stops": f"{part['stops'].sum():.0f}"}
    return markdown_rows(rows)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["twins", variant, *seeds]:
            twins(variant, [int(s) for s in seeds])
        case ["simulated", *seeds]:
            simulated([int(s) for s in seeds])
        case ["learned", variant, *seeds]:
            given = [s.removeprefix("trainings=") for s in seeds if "=" in s] or ["0"]
            learned(variant, [int(s) for s in seeds if "=" not in s], LEARNED, [int(k) for k in given[0].split(",")])
        case ["ablation", variant, *seeds]:
            learned(variant, [int(s) for s in seeds], ABLATION, TRAININGS[:1])
        case ["policy", folder, variant, seed]:
            policy(folder, variant, int(seed))
        case []:
            print(report())
        case ["page"]:
            words = [stamp("python benchmarks/tracking.py learned VARIANT SEED ..."), report()]
            put_section(RESULTS / "tracking.md", "Policies on judging twins", words)
        case _:
            raise SystemExit(__doc__)
