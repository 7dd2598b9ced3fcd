"""Shared by the benchmarks: the Panda with published and true values, settings of conf/, runs, result pages."""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from datetime import date
from difflib import get_close_matches
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
NUMBER = r"\d+(\.\d+)?"
CONSTANT = rf"[A-Z_]+={NUMBER}(e-?\d+)?"
PARTS = r"part=(events|quiet|warming|load)(,(events|quiet|warming|load))*"
ARGUMENTS: dict[str, tuple[str, ...]] = {  # patterns of each script's arguments; scripts not listed check their own
    "algorithms": ("page",),
    **dict.fromkeys(("bench", "gallery"), ()),
    "adapters": (r"(root|task|episodes|policy|adapters)=.+", r"(rigid|elastic)_\d+"),
    "grid": ("page",),
    "press": (r"env_steps=[1-9]\d*", r"policies=[1-9]\d*", r"(rigid|elastic)_\d+"),
    "payload": (PARTS, r"(root|keep)=.+", r"variant=\w+", r"(motions|minutes)=[1-9]\d*", CONSTANT, r"\d+"),
    "searches": (NUMBER,),
    "transfer": ("page", "twins", "noise", r"\d+"),
    "twins": (r"variant=(rigid|elastic)", r"\d+"),
}


def check_arguments() -> None:
    """End a script with one line if it takes no such argument."""
    script = Path(sys.argv[0])
    if script.resolve().parent != ROOT / "benchmarks" or script.stem not in ARGUMENTS:
        return
    for word in sys.argv[1:]:
        if not any(re.fullmatch(pattern, word) for pattern in ARGUMENTS[script.stem]):
            allowed = ", ".join(ARGUMENTS[script.stem]) or "no arguments"
            sys.exit(f"error: {script.name}: unknown argument '{word}'; allowed: {allowed}")


