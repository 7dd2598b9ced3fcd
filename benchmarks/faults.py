"""What a kill, a full disk, a folder that may not be written, a damaged file and nonsense cost: nothing, or one line.

`python benchmarks/faults.py` does all that follows and writes docs/reliability.md; one part alone with its name, such
as `python benchmarks/faults.py kills`, and what was done before is kept in runs/faults. `page` writes the page alone.

kills: 40 SIGKILLs at random times, then the same run again or on. places: disks, folders, clocks, two processes.
files: what a run folder holds, cut off. mutations: 2,000 of them (benchmarks/mutations.py). Seeds are in here.
"""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import torch
import yaml
from common import MACHINE, ROOT, markdown
from faulty import command, ended, forked, one_line, preload, say

SEED = 19
KEPT = ROOT / "runs" / "faults"
KILLS = {"train": 10, "tune": 6, "identify": 7, "transfer": 6, "compare": 6, "sweep": 5}
TOY = ["+experiment=toy", "threads=1"]
QUICK = [*TOY, "budget.env_steps=960", "evaluation.env_steps=320", "algo.learning_starts=160"]
QUICK += ["evaluation.episodes=2", "algo.batch_size=16", "algo.hidden=[16,16]"]
IDENTIFY = ["stage=identify", *TOY, "data=simulated", "data.seconds=2"]
CLOCK = ("wall_clock_s", "seconds")


def words_of(stage: str, root: Path, name: str) -> list[str]:
    """Return the command of a stage, at toy size."""
    head = [f"root={root}", f"name={name}"]
    if stage == "train":
        return [*QUICK, *head]
    if stage == "identify":
        return [*IDENTIFY, *head]
    if stage == "transfer":
        return ["stage=transfer", f"policy={root}/train/reference", "evaluation.episodes=1", *TOY, *head]
    if stage == "compare":
        return ["stage=compare", f"runs={root}/train/reference*", *head]
    if stage == "sweep":
        return ["-m", *QUICK, f"root={root}", f"name={name}s_${{seed}}", "only_missing=true", "seed=0,1"]
    space = "tune.space={algo: [td3], algo.lr: [2e-4, 1e-3], algo.batch_size: [16], algo.gamma: [0.95]}"
    own = ["tune.trials=2", "tune.workers=1", "tune.startup=1", space]
    typed = [w.replace("+experiment=toy", "+experiment=[tune,toy]") for w in QUICK if "batch_size" not in w]
    return [*typed, *head, *own]


def results(folder: Path) -> dict:
    """Return what a run found, without its clock and its place."""
    out = {}
    for name in ("evaluations.csv", "metrics.csv", "last.csv", "scores.csv"):
        if (folder / name).is_file():
            table = pd.read_csv(folder / name)
            out[name] = table.drop(columns=[c for c in CLOCK if c in table]).to_csv()

    def timeless(node):
        if isinstance(node, dict):
            return {k: timeless(v) for k, v in node.items() if k not in CLOCK}
        return [timeless(v) for v in node] if isinstance(node, list) else node

    out["summary"] = timeless(json.loads((folder / "summary.json").read_text()))
    if (folder / "policy.pt").is_file():
        state = torch.load(folder / "policy.pt", weights_only=True)["state"]
        out["policy"] = {k: v.numpy().tobytes() for k, v in state.items()}
    if (folder / "parameters.yaml").is_file() and folder.parent.name == "identify":
        document = yaml.safe_load((folder / "parameters.yaml").read_text())
        del document["source"]
        with np.load(folder / "posterior.npz", allow_pickle=False) as file:
            out["parameters"] = document, file["samples"].tobytes()
    return out


def half_written(root: Path) -> list[str]:
    """Return the files below `root` that do not load as what they are, in folders that say that they are done."""
    bad = []
    for meta in root.rglob("meta.json"):
        if json.loads(meta.read_text())["status"] != "done":
            continue
        for path in meta.parent.rglob("*"):
            try:
                if path.suffix == ".json":
                    json.loads(path.read_text())
                elif path.suffix == ".yaml":
                    yaml.safe_load(path.read_text())
                elif path.suffix == ".npz":
                    with np.load(path, allow_pickle=False) as file:
                        [file[k] for k in file.files]
                elif path.suffix == ".pt":
                    torch.load(path, weights_only=True)
                elif path.suffix == ".csv":
                    assert path.read_text().endswith("\n")
                elif ".part" in path.name:
                    raise ValueError("left over")
            except Exception as error:
                bad.append(f"{path}: {error}")
    return bad


