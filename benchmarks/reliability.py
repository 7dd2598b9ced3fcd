# ruff: noqa: E501 (rows of tables)
"""docs/reliability.md from what benchmarks/faults.py saw."""

import json
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pandas as pd

HEAD = """# What faults cost

Written by `python benchmarks/faults.py` on {machine}. Every run was at toy size: what is tried is the bookkeeping, and
that is the same at any size. Seeds: {seed} of kills and damages, {seeds} of mutations."""

RULES = """## What holds

- A run folder appears whole: its config, what was typed and its status come before its name.
- A run folder belongs to one process at a time. The lock is the system's, and ends with the process.
- A file takes its name once it is whole. A name that was whole before stays so until then.
- `resume=RUN_FOLDER` goes on with `identify`, `train` and `tune`; `only_missing=true` with a sweep. `transfer`,
  `compare` and `pipeline` are repeated: a new folder, and the old one says `running`, without a process.
- What cannot be read, or has no room, is one line and exit status 2. A job of a sweep leaves the others alone.
- Nothing that is read runs: no pickle is loaded (`weights_only=True`, `allow_pickle=False`; a test reads the source).
- What listens, listens on loopback (a test reads the source)."""

MENDED = """## What was found and mended

| found | by | mended in |
|---|---|---|
| killed after its last checkpoint, a training evaluated the end a second time | kill 11 of train | r2s/runs.py: `rewind` keeps one row at the checkpoint's step |
| killed between two steps of making a folder, a sweep left a folder without status and did that job beside it, in `name_2` | reading, kills | r2s/runs.py: a folder gets its name last |
| two processes could begin or resume the same folder, and with only_missing do a job twice | reading, tests/test_faults.py | r2s/runs.py: a lock; only_missing takes no number |
| after a restart of the machine another program had the process id: `is still at it`, for ever | reading | r2s/runs.py: the lock says so, not the number |
| `rewind` took a table away before it was written again; a row that was cut off was read as one | reading | r2s/runs.py |
| policy.pt, policy.onnx, parameters.yaml, posterior.npz, config.yaml and kept calibrations were written in place: a kill could cut off what was whole | reading | r2s/learning/policy.py, r2s/identification/parameter_file.py, r2s/runs.py, r2s/stages/train.py: `whole` |
| posterior.npz came after parameters.yaml, which says that both are there | reading | r2s/identification/parameter_file.py |
| a full disk, or a folder that may not be written, was a traceback, and torch said it in its own words | reading, places | r2s/cli.py, r2s/learning/checkpoint.py |
| damaged checkpoints, policies, meta.json, summary.json, config.yaml and overrides.yaml were tracebacks | mutations, tests/test_faults.py | r2s/learning/checkpoint.py, r2s/runs.py, r2s/stages/build.py, r2s/cli.py |
| a jump of the clock made wall_clock_s of meta.json negative | reading | r2s/runs.py: a monotonic clock |
| a worker that the system ended took a sweep down with a traceback | reading | r2s/cli.py: one line; only_missing goes on (not tried yet) |
| `name=5`, `root=null`, `root=5` and names of 300 letters were tracebacks; `name=..` made a folder `.._2` | mutations | r2s/cli.py, r2s/runs.py |
| `${nowhere}` in a value was a traceback | mutations | r2s/cli.py |
| `friction.dq_min=[]` was a traceback, `inf` was taken | mutations | r2s/physics/dynamics.py |
| a config whose group is a number, or lacks a key | mutations | r2s/stages/build.py |
| a single row with 1e12 Nm, or a jump of a joint through radians in a millisecond, was taken | mutations | r2s/identification/checks.py |
| an evaluations.csv with a number that is none, or without a column | mutations | r2s/reporting/trainings.py |
| numbers in parameters.yaml that no arm has: a link without mass, friction that gives energy, a delay of days | mutations | r2s/identification/parameter_file.py |
| a trial of tune was told as failed: its training, left running by the killed tune, was faster to take the folder than the one that went on | kills | r2s/stages/tune.py: it waits |
| a disk that fills up within a tensor: torch says `iostream error`, a traceback | places | r2s/learning/checkpoint.py |
| a posterior.npz with a damaged stream | mutations | r2s/identification/parameter_file.py |
| the same disk told in other words of torch (`inline_container.cc`), a traceback | places | r2s/learning/checkpoint.py |
| an identification that was killed right after its first search on torque ended with other values: that search leaves weights, which a remembered one did not | files | r2s/identification/identify.py: a remembered search weighs as it did |
| `stage=true`, `stage=-1`, `stage=null`, `stage=[]`, and so of every group: Hydra's traceback (11 of 16 that ended badly) | mutations | r2s/cli.py: an option of a group is a word |
| a word of Hydra's own parser (`-,`): six lines | mutations | r2s/cli.py |
| `friction.family=..` was a traceback | mutations | r2s/physics/friction.py |
| `algo.lr=1e-320` and `identify.cutoff_hz=1e308` were taken | mutations | r2s/learning/learner.py, r2s/identification/settings.py |
| `+experiment=toy algo=oracle algo.batch_size=nan` was taken: nothing reads it | mutations | r2s/stages/build.py: what only a training reads is refused for a controller |
| `algo=oracle algo.move_s=nan` left a failed folder | reading | r2s/learning/computed_torque.py |
| a user who may write neither r2s's folder nor a home: numba's traceback | places | r2s/cli.py: one line, which names NUMBA_CACHE_DIR |
| a training whose policy never reached a goal was told as unreadable: `stage=compare` left it out, and a tune that was compared with such a grid failed at its end | tests/test_tune.py | r2s/reporting/trainings.py: null is no number, and no damage |
| `tune.against=5`, and a glob that finds nothing, were told after the last trial | reading | r2s/stages/tune.py: before the first |
| `r2s look --web`, ended by SIGTERM or by SIGINT to it alone, left the viewer's server behind | tests/test_look.py | r2s/reporting/look.py: a session of its own, which ends with the command |
| `pipeline.train_minutes=-1` was told after the arm was identified, 0 was taken for null | typing | r2s/stages/pipeline.py |
| Ctrl-C before a run had begun: a traceback | typing | r2s/cli.py, run.py |
| `robot.torque_fraction` of nan, '', -1, 1e400, 1e-320 was taken, null with `task=track` never ended (7 of the 14 of the second 600) | mutations | r2s/stages/build.py |
| `task.episode_s=1e308` and `friction.phi1=true` were taken | mutations | r2s/tasks/reach.py, r2s/tasks/track.py, r2s/physics/robot.py |
| `+experiment=tune algo.tau=nan`, and what else only a training refuses, left a folder of the search and ended at its first trial (5 of those 14); an axis with a value that is none was told when a trial drew it | mutations | r2s/stages/tune.py: every value and both ends of every axis are composed and made as a training would make them, before the folder; so does stage=pipeline its identification and its training |
| `+experiment=tune algo.gamma=5` was taken, and the axis of that name over it | typing | r2s/stages/tune.py: refused |
| `+experiment=paper_grid` without `-m` began one training of an hour | typing | r2s/cli.py: refused, with the command that was meant |
| `r2s list --faild`: argparse's two lines, without the nearest option; `r2s lst` named no command | typing | r2s/commands.py, r2s/cli.py |
| an arm's address where nothing answers: libfranka waits a minute | typing | r2s/arm/franka.py: at most 6 s |
| `arm.realtime=ture` was taken, as true | typing | r2s/cli.py: what is true or false by its config is true or false |
| killed after its last evaluation, a training chose and told its best evaluation by the seven digits of the table, an uninterrupted one by all | kills of a sweep | r2s/runs.py: `log` returns the row as it is kept, and both choose by that |
| a benchmark took words that it does not know, and Ctrl-C was a traceback | typing | benchmarks/common.py |
| `--config-dir my_cnf`, which is no folder: three lines, of which none said so | typing | r2s/cli.py |
| `data.seconds=1` was told once the run folder was there | typing | r2s/stages/identify.py |
| `r2s export` of no run was told as a wrong `policy` | typing | r2s/commands.py |
| of two trainings that held one folder, of which a killed tune had left one running, the other's progress was read as how the new one ended: its trial was told as failed. What the one bad kill of 12 showed fits that; it was not seen happening there | reading, tests/test_tune.py | r2s/stages/tune.py: what a training says goes to a file without a name |
| a recording with a single speed of 1e308 rad/s: `matrix contains invalid numeric entries`, a traceback | mutations | r2s/identification/checks.py: rows that no arm can have, by whatever unit, are told before units are guessed |
| an .npz whose header lost a bracket: Python's tokenizer's traceback | mutations | r2s/files.py, r2s/recordings/readers.py |
| an overrides.yaml cut off between two lines was taken | damaged files | r2s/runs.py, r2s/cli.py: meta.json says how many words were typed |
| `-m hydra/launcher=jobib` said `error: None`; other options of Hydra's own were several lines | typing | r2s/cli.py: they are checked as all others are |
| this benchmark waited for ever for a worker whose folder had another name | places | benchmarks/faults.py |"""