def report_interrupt(kind, error, trace) -> None:
    """Answer Ctrl-C with one line instead of a traceback."""
    if issubclass(kind, KeyboardInterrupt):
        print("\ninterrupted; finished results are kept and not repeated", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


check_arguments()
sys.excepthook = report_interrupt

from hydra.utils import instantiate  # noqa: E402
from omegaconf import OmegaConf  # noqa: E402

from r2s.arm.ramp import poses_about, ramp  # noqa: E402
from r2s.arm.recorder import record  # noqa: E402
from r2s.arm.simulated import SimulatedArm  # noqa: E402
from r2s.excitation.fourier import fourier  # noqa: E402
from r2s.identification.settings import Settings  # noqa: E402
from r2s.physics.dynamics import nominal_dynamics  # noqa: E402
from r2s.physics.robot import OF_TASKS, load_robot  # noqa: E402
from r2s.provenance import cpu, git  # noqa: E402
from r2s.tasks.reach import ReachTask  # noqa: E402
from r2s.tasks.track import TrackTask  # noqa: E402


def conf(path: str) -> dict:
    """Return the arguments in one file of conf/, without `_target_`; tasks with the Panda's values."""
    document = yaml.safe_load((ROOT / "conf" / f"{path}.yaml").read_text())
    if path.startswith("task/"):
        panda = yaml.safe_load((ROOT / "conf/robot/panda.yaml").read_text())
        document = OmegaConf.to_container(OmegaConf.create({"robot": panda, "task": document}), resolve=True)["task"]
    dropped = {"_target_", "defaults", *(OF_TASKS if path.startswith("robot/") else ())}
    return {k: v for k, v in document.items() if k not in dropped}


MACHINE = f"{cpu()}, {os.cpu_count()} cores"
RESULTS = ROOT / "benchmarks" / "results"
ROBOT = load_robot(**conf("robot/panda"))
OLD = nominal_dynamics(ROBOT, **conf("friction/gaz2019"))
NEW = nominal_dynamics(ROBOT, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
NOMINAL = "friction=gaz2019", "inertia=nominal"  # arguments of run.py: published model of the Panda
JUDGING = {"rigid": range(100, 110), "elastic": range(200, 210)}  # twin seeds that nothing is tuned on
VARIANT_SEED = {"rigid": 1, "elastic": 2}  # first number of the random seeds of a variant's payloads
SENSOR_NOISE = {"position_noise": 2e-5, "velocity_noise": 3e-3}  # rad, rad/s: standard deviations


def twin_variant(seed: int) -> str:
    """Return the variant of twin to which a judging seed belongs; rigid for all others."""
    return next((variant for variant, seeds in JUDGING.items() if seed in seeds), "rigid")


def searches(name: str, **change) -> list:
    """Return the searches of conf/search/<name>.yaml with seed 0."""
    text = (ROOT / "conf" / "search" / f"{name}.yaml").read_text().replace("${seed}", "0")
    return [instantiate(s | {k: v for k, v in change.items() if k in s}) for s in yaml.safe_load(text)]


def identify_settings(torque: str = "commanded", **change) -> Settings:
    """Return the settings of stage=identify, except for the family."""
    names = {f.name for f in fields(Settings)}  # the stage reads the others
    own = {k: v for k, v in conf("identify/default").items() if k in names}
    per_torque = ("terms", "prior", "candidate_terms", "prunable_terms")
    return Settings(**own | {k: own[k][torque] for k in per_torque} | change)


def default_task(name: str) -> ReachTask | TrackTask:
    """Return task=reach or task=track of the Panda."""
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in conf(f"task/{name}").items()}
    return {"reach": ReachTask, "track": TrackTask}[name](**settings)


def simulated_arm(truth, seed: int) -> SimulatedArm:
    """Return a simulated Panda of known truth with sensor noise."""
    return SimulatedArm(ROBOT, truth, **SENSOR_NOISE, seed=seed)


def load_training(folder: str | Path):
    """Return robot, dynamics, task and policy of a run folder of stage=train."""
    from r2s.learning.policy import load_policy
    from r2s.stages.build import make_dynamics, make_robot, make_task
    from r2s.stages.transfer import trained_config

    source, trained = trained_config(OmegaConf.create({"policy": str(folder)}))
    robot = make_robot(trained)
    dynamics = make_dynamics(trained, robot)
    task = make_task(trained, robot, dynamics)
    return robot, dynamics, task, load_policy(source, robot, task)


def stamp(command: str) -> str:
    """Return machine, date, commit and command, as every page of benchmarks/results/ states them."""
    return f"{MACHINE}; {date.today()}; commit {(git()['commit'] or 'unknown')[:7]}; `{command}`."


def run_parallel(jobs: Iterable[Sequence[str]]) -> None:
    """Run commands of run.py with one thread each on all cores of this process; skip finished ones."""
    run_scripts(["run.py", *job, "threads=1", "skip_completed=true"] for job in jobs)


def run_scripts(jobs: Iterable[Sequence[str]]) -> None:
    """Run scripts with their arguments, as many at a time as this process has cores."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    waiting, running = list(jobs), list[subprocess.Popen[bytes]]()
    while waiting or running:
        while waiting and len(running) < cores:
            command = [sys.executable, *waiting.pop(0)]
            running.append(subprocess.Popen(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}))
        time.sleep(0.1)
        if failed := [job for job in running if job.poll()]:
            sys.exit(f"failed: {' '.join(map(str, failed[0].args))}")
        running = [job for job in running if job.returncode is None]


def identify_twins(twins: Iterable[tuple[str, int, Path]], root: Path) -> None:
    """Identify twins (variant, seed, run folder) whose run folder has no posterior yet."""
    run_parallel(
        ["stage=identify", "arm=twin", f"arm.variant={v}", f"arm.seed={s}", f"root={root}", f"name={folder.name}"]
        for v, s, folder in twins
        if not (folder / "posterior.npz").is_file()
    )


def set_constants(constants: dict[str, str]) -> None:
    """Set constants in all modules of r2s/adaptation, in a new process: compiled code contains the old values."""
    modules = [module for name, module in sys.modules.items() if name.startswith("r2s.adaptation.")]
    names = {
        name for module in modules for name, x in vars(module).items() if isinstance(x, float) and name.isupper()
    }
    for name in constants:
        if name not in names:
            near = get_close_matches(name, names, 1)
            sys.exit(f"error: no number {name} in r2s/adaptation" + (f"; did you mean {near[0]}?" if near else ""))
    if constants and "R2S_TUNED" not in os.environ:
        with tempfile.TemporaryDirectory() as folder:
            own = {"R2S_TUNED": "1", "NUMBA_CACHE_DIR": folder}
            sys.exit(subprocess.run([sys.executable, *sys.argv], env=os.environ | own).returncode)
    for module in modules:
        for name in constants.keys() & vars(module).keys():
            setattr(module, name, float(constants[name]))


def cells(table, values: dict[str, float]) -> dict[str, str]:
    """Return {column: cell} of the measures `values` in the order of a task's `table` of measures."""
    return {table[key].column.replace("\n", " "): table[key].cell(values[key]) for key in table.rows}


def means(table, rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean over rows of each measure in a task's `table`, of RMS errors the root of the mean square.

    A measure that is missing in a row, such as an error of stopped episodes, is NaN.
    """

    def mean(key: str) -> float:
        power = 2 if table[key].root_mean_square else 1
        values = np.array([row[key] for row in rows], dtype=float)  # None becomes NaN
        return float(np.mean(values**power) ** (1 / power))

    return {key: mean(key) for key in table.rows}


def worst(table, rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the worst of the rows' values of each measure in a task's `table`; NaN if a value is missing."""
    values = {key: np.array([row[key] for row in rows], dtype=float) for key in table.rows}
    return {key: table[key].sign * float(np.min(table[key].sign * each)) for key, each in values.items()}


def training_time(runs: Sequence[Path]) -> str:
    """Return the env steps and the range of training times of finished trainings as words."""
    last = [json.loads((run / "summary.json").read_text())["last"] for run in runs]
    steps, seconds = ([row[key] for row in last] for key in ("env_steps", "wall_clock_s"))
    return f"{max(steps):,} env steps in {min(seconds) / 60:.1f} to {max(seconds) / 60:.1f} minutes"


def markdown(table: pd.DataFrame) -> str:
    """Return a table of strings as markdown, the index first."""
    head = [str(table.index.name or ""), *map(str, table.columns)]
    rows = [[str(i), *map(str, row)] for i, row in zip(table.index, table.values, strict=True)]
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line).replace("\n", " ") + " |" for line in lines)