def kills(root: Path, err: Path) -> None:
    """Kill commands at random times; then do what a person does: resume=, or the same command again."""
    log = KEPT / "kills.jsonl"
    done = Counter(json.loads(line)["stage"] for line in log.read_text().splitlines()) if log.is_file() else Counter()
    rng = np.random.default_rng(SEED)
    for stage, count in KILLS.items():
        name = "reference"
        needed = stage in ("train", "identify") and sys.argv[1:] != ["kills"]  # by the other parts
        if done[stage] >= count and not needed:
            continue
        folders = [root / "train" / f"{name}s_{k}" for k in (0, 1)] if stage == "sweep" else [root / stage / name]
        began = time.monotonic()
        status, text = say(words_of(stage, root, name), err)
        assert status == 0, text
        lasted, reference = time.monotonic() - began, [results(f) for f in folders]
        for k in range(count):
            share = rng.uniform(0.05, 0.98)
            everyone = bool(rng.integers(2))  # the whole group, or its first process alone
            if k < done[stage]:
                continue
            row = {"stage": stage, "number": k, "share": round(share, 3), "group": everyone}
            row |= killed(stage, root, f"k{stage}_{k}", share * lasted, everyone, reference, err)
            with open(log, "a") as file:
                file.write(json.dumps(row) + "\n")
            print(row, flush=True)


