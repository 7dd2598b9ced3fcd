"""Compare adapters under one frozen controller when the arm changes without notice.

    python benchmarks/adapters.py [root=RUNS] [task=reach] [policy=FOLDER] [adapters=NAME,...] [episodes=N] TWIN ...

TWIN is VARIANT_SEED, by default the development twins rigid_0 rigid_1 elastic_0; the judging twins are rigid_100 to
rigid_109 and elastic_200 to elastic_209. The controller uses the identified model of each twin (run folder
identify/TWIN below root; a missing one takes a minute or two). It is computed torque, or the policy of a training
(`{}` in FOLDER is the twin: runs/train/track_{}_identified_0 are those of tracking.py). A NAME may carry settings:
observer:filter_s=0.03. Rows go to ROOT/bench/adapters.csv, each only once; runs on different twins can write to it at
the same time. The script prints the tables and puts them between the markers of benchmarks/results/adapters.md: means
over twins and episodes with paired 95 % bootstrap intervals.

Conditions: a payload of 0, 0.5, 1.0, 1.5 kg attached at U(0.5, 1.5) s, its centre uniform within 7.5 cm; friction at
0.8 of its value during identification; commands 5 ms later. Errors count from 1 s after the payload, in the same
seconds of the same episodes in all conditions.
"""

import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from common import (
    MACHINE,
    RESULTS,
    ROBOT,
    ROOT,
    VARIANT_SEED,
    conf,
    default_task,
    identify_twins,
    markdown,
    put_table,
)

from r2s.adaptation import adapters
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.twins.make_twin import make_twin
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.model_based import computed_torque
from r2s.learning.policy import load_policy
from r2s.learning.vector_arms import VectorArms
from r2s.physics.payload import USUAL, Payload, sphere_inertia
from r2s.reporting.comparison.statistics import paired
from r2s.stages.adapter_factory import BESIDE, calibrated
from r2s.tasks.rollout import HOLD_S, rollout

CONDITIONS: dict[str, dict] = {f"{m:g} kg": {"mass": m} for m in (0.0, 0.5, 1.0, 1.5)}
CONDITIONS |= {"friction 0.8": {"friction_scale": 0.8}, "5 ms later": {"extra_delay_s": 0.005}}
SETTLE_S = 1.0  # after the payload is attached
KEY = ["twin", "under", "condition", "adapter", "episode"]


def draw_payload(rng: np.random.Generator, mass: float) -> Payload:
    """Return a payload whose time and centre do not depend on its mass."""
    way, far = rng.normal(size=3), USUAL * ROBOT.payload_max[1] * rng.uniform() ** (1 / 3)
    on = float(rng.uniform(0.5, 1.5))
    return Payload(np.array(mass), far * way / np.linalg.norm(way), sphere_inertia(np.array(mass)), on)


def evaluate(name: str, task, condition: str, adapter: str, context, policy, episodes) -> list[dict]:
    """Return a row per episode for one twin, condition and adapter."""
    variant, seed = name.split("_")
    change, rows, (starts, goals, predicted) = dict(CONDITIONS[condition]), [], episodes
    mass = change.pop("mass", 0.0)
    arm = make_twin(ROBOT, variant=variant, seed=int(seed), **change)
    added = None if adapter == "none" else make_adapter(adapter, context)
    model = context.dynamics
    runner = PolicyRunner(arm, task, model.level, rotors=model.armature, adapter=added)
    for k in range(len(goals)):
        payload = draw_payload(np.random.default_rng([VARIANT_SEED[variant], int(seed), k]), mass)
        arm.carry(payload if payload.mass > 0 else None)
        done = rollout(policy, runner, task, starts[k : k + 1], goals[k : k + 1])
        after = done.t >= payload.on_s + SETTLE_S
        error = 1e3 * done.distance[0, after]
        gap = 1e3 * np.linalg.norm(done.ee[0, after] - predicted.ee[k, after], axis=-1)
        rows.append(
            {
                "twin": name,
                "condition": condition,
                "adapter": adapter,
                "episode": k,
                "rmse": np.sqrt((error**2).mean()),
                "within_5mm": (error < 5).mean(),
                "reached": done.distance[0, -round(HOLD_S * task.ctrl_hz) :].max() < 0.01,
                "gap": np.sqrt((gap**2).mean()),
                "stopped": int(not np.isfinite(done.distance[0]).all()),
                "us": 1e6 * np.median(runner.timing.adapter) if added else 0.0,
            }
        )
    return rows


def make_adapter(adapter: str, context):
    """Return an adapter with the settings of conf/adapt, changed by those in its name."""
    name, *own = adapter.split(":")
    settings = {k: v for k, v in conf(f"adapt/{name}").items() if k not in ("name", *BESIDE)}
    return getattr(adapters, name)(
        context, **settings | {k: yaml.safe_load(v) for k, v in (x.split("=") for x in own)}
    )