def markdown_rows(rows: dict, name: str = "") -> str:
    """Return {row: {column: cell}} as markdown."""
    return markdown(pd.DataFrame.from_dict(rows, orient="index").rename_axis(name))


def write_page(name: str, title: str, command: str, parts: Sequence[str]) -> None:
    """Write benchmarks/results/<name>.md: title, provenance and paragraphs."""
    script = f"benchmarks/{Path(sys.argv[0]).name}"
    text = [f"# {title}", f"Written by `{script}`. {stamp(command)}", *parts]
    (RESULTS / f"{name}.md").write_text("\n\n".join(text) + "\n")
    print(f"written: benchmarks/results/{name}.md")


def put_section(page: Path, heading: str, parts: Sequence[str]) -> None:
    """Replace a section of a page, up to the next of its level; append it if the page has no such section."""
    begin = f"## {heading}\n"
    before, _, after = page.read_text().partition(begin)
    rest = after[after.find("\n## ") :] if "\n## " in after else ""
    page.write_text(before.rstrip("\n") + "\n\n" + begin + "\n" + "\n\n".join(parts) + "\n" + rest)
    print(f"written: benchmarks/results/{page.name}, {heading}")


def put_table(page: Path, name: str, text: str) -> None:
    """Replace a table of a page between its markers, if the page has them."""
    begin, end = f"<!-- table: {name} -->\n", "<!-- end of the table -->\n"
    before, found, after = page.read_text().partition(begin)
    if found:
        page.write_text(before + begin + text + end + after.partition(end)[2])


__all__ = [
    "JUDGING",
    "MACHINE",
    "NEW",
    "OLD",
    "RESULTS",
    "ROBOT",
    "ROOT",
    "SENSOR_NOISE",
    "VARIANT_SEED",
    "SimulatedArm",
]
__all__ += ["conf", "default_task", "fourier", "identify_settings", "identify_twins", "load_training", "markdown"]
__all__ += ["markdown_rows", "poses_about", "put_section", "put_table", "ramp", "record", "replace", "run_parallel"]
__all__ += ["searches", "simulated_arm", "stamp", "twin_variant", "write_page"]