def killed(stage, root, name, after, everyone, reference, err) -> dict:
    """Kill one command after so many seconds, go on, and return what came of it."""
    words = words_of(stage, root, name)
    while True:  # an end before the kill is none
        pid = forked(command(words), err)
        time.sleep(after)
        if os.waitpid(pid, os.WNOHANG)[0]:
            after *= 0.7
            for path in root.glob(f"*/{name}*"):
                shutil.rmtree(path, ignore_errors=True)
            continue
        (os.killpg if everyone else os.kill)(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        break
    folder = root / stage / name
    marks = {f: json.loads((f / "meta.json").read_text())["status"] for f in root.glob(f"*/{name}*")}
    row = {"after_s": round(after, 1), "marked": sorted(set(marks.values())) or ["not begun"]}
    row["marked done"] = sum(s == "done" for s in marks.values())
    kept = root / "train" / name / "checkpoints" / "state.pt"
    row["from"] = torch.load(kept, weights_only=True)["env_steps"] if kept.is_file() else 0
    resumes = stage in ("train", "identify", "tune") and folder in marks and marks[folder] != "done"
    for _ in range(60):  # a worker of a sweep whose parent died ends its job first
        status, text = say([f"resume={folder}"] if resumes else words, err)
        if "is still at it" not in text:
            break
        time.sleep(2.0)
    row |= {"way": "resume" if resumes else "repeated", "status": status, "said": one_line(text) or text[-300:]}
    if status:
        return row | {"same": False}
    row["said"] = ""
    if stage == "tune":
        trials = pd.read_csv(folder / "trials.csv") if resumes else None
        path = folder if resumes else max(root.glob(f"tune/{name}*"), key=os.path.getmtime)
        trials = pd.read_csv(path / "trials.csv")
        same = len(trials) == 2 and trials["state"].isin(["complete", "pruned"]).all()
        twice = [f for f in root.glob(f"train/{name}*") if f.name.count("_") > 2]
        return row | {"same": bool(same and not twice), "half": half_written(root)}
    if stage == "sweep":
        folders = [root / "train" / f"{name}s_{k}" for k in (0, 1)]
        twice = len(list((root / "train").glob(f"{name}*"))) - 2
        return row | {"same": [results(f) for f in folders] == reference and not twice, "half": half_written(root)}
    again = folder if resumes else max((root / stage).glob(f"{name}*"), key=os.path.getmtime)
    return row | {"same": [results(again)] == reference, "half": half_written(root)}


def limited(size: int) -> Callable[[], None]:
    """Return what lets this process write no file larger than so many bytes: a disk that is full, for each file."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def jumping() -> None:
    """Let the clock of the wall jump, an hour back and then on, between any two questions."""
    real, state = time.time, {"k": 0}

    def jumped() -> float:
        state["k"] += 1
        return real() + (-3600.0 if state["k"] % 2 else 3600.0)

    time.time = jumped


def places(root: Path, err: Path) -> None:
    """Do what can go wrong with the places that are written to, and note what was said."""
    rows, reference = [], results(root / "train" / "reference")

    def note(fault: str, status: int, text: str, whole: bool, wanted: int = 2) -> None:
        line = one_line(text)
        good = status == wanted and (line is not None or wanted == 0) and whole
        rows.append({"fault": fault, "status": status, "said": line or "", "good": bool(good)})
        print(rows[-1], "" if good else text[-1500:], flush=True)

    def settled(name: str) -> bool:
        """Return whether a run that was refused room is marked and, gone on with, ends as the reference."""
        folder = root / "train" / name
        if not folder.exists():
            return True
        status, _ = say([f"resume={folder}"], err)
        return status == 0 and results(folder) == reference

    for size in (200, 3_000, 20_000, 60_000):
        name = f"limit_{size}"
        status, text = say(words_of("train", root, name), err, before=limited(size))
        note(f"training: no file larger than {size} bytes", status, text, settled(name))
    status, text = say(words_of("identify", root, "limit"), err, before=limited(40_000))
    folder = root / "identify" / "limit"
    whole = not folder.exists() or (say([f"resume={folder}"], err)[0] == 0)
    whole = whole and results(folder) == results(root / "identify" / "reference")
    note("identification: no file larger than 40,000 bytes", status, text, whole)
    tmpfs(note)
    blocked = root / "blocked"
    blocked.write_text("a file")
    for place, what in ((blocked, "a file where the folder belongs"), (Path("/proc/nowhere"), "a read-only folder")):
        status, text = say([*QUICK, f"root={place}", "name=a"], err)
        note(f"root={what}", status, text, blocked.read_text() == "a file")
    if os.getuid() == 0:
        as_nobody(root, err, note)
    status, text = say(words_of("train", root, "clock"), err, before=jumping)
    same = status == 0 and results(root / "train" / "clock") == reference
    seconds = json.loads((root / "train" / "clock" / "meta.json").read_text())["wall_clock_s"] if same else -1
    note("training: the clock jumps an hour back and on", status, text, same and 0 < seconds < 600, wanted=0)
    two_at_once(root, err, note, reference)
    lost_worker(root, err, note, reference)
    (KEPT / "places.json").write_text(json.dumps(rows, indent=1))


def tmpfs(note) -> None:
    """Fill a small disk up while a training writes to it."""
    with tempfile.TemporaryDirectory() as at:
        mount = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", at]
        if subprocess.run(mount, capture_output=True).returncode:
            return
        try:
            err = KEPT / "err.txt"
            status, text = say([*QUICK, f"root={at}/runs", "name=a"], err)
            meta = json.loads(next(Path(at).rglob("meta.json")).read_text())
            note("training: a disk of 300 kB", status, text, meta["status"] in ("failed", "running"))
        finally:
            subprocess.run(["umount", at], check=True)


def as_nobody(root: Path, err: Path, note) -> None:
    """Go on in the folder of somebody else, without his rights."""
    folder = root / "train" / "owned"
    shutil.copytree(root / "train" / "reference", folder)
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | {"status": "stopped"}))
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    err.chmod(0o666)

    from numba import config

    compiled = Path(tempfile.mkdtemp())
    compiled.chmod(0o777)

    def nobody() -> None:
        config.CACHE_DIR = str(compiled)  # his own home is none
        os.setgid(65534)
        os.setuid(65534)

    for where, words in (("resume=", [f"resume={folder}"]), ("root=", [*QUICK, f"root={root}", "name=mine"])):
        status, text = say(words, err, before=nobody)
        whole = before == {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        note(f"{where} a folder of another user", status, text, whole and not (root / "train" / "mine").exists())


def lost_worker(root: Path, err: Path, note, reference: dict) -> None:
    """Kill one of the two workers of a sweep side by side, as the system does where memory is short."""
    import psutil

    words = [*words_of("sweep", root, "worker"), "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    pid = forked(command(words), err)
    while not (begun := list((root / "train").glob("workers_*/metrics.csv"))):
        assert not os.waitpid(pid, os.WNOHANG)[0], "the sweep ended before a worker could be killed"
        time.sleep(0.05)
    worker = json.loads((begun[0].parent / "meta.json").read_text())["process"]["pid"]
    assert pid in [p.pid for p in psutil.Process(worker).parents()]
    os.kill(worker, signal.SIGKILL)
    status, text = ended(pid), err.read_text()
    again, _ = say(words, err)
    same = again == 0 and results(root / "train" / "workers_0") == reference
    note("a worker of a sweep is killed (joblib)", status, text, same and len(list(root.glob("train/worker*"))) == 2)


def two_at_once(root: Path, err: Path, note, reference: dict) -> None:
    """Begin and resume the same run folder from two processes at the same moment."""
    words = [*words_of("train", root, "two"), "only_missing=true"]
    errs = [KEPT / f"two_{k}.txt" for k in (0, 1)]
    for what in ("only_missing", "resume"):
        typed = words if what == "only_missing" else [f"resume={root / 'train' / 'two'}"]
        pids = [forked(command(typed), e) for e in errs]
        codes, texts = [ended(p) for p in pids], [e.read_text() for e in errs]
        folders = list((root / "train").glob("two*"))
        same = sorted(codes) == [0, 2] and len(folders) == 1 and results(folders[0]) == reference
        loser = codes.index(2) if 2 in codes else 0
        note(f"two processes, one run folder ({what})", codes[loser], texts[loser], same)
        if what == "only_missing":  # and now one that was killed in between
            shutil.rmtree(root / "train" / "two")
            pid = forked(command(words), err)
            while not (root / "train" / "two" / "checkpoints" / "state.pt").is_file():
                time.sleep(0.01)
            os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def files(root: Path, err: Path) -> None:
    """Cut off, empty and scramble each file that a later command reads; it says so, and touches nothing."""
    rng, rows = np.random.default_rng(SEED), []
    stopped = root / "train" / "cut"
    pid = forked(command(words_of("train", root, "cut")), err)
    while not len(list((stopped / "checkpoints").glob("replay*[0-9].pt"))) > 1:
        time.sleep(0.01)
    os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    halted = root / "identify" / "cut"
    pid = forked(command(words_of("identify", root, "cut")), err)
    while not list((halted / "checkpoints").glob("*[0-9].npz")):
        time.sleep(0.01)
    os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    trained, identified = root / "train" / "reference", root / "identify" / "reference"
    go_on, transfer = [f"resume={stopped}"], ["stage=transfer", f"policy={trained}", "arm=none", *TOY]
    calibrated = [*QUICK, f"calibration={identified}", f"root={root}", "name=calibrated"]
    readers = [(stopped / "checkpoints" / "state.pt", go_on)]
    readers += [(path, go_on) for path in sorted((stopped / "checkpoints").glob("replay*"))[:1]]
    readers += [(stopped / name, go_on) for name in ("config.yaml", "overrides.yaml", "meta.json")]
    readers += [(path, [f"resume={halted}"]) for path in sorted((halted / "checkpoints").glob("*.npz"))[:1]]
    readers += [(halted / "train.npz", [f"resume={halted}"])]
    readers += [(identified / "parameters.yaml", calibrated)]
    readers += [(identified / "posterior.npz", [*calibrated, "dr=identified"])]
    readers += [(trained / name, [*transfer, f"root={root}", "name=cut"]) for name in ("policy.pt", "config.yaml")]
    for path, words in readers:
        whole = path.read_bytes()
        damages = {"empty": b"", "scrambled": rng.bytes(len(whole))}
        damages["cut off"] = whole[: int(len(whole) * rng.uniform(0.1, 0.95))]
        damages["half"] = whole[: len(whole) // 2]
        for damage, content in damages.items():
            if path.name == "overrides.yaml" and damage == "empty":
                continue  # nothing typed is nothing wrong
            others = {p: p.read_bytes() for p in path.parent.rglob("*") if p.is_file() and p != path}
            folders = set(root.glob("*/*"))
            path.write_bytes(content)
            status, text = say(words, err)
            same = all(p.is_file() and p.read_bytes() == b for p, b in others.items() if p.name not in TOUCHED)
            row = {"file": path.relative_to(root).as_posix(), "damage": damage, "status": status}
            row |= {"said": one_line(text) or text[-400:], "kept": same, "new": len(set(root.glob("*/*")) - folders)}
            row["good"] = status == 2 and one_line(text) is not None and same and not row["new"]
            rows.append(row)
            path.write_bytes(whole)
            print(row, flush=True)
    for path, words, reference in ((stopped, go_on, trained), (halted, [f"resume={halted}"], identified)):
        status, text = say(words, err)
        good = status == 0 and results(path) == results(reference)
        rows.append({"file": f"{path.parent.name}/cut, all mended", "damage": "none", "status": status, "good": good})
        rows[-1] |= {"said": "" if good else text[-300:], "kept": good, "new": 0}
        print(rows[-1], flush=True)
    (KEPT / "files.json").write_text(json.dumps(rows, indent=1))


TOUCHED = ("meta.json", "config.yaml")  # what a resumed run says of itself: that it began again, and failed


def main() -> None:
    """Do the parts that were asked for, and write the page."""
    asked = sys.argv[1:] or ["kills", "places", "files", "mutations", "page"]
    KEPT.mkdir(parents=True, exist_ok=True)
    err = KEPT / f"err_{os.getpid()}.txt"
    if set(asked) - {"page"}:
        preload()
    with tempfile.TemporaryDirectory() as at:
        root = Path(at) / "runs"
        if {"places", "files"} & set(asked) and "kills" not in asked:
            for stage in ("train", "identify"):
                status, text = say(words_of(stage, root, "reference"), err)
                assert status == 0, text
        for part in (kills, places, files):
            if part.__name__ in asked:
                part(root, err)
        if "mutations" in asked:
            from mutations import mutate

            (KEPT / "mutations.json").write_text(json.dumps(mutate(Path(at), err), indent=1))
    if "page" in asked:
        from reliability import page

        (ROOT / "docs" / "reliability.md").write_text(page(KEPT, MACHINE, markdown))
        print("written: docs/reliability.md")


if __name__ == "__main__":
    main()