PINS = """## The pins

`constraints.txt` pins every package that r2s and its extras need, and what those need; a test follows the
requirements. `pip-audit -r constraints.txt --no-deps --disable-pip` asks the databases of PyPI and OSV about them.
It was tried where this page was made and reached neither: no network. So the pins were not compared with a database
of known faults here; do so before an installation that others can reach."""

NOT = """## How this page came together

All parts of this page are of one script and one day; five mends, the last rows above, came in between:

- The 40 kills ran first, before them.
- Of the recordings 3 of 700 were tracebacks, and of the damaged files one was taken. After the mends the places, the
  damaged files and all 2,000 mutations ran again, with the same seeds: they are what the tables show.
- Earlier counts, of the code before other rows above: of 12 kills of tune one did not show two trials at their end, of
  23 of a sweep three did not equal the reference, of 1,200 command lines 30 ended badly.
- Ctrl-C, to the process group, 2 to 30 s into the first command of each page, and a wrong argument in each: pipeline
  (both tasks), identify of a twin, of the emulated Panda in real time and of a ur10e, training, tracking, transfer,
  watch, look, export; a sweep one by one, by joblib and by ray, the paper's grid, a tune. Each ended with status 130
  within 5.1 s, left no process behind, and showed no traceback; each wrong argument was one line but two, both mended:
  `arm.realtime=ture` and `hydra/launcher=jobib`.

## What was not tried

An arm's address that is silent on a real network (the test stands in for it). A disk that loses what was written when the power goes (nothing is synced by force), file systems of networks and their
locks, Windows and macOS, a killed pipeline's steps (they run to their end, and say so in their own folders), an arm
that is moving when its process is killed (docs/arms.md). A flipped bit in a digit that leaves a likely number is not
seen: files carry no checksums, but sha256 of inputs is in meta.json and a resumed run compares it."""


