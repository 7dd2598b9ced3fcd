"""The league of adapters (docs/adaptation.md): one frozen controller, what nobody announced, and who copes.

`python benchmarks/adapters.py [root=RUNS] [task=reach] [policy=FOLDER] [adapters=NAME,...] [episodes=N]
[env_steps=N] TWIN ...`
TWIN is MAKE_SEED, by default the development twins 1_0 1_1 2_0; the judging ones are 1_100 to 1_109 and 2_200 to
2_209. Each with its own identified model (stage=identify, a minute or two where it is missing, as m1_0 beneath root),
under computed torque, or under a training's policy ({} in FOLDER is the twin: runs/train/track_{}_identified_0 are
those of tracking.py); adapt=history with a network of its own (two minutes of a core). A NAME may have settings
behind it: observer:filter_s=0.03. osi and rma are policies of their own, trained for env_steps=300000 where they are
missing, as osi_m1_0 and rma_m1_0 (`told_words`); osi_untold and rma_untold are these without their adapter. Rows go
to ROOT/bench/adapters.csv, each only once, by several of these beside each other too, if they have other twins. The
tables of what is there, of each make, are printed and put into docs/league.md where it has a place for them: means
over twins and episodes with paired 95 % bootstrap intervals. A long run, a quarter of an hour of a core a policy:

    python benchmarks/adapters.py adapters=none,observer,rls,history,osi,osi_untold,rma,rma_untold \
        env_steps=1500000 1_0 1_1 2_0

Conditions: a payload of 0, 0.5, 1.0, 1.5 kg put on at U(0.5, 1.5) s, its centre uniform within 7.5 cm; friction that
has warmed to 0.8 of what it was when the arm was identified; commands that come 5 ms later. Judged is from 1 s after
the payload, the same seconds of the same episodes in all conditions.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from common import MACHINE, ROBOT, ROOT, conf, markdown, put_table, side_by_side

from r2s.adaptation import adapters as made
from r2s.arm.deploy import DrivenArm
from r2s.arm.twins import twin
from r2s.learning.batch import ArmBatch
from r2s.learning.computed_torque import computed_torque
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.policy import load_policy
from r2s.physics.payload import FARTHEST_M, Payload, ball
from r2s.reporting.statistics import paired
from r2s.stages.adapting import BESIDE, calibrated
from r2s.tasks.episode import HOLD_S, rollout
from r2s.tasks.reach import ReachTask
from r2s.tasks.track import TrackTask

CONDITIONS: dict[str, dict] = {f"{m:g} kg": {"mass": m} for m in (0.0, 0.5, 1.0, 1.5)}
CONDITIONS |= {"friction 0.8": {"friction": 0.8}, "5 ms later": {"late": 0.005}}
TASKS = {"track": TrackTask, "reach": ReachTask}
SETTLE_S = 1.0
TOLD = ("osi", "rma")  # adapters that come with a policy
RESIDUAL = 0.5  # of those on task=track: with a tenth no action holds 1.5 kg
KEY = ["twin", "under", "condition", "adapter", "episode"]


def carried(rng: np.random.Generator, mass: float) -> Payload:
    """Return a payload: when it is put on and its centre are the same whatever its mass."""
    way, far, on = rng.normal(size=3), FARTHEST_M * rng.uniform() ** (1 / 3), float(rng.uniform(0.5, 1.5))
    return Payload(np.array(mass), far * way / np.linalg.norm(way), ball(np.array(mass)), on)


def one(name: str, task, under: str, condition: str, adapter: str, known, policy, episodes, networks) -> list[dict]:
    """Return a row per episode of one twin, condition and adapter."""
    make, seed = (int(x) for x in name.split("_"))
    given, rows, (starts, goals, predicted) = CONDITIONS[condition], [], episodes
    arm = twin(ROBOT, make=make, seed=seed, **{k: v for k, v in given.items() if k != "mass"})
    silent = adapter == "none" or adapter.endswith("_untold")
    works = None if silent else made_of(adapter, known, networks / f"net_m{name}")
    model = known.dynamics
    driven = DrivenArm(arm, task, model.level, rotors=model.armature, adapter=works)
    for k in range(len(goals)):
        thing = carried(np.random.default_rng([make, seed, k]), given.get("mass", 0.0))
        arm.carry(thing if thing.mass > 0 else None)
        done = rollout(policy, driven, task, starts[k : k + 1], goals[k : k + 1])
        after = done.t >= thing.on_s + SETTLE_S
        error = 1e3 * done.distance[0, after]
        ended = not np.isfinite(done.distance[0]).all()
        held = done.distance[0, -round(HOLD_S * task.ctrl_hz) :].max()
        gap = 1e3 * np.linalg.norm(done.ee[0, after] - predicted.ee[k, after], axis=-1)
        rows.append(
            {"twin": name, "under": under, "condition": condition, "adapter": adapter, "episode": k}
            | {"rmse": np.sqrt((error**2).mean()), "within_5mm": (error < 5).mean(), "reached": held < 0.01}
            | {"gap": np.sqrt((gap**2).mean()), "stopped": int(ended)}
            | {"us": 1e6 * np.median(driven.timing.adapter) if works else 0.0}
        )
    return rows


def told_words(adapter: str, kind: str, root: Path, name: str, env_steps: int) -> list[str]:
    """Return the command that trains the policy of osi or rma for a twin."""
    words = [f"adapt={adapter}", f"task={kind}", f"calibration={root / 'identify' / f'm{name}'}", "dr=identified"]
    words += [f"task.residual={RESIDUAL}"] * (kind == "track")
    words += ["budget.minutes=null", f"budget.env_steps={env_steps}", f"root={root}"]
    return [*words, f"name={told_folder(root, adapter, kind, name).name}"]


def told_folder(root: Path, adapter: str, kind: str, name: str) -> Path:
    """Return the run folder of that policy."""
    return root / "train" / f"{adapter}_m{name}{'' if kind == 'track' else f'_{kind}'}"


def under_which(known, bare, folder: Path | str | None, adapter: str):
    """Return what is known of an arm, the task, and what makes the policy of a run folder, or computed torque."""
    if adapter in TOLD:
        known = replace(known, policy=Path(folder))
        bare = replace(bare, residual=RESIDUAL) if isinstance(bare, TrackTask) else bare
    task = bare.believing(ROBOT, known.dynamics)

    def policy():
        if folder is None:
            return computed_torque(ROBOT, task, known.dynamics)
        found = load_policy(Path(folder), ROBOT, task)
        return found.by_latent() if found.told and found.told.latent else found

    return known, task, policy


def made_of(adapter: str, known, network: Path):
    """Return an adapter with the settings of conf/adapt, but for those behind its name."""
    name, *own = adapter.split(":")
    settings = {k: v for k, v in conf(f"adapt/{name}").items() if k not in ("name", *BESIDE)}
    if "network" in settings and name not in TOLD:
        settings["network"] = network
    return getattr(made, name)(known, **settings | {k: yaml.safe_load(v) for k, v in (x.split("=") for x in own)})


def intervals(frame: pd.DataFrame, of: str, of_squares: bool) -> pd.DataFrame:
    """Return mean and 95 % interval of a measure, a row per condition and a column per adapter.

    Twins are drawn, and of each twin its episodes, the same for all adapters. of_squares: the root
    of the mean of squares.
    """
    rng, cells = np.random.default_rng(0), {}
    for condition, part in frame.groupby("condition", sort=False):
        wide = part.pivot_table(index=["twin", "episode"], columns="adapter", values=of, sort=False)
        wide = wide.astype(float).dropna()
        each = [w.to_numpy() ** (2 if of_squares else 1) for _, w in wide.groupby("twin")]
        power = 0.5 if of_squares else 1.0
        with np.errstate(invalid="ignore"):  # infinite where an arm was stopped
            low, high = np.quantile(paired(each, rng) ** power, [0.025, 0.975], axis=0)
        middle = np.concatenate(each).mean(0) ** power
        scale, digits = (1, 2) if of_squares else (100, 0)
        ended = np.isinf(np.concatenate(each)).sum(0)  # of episodes in which the arm was stopped
        cells[condition] = {
            a: f"{scale * m:.{digits}f} [{scale * x:.{digits}f}, {scale * y:.{digits}f}]" if not k else f"{k} stopped"
            for a, m, x, y, k in zip(wide.columns, middle, low, high, ended, strict=True)
        }
    return pd.DataFrame(cells).T


def minutes(adapter: str, root: Path, kind: str, names: list[str]) -> float:
    """Return what the training of an adapter, or of the policy that is told by it, took in the mean over twins."""
    own = adapter.removesuffix("_untold")
    folders = [told_folder(root, own, kind, n) if own in TOLD else root / "train" / f"net_m{n}" for n in names]
    took = [json.loads((f / "meta.json").read_text())["wall_clock_s"] for f in folders if (f / "meta.json").is_file()]
    return float(np.mean(took)) / 60 if own in (*TOLD, "history") and took else 0.0


def told(frame: pd.DataFrame, task: str, root: Path) -> str:
    """Return the table of one task as markdown, and below it what each adapter costs."""
    success = ("within_5mm", "within 5 mm, % of time") if task == "track" else ("reached", "within 1 cm, %")
    wanted = [("rmse", "RMSE, mm", True)] * (task == "track") + [(*success, False), ("gap", "path gap, mm", True)]
    parts = []
    for of, label, of_squares in wanted:
        table = intervals(frame, of, of_squares)
        parts.append(table.rename(columns=lambda a, label=label: f"{label}: {a}"))
    table = pd.concat(parts, axis=1)
    names = frame["adapter"].unique()
    cost = ", ".join(f"{a} {frame.loc[frame['adapter'] == a, 'us'].mean():.0f}" for a in names)
    stops = ", ".join(f"{a} {frame.loc[frame['adapter'] == a, 'stopped'].sum():.0f}" for a in names)
    trained = ", ".join(f"{a} {minutes(a, root, task, list(frame['twin'].unique())):.0f}" for a in names)
    below = f"µs a cycle: {cost}. Trained, minutes: {trained}. Stops: {stops}."
    return f"{markdown(table.T.rename_axis(task))}\n\n{below}"


def main() -> None:
    """Identify what is missing, run what is not there yet, print the table."""
    words = dict(w.split("=", 1) for w in sys.argv[1:] if "=" in w)
    root = Path(words.get("root", ROOT / "runs"))
    names = [w for w in sys.argv[1:] if "=" not in w] or ["1_0", "1_1", "2_0"]
    kind, count = words.get("task", "track"), int(words.get("episodes", 6))
    under = Path(words["policy"]).name if "policy" in words else f"computed torque, {kind}"
    wanted = words.get("adapters", "none,observer,rls").split(",")
    path = root / "bench" / "adapters.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    side_by_side(
        ["stage=identify", "arm=twin", f"arm.make={n[0]}", f"arm.seed={n[2:]}", f"root={root}", f"name=m{n}"]
        for n in names
        if not (root / "identify" / f"m{n}" / "posterior.npz").is_file()
    )
    taught = ["adapt=history", "task=track", f"root={root}"]
    side_by_side(
        [*taught, f"calibration={root / 'identify' / f'm{n}'}", f"name=net_m{n}"]
        for n in names
        if "history" in wanted and not (root / "train" / f"net_m{n}" / made.NETWORK).is_file()
    )
    own = [a for a in TOLD if {a, f"{a}_untold"} & set(wanted)]
    side_by_side(
        told_words(a, kind, root, n, int(words.get("env_steps", 300_000)))
        for n in names
        for a in own
        if not (told_folder(root, a, kind, n) / "summary.json").is_file()
    )
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in conf(f"task/{kind}").items()}
    bare = TASKS[kind](**settings)
    starts, goals = fixed_episodes(ROBOT, bare, count)
    for name in names:
        shared = made.Known(ROBOT, *calibrated(root / "identify" / f"m{name}", ROBOT))

        each = {}
        for adapter in wanted:
            own = adapter.removesuffix("_untold")
            tracked = words["policy"].format(name) if "policy" in words else None
            folder = told_folder(root, own, kind, name) if own in TOLD else tracked
            known, task, policy = under_which(shared, bare, folder, own)
            model = ArmBatch(ROBOT, task, known.dynamics, count, 1)
            each[adapter] = known, task, policy, rollout(policy(), model, task, starts, goals)
        for condition in CONDITIONS:
            for adapter in wanted:
                known, task, policy, predicted = each[adapter]
                old = pd.read_csv(path) if path.is_file() else pd.DataFrame(columns=KEY)
                same = (old["twin"] == name) & (old["under"] == under) & (old["condition"] == condition)
                if (same & (old["adapter"] == adapter)).sum() >= count:
                    continue
                began = time.process_time()
                rows = one(
                    name, task, under, condition, adapter, known, policy(), (starts, goals, predicted), root / "train"
                )
                pd.DataFrame(rows).to_csv(path, mode="a", header=not path.is_file(), index=False)
                rmse = np.sqrt(np.mean([r["rmse"] ** 2 for r in rows]))
                seconds = time.process_time() - began
                print(f"{name} {condition}, {adapter}: {rmse:.2f} mm ({seconds:.0f} s of a core)", flush=True)
    frame = pd.read_csv(path)
    frame = frame[(frame["under"] == under) & frame["twin"].isin(names) & frame["adapter"].isin(wanted)]
    for make, own in frame.groupby(frame["twin"].str[0]):
        seeds = ", ".join(sorted(name[2:] for name in own["twin"].unique()))
        head = f"Make {make}, twins {seeds}, {own['episode'].nunique()} episodes each, on {MACHINE}:"
        print(text := f"{head}\n\n{told(own, kind, root)}\n")
        put_table(ROOT / "docs" / "league.md", f"{under}, make {make}", text)


if __name__ == "__main__":
    main()