def intervals(frame: pd.DataFrame, measure: str, root_mean_square: bool) -> pd.DataFrame:
    """Return mean (or root mean square) and 95 % interval of a measure: a row per condition, a column per adapter.

    The bootstrap draws twins, and episodes of each twin, the same ones for all adapters.
    """
    rng, cells = np.random.default_rng(0), {}
    for condition, part in frame.groupby("condition", sort=False):
        wide = part.pivot_table(index=["twin", "episode"], columns="adapter", values=measure, sort=False)
        wide = wide.astype(float).dropna()
        each = [w.to_numpy() ** (2 if root_mean_square else 1) for _, w in wide.groupby("twin")]
        power = 0.5 if root_mean_square else 1.0
        with np.errstate(invalid="ignore"):  # the error of a stopped episode is infinite
            low, high = np.quantile(paired(each, rng) ** power, [0.025, 0.975], axis=0)
        middle = np.concatenate(each).mean(0) ** power
        scale, digits = (1, 2) if root_mean_square else (100, 0)
        stopped = np.isinf(np.concatenate(each)).sum(0)
        cells[condition] = {
            a: f"{scale * m:.{digits}f} [{scale * x:.{digits}f}, {scale * y:.{digits}f}]" if not k else f"{k} stopped"
            for a, m, x, y, k in zip(wide.columns, middle, low, high, stopped, strict=True)
        }
    return pd.DataFrame(cells).T


def tables(frame: pd.DataFrame, task: str) -> str:
    """Return the table of one task as markdown, and below it the cost and the stops of each adapter."""
    success = ("within_5mm", "within 5 mm, % of time") if task == "track" else ("reached", "within 1 cm, %")
    measures = [("rmse", "RMSE, mm", True)] * (task == "track") + [(*success, False), ("gap", "path gap, mm", True)]
    parts = []
    for measure, label, root_mean_square in measures:
        table = intervals(frame, measure, root_mean_square)
        parts.append(table.rename(columns=lambda a, label=label: f"{label}: {a}"))
    names = frame["adapter"].unique()
    cost = ", ".join(f"{a} {frame.loc[frame['adapter'] == a, 'us'].mean():.0f}" for a in names)
    stops = ", ".join(f"{a} {frame.loc[frame['adapter'] == a, 'stopped'].sum():.0f}" for a in names)
    return f"{markdown(pd.concat(parts, axis=1).T.rename_axis(task))}\n\nµs a cycle: {cost}. Stops: {stops}."


def main() -> None:
    """Identify missing twins, run missing episodes, print the tables."""
    words = dict(w.split("=", 1) for w in sys.argv[1:] if "=" in w)
    root = Path(words.get("root", ROOT / "runs"))
    names = [w for w in sys.argv[1:] if "=" not in w] or ["rigid_0", "rigid_1", "elastic_0"]
    kind, count = words.get("task", "track"), int(words.get("episodes", 6))
    under = Path(words["policy"]).name if "policy" in words else f"computed torque, {kind}"
    compared = words.get("adapters", "none,observer,rls").split(",")
    path = root / "bench" / "adapters.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    folders = {name: root / "identify" / name for name in names}
    identify_twins([(n.split("_")[0], int(n.split("_")[1]), folder) for n, folder in folders.items()], root)
    plain = default_task(kind)
    starts, goals = fixed_episodes(ROBOT, plain, count)
    for name, folder in folders.items():
        context = adapters.AdapterContext(ROBOT, *calibrated(folder, ROBOT))
        task = plain.with_model(ROBOT, context.dynamics)

        def policy(name=name, task=task, context=context):
            if "policy" in words:
                return load_policy(Path(words["policy"].format(name)), ROBOT, task)
            return computed_torque(ROBOT, task, context.dynamics)

        predicted = rollout(policy(), VectorArms(ROBOT, task, context.dynamics, count, 1), task, starts, goals)
        for condition in CONDITIONS:
            for adapter in compared:
                old = pd.read_csv(path) if path.is_file() else pd.DataFrame(columns=KEY)
                same = (old["twin"] == name) & (old["under"] == under) & (old["condition"] == condition)
                if (same & (old["adapter"] == adapter)).sum() >= count:
                    continue
                began = time.process_time()
                rows = evaluate(name, task, condition, adapter, context, policy(), (starts, goals, predicted))
                frame = pd.DataFrame(rows)
                frame.insert(1, "under", under)
                frame.to_csv(path, mode="a", header=not path.is_file(), index=False)
                rmse = np.sqrt((frame["rmse"] ** 2).mean())
                seconds = time.process_time() - began
                print(f"{name} {condition}, {adapter}: {rmse:.2f} mm ({seconds:.0f} s of a core)", flush=True)
    frame = pd.read_csv(path)
    frame = frame[(frame["under"] == under) & frame["twin"].isin(names) & frame["adapter"].isin(compared)]
    for variant, own in frame.groupby(frame["twin"].str.split("_").str[0]):
        seeds = ", ".join(sorted(name.split("_")[1] for name in own["twin"].unique()))
        head = f"{variant.capitalize()} twins {seeds}, {own['episode'].nunique()} episodes each, on {MACHINE}:"
        print(text := f"{head}\n\n{tables(own, kind)}\n")
        put_table(RESULTS / "adapters.md", f"{under}, {variant}", text)


if __name__ == "__main__":
    main()