def page(kept: Path, machine: str, markdown: Callable[[pd.DataFrame], str]) -> str:
    """Return the page of what lies in `kept`."""
    from faults import SEED
    from mutated import SEEDS

    parts = [HEAD.format(machine=machine, seed=SEED, seeds=", ".join(str(s) for s in SEEDS.values())), RULES]
    if (kept / "kills.jsonl").is_file():
        parts += kills(pd.read_json(kept / "kills.jsonl", lines=True), markdown)
    for name, what in (("places", "Places"), ("files", "Damaged files")):
        if (kept / f"{name}.json").is_file():
            parts += listed(json.loads((kept / f"{name}.json").read_text()), what, markdown)
    if (kept / "mutations.json").is_file():
        parts += mutated(json.loads((kept / "mutations.json").read_text()), markdown)
    return "\n\n".join([*parts, MENDED, PINS, NOT]) + "\n"


def kills(rows: pd.DataFrame, markdown) -> list[str]:
    """Return the section of the kills."""
    table = {}
    for stage, own in rows.groupby("stage", sort=False):
        marks = Counter(mark for row in own["marked"] for mark in row)
        table[stage] = {
            "kills": len(own),
            "of the whole group": int(own["group"].sum()),
            "folders then": ", ".join(f"{k}: {n}" for k, n in marks.items()),
            "resumed": int((own["way"] == "resume").sum()),
            "repeated": int((own["way"] == "repeated").sum()),
            "ended as an uninterrupted run": f"{int(own['same'].sum())} of {len(own)}",
            "half-written files": int(own["half"].map(len).sum()),
        }
    text = (
        f"## {len(rows)} kills\n\nSIGKILL at a random share (0.05 to 0.98) of the time that the command takes; to its "
        "first process alone, or to all of its group. Then `resume=`, or the same command again. Compared with an "
        "uninterrupted run: every number of evaluations.csv, metrics.csv and summary.json but the clock, every bit of "
        "policy.pt, parameters.yaml and the draws of posterior.npz; of a sweep all jobs, and that none is there twice; "
        "of tune that every trial came to its end once."
    )
    return [text, markdown(pd.DataFrame.from_dict(table, orient="index").rename_axis("command"))]


