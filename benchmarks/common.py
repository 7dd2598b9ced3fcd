"""What the benchmarks share: the Panda, its published and its true values, settings from conf/, runs, tables."""

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
import yaml

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
NUMBER = r"\d+(\.\d+)?"
PARTS = r"part=(events|quiet|warming|load)(,(events|quiet|warming|load))*"
WORDS: dict[str, tuple[str, ...]] = {  # that a script takes, each as a pattern; who is not here looks for itself
    **dict.fromkeys(("bench", "gallery"), ()),
    "adapters": (r"(root|task|episodes|policy|adapters|env_steps)=.+", r"\d_\d+"),
    "algorithms": ("trials",),
    "families": (r"\d+",),
    "faults": ("kills", "places", "files", "mutations", "page"),
    "known_truth": (r"\d+",),
    "grid": (r"\d+(,\d+)*", NUMBER),
    "least_squares": (NUMBER,),
    "payload": (PARTS, r"(root|keep)=.+", r"make=[12]", r"(motions|minutes)=[1-9]\d*", rf"[A-Z]+={NUMBER}", r"\d+"),
    "searches": (NUMBER,),
    "transfer": ("page", "twins", "noise", "ablation", "engines", "clients", "driver", r"\d+", r".*/.*"),
    "twins": (r"make=[12]", r"\d+"),
}


def check_words() -> None:
    """End the script that was started, with one line, where a word after its name is not one that it takes."""
    script = Path(sys.argv[0])
    if script.resolve().parent != ROOT / "benchmarks" or script.stem not in WORDS:
        return
    for word in sys.argv[1:]:
        if not any(re.fullmatch(pattern, word) for pattern in WORDS[script.stem]):
            allowed = ", ".join(WORDS[script.stem]) or "nothing"
            print(f"error: {script.name}: '{word}' is not allowed after its name; {allowed} is", file=sys.stderr)
            sys.exit(2)


def say(kind, error, trace) -> None:
    """Say in one line, as r2s does, that somebody pressed Ctrl-C."""
    if issubclass(kind, KeyboardInterrupt):
        print("\ninterrupted; what was written stays, and is not done again", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


check_words()
sys.excepthook = say

from hydra.utils import instantiate  # noqa: E402
from omegaconf import OmegaConf  # noqa: E402

from r2s.arm.ramp import poses_about, ramp  # noqa: E402
from r2s.arm.tracking import record  # noqa: E402
from r2s.excitation.fourier import fourier  # noqa: E402
from r2s.identification.settings import Settings  # noqa: E402
from r2s.physics.dynamics import nominal_dynamics  # noqa: E402
from r2s.physics.robot import OF_TASKS, load_robot  # noqa: E402
from r2s.provenance import cpu  # noqa: E402


def conf(path: str) -> dict:
    """Read one file of conf/: the arguments of what its `_target_` names, for the Panda."""
    document = yaml.safe_load((ROOT / "conf" / f"{path}.yaml").read_text())
    if path.startswith("task/"):
        panda = yaml.safe_load((ROOT / "conf/robot/panda.yaml").read_text())
        document = OmegaConf.to_container(OmegaConf.create({"robot": panda, "task": document}), resolve=True)["task"]
    beside = {"_target_", "defaults", *(OF_TASKS if path.startswith("robot/") else ())}
    return {k: v for k, v in document.items() if k not in beside}


MACHINE = f"{cpu()}, {os.cpu_count()} cores"
ROBOT = load_robot(**conf("robot/panda"))
OLD = nominal_dynamics(ROBOT, **conf("friction/gaz2019"))
NEW = nominal_dynamics(ROBOT, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
SETTINGS = conf("config")["identify"]
STEADY = ("algo.lr=1e-3", "algo.tau=0.01")  # of trainings of 5 minutes and more; conf/algo/tqc.yaml is for 2 to 5


def searches(name: str, **change) -> list:
    """Return the searches of conf/search/<name>.yaml; seeds are 0."""
    text = (ROOT / "conf" / "search" / f"{name}.yaml").read_text().replace("${seed}", "0")
    return [instantiate(s | {k: v for k, v in change.items() if k in s}) for s in yaml.safe_load(text)]


def how(torque: str = "commanded", **change) -> Settings:
    """Return the settings of `identify` as stage=identify gives them, but for the family."""
    own = {k: v for k, v in SETTINGS.items() if k != "validation_fraction"}
    return Settings(**own | {k: own[k][torque] for k in ("terms", "prior", "extra", "spare")} | change)


def side_by_side(jobs: Sequence[Sequence[str]]) -> None:
    """Run commands of one thread each, as many at once as this process may use cores."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    waiting, running = list(jobs), []
    while waiting or running:
        while waiting and len(running) < cores:
            command = [sys.executable, "run.py", *waiting.pop(0), "threads=1", "only_missing=true"]
            running.append(subprocess.Popen(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}))
        if (first := running.pop(0)).wait():
            sys.exit(f"failed: {' '.join(map(str, first.args))}")


def markdown(table: pd.DataFrame) -> str:
    """Return a table of strings as markdown, the index first."""
    head = [str(table.index.name or ""), *map(str, table.columns)]
    lines = [
        head,
        ["---"] * len(head),
        *([str(i), *map(str, row)] for i, row in zip(table.index, table.values, strict=True)),
    ]
    return "\n".join("| " + " | ".join(line).replace("\n", " ") + " |" for line in lines)


def put_section(page: Path, heading: str, parts: Sequence[str]) -> None:
    """Write a section of a page anew, up to the next of its level; at its end where there is none of that name."""
    begin = f"## {heading}\n"
    before, _, after = page.read_text().partition(begin)
    rest = after[after.find("\n## ") :] if "\n## " in after else ""
    page.write_text(before.rstrip("\n") + "\n\n" + begin + "\n" + "\n\n".join(parts) + "\n" + rest)


def put_table(page: Path, name: str, text: str) -> None:
    """Write what stands on a page between the markers of a table anew, where it has markers of that name."""
    begin, end = f"<!-- table: {name} -->\n", "<!-- end of the table -->\n"
    before, found, after = page.read_text().partition(begin)
    if found:
        page.write_text(before + begin + text + end + after.partition(end)[2])


__all__ = [
    "MACHINE",
    "NEW",
    "OLD",
    "ROBOT",
    "ROOT",
    "SETTINGS",
    "STEADY",
    "conf",
    "fourier",
    "how",
    "poses_about",
    "ramp",
]
__all__ += ["markdown", "put_section", "put_table", "record", "replace", "searches", "side_by_side"]