def listed(rows: list[dict], what: str, markdown) -> list[str]:
    """Return a section with a row for each case."""
    good = sum(r["good"] for r in rows)
    table = pd.DataFrame(rows)
    if "fault" in table:
        table = table.set_index("fault")[["status", "said", "good"]]
        head = "One line where there is one to say, and afterwards the run goes on and ends as an uninterrupted one."
    else:
        table["file"] = table["file"] + ": " + table["damage"]
        table = table.set_index("file")[["status", "said", "good"]]
        head = "Each file that a later command reads, emptied, scrambled and cut off; all others stay as they were."
    table["said"] = table["said"].map(lambda s: short(s.removeprefix("error: ")))
    table["good"] = table["good"].map({True: "yes", False: "NO"})
    return [f"## {what}\n\n{head} {good} of {len(rows)} good.", markdown(table)]


def short(line: str) -> str:
    """Return a line without the places of this machine."""
    text = " ".join(re.sub(r"/tmp/[^\s\"']*/", "", line.replace("|", "/")).split())
    return text if len(text) < 150 else f"{text[:150]} ..."


def mutated(found: dict, markdown) -> list[str]:
    """Return the section of the mutations."""
    columns = {"refused": "refused in one line", "stands": "may stand", "nonsense": "nonsense taken"}
    columns |= {"traceback": "tracebacks"}
    table = {
        kind: {"tried": sum(ends.values())} | {words: ends.get(end, 0) for end, words in columns.items()}
        for kind, ends in found["counts"].items()
    }
    total = sum(row["tried"] for row in table.values())
    text = (
        f"## {total:,} mutations\n\nDrawn by hypothesis. Recordings (.csv, .npz, .parquet, .h5): bytes cut off, "
        "flipped, put in and zeroed, cells that are no numbers, other units, clocks, signs, joints and orders. Files "
        "of run folders: the same damages, and leaves of their YAML and JSON replaced or taken away. Command lines: "
        "options outside their range, letters changed, words that are none, places that are none. What is accepted is "
        "judged by what it holds: finite, in order, at speeds and torques that a joint has, a body that can be. "
        f"Files left half-written: {found['left']}."
    )
    return [text, markdown(pd.DataFrame.from_dict(table, orient="index").rename_axis("kind"))]
