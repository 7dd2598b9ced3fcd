"""A thousand random faults of policy, processes, network, arm and load, judged by what the robot sees.

    python benchmarks/safety_campaign.py              1,000 faults, then benchmarks/results/safety_campaign.md
    python benchmarks/safety_campaign.py --first 17 --count 1       fault 17 again, its files are kept
    python benchmarks/safety_campaign.py --load       beside busy loops on all cores
    python benchmarks/safety_campaign.py --page       the page alone, from the results so far
    python benchmarks/safety_campaign.py --contact    the arm presses, and its stop holds, releases or retreats
                                                      (contact_faults.py, results/safety_campaign_contact.md)

Fault k of a seed is drawn from (seed, k). A robot (tests/robot_side.py: the emulated control box, which records its
cycles), the policy's process and the process of the arm run as on hardware, with the real client packages. They are
forked from a worker that has imported and compiled everything. A fault that must not stop the arm is followed by
SIGTERM 0.4 s later, which must. Results: runs/safety_campaign/seed_<seed>.jsonl, a line per fault.
"""

import argparse
import json
import multiprocessing
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import contact_faults
import numpy as np
import pandas as pd
from common import NEW, RESULTS, ROBOT, ROOT, markdown, put_section, stamp, write_page

sys.path.insert(0, str(ROOT / "tests"))

from robot_side import ABORTED, CYCLE, ENDED, MISSED, SIGNALLED, STRAY, Log, warm
from safety_faults import NETWORK, SIGNALS, Case, draw, run_case

from r2s.arm.clients.fr3 import within_fr3
from r2s.arm.command_loop import REST_S, STILL
from r2s.arm.driver import DAMP_S, DEADLINE_S
from r2s.arm.emulator.control import MAX_MISSED
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.twins.make_twin import make_twin
from r2s.physics.robot import SIM_DT

FORK = multiprocessing.get_context("fork")
FAULTS = ROOT / "runs" / "safety_campaign"
BRAKED_S = 0.05  # from the cause to the begin of braking
LAG = 12  # cycles in which a braked arm may become faster: its delay of 2 to 5 ms, lag of 3 ms and speed filter
REST = 0.06  # rad/s at the last command: SLIDING of `CommandLoop.rest`, and noise
ATTEMPTS, EARLY = 4, "the motion ended before its fault"
SILENT = r"no finite action for 50 ms"
COMMUNICATION = "communication_constraints_violation"
BUTTON = r"User Stop|user stop|emergency"


# --- the judge


def judge(case: Case, folder: Path, ended: bool) -> dict:
    """Return the measures of a case that ran in `folder`."""
    log = Log.read(folder)
    out: dict[str, Any] = asdict(case) | {"hung": not ended, "rows": len(log.kind), "cause": "", "wrong": ""}
    out |= {"over": over_rules(case, log), "after": 0, "braking_ms": None, "rest_ms": None, "speed": None}
    row = cause_row(case, log, folder)
    ends = np.flatnonzero(np.isin(log.kind, (ENDED, ABORTED)))
    out["cause"] = cause_in(folder)
    out["aborted"] = (folder / "aborted").read_text() if (folder / "aborted").exists() else ""
    if row is None or not len(ends) or ends[0] < row:
        return out | {"wrong": f"{EARLY}: {out['aborted']} {out['cause']}"}
    if case.kind not in ("torque step", "joint limit"):  # the cycle in which the arm found itself beyond a limit
        out["over"] += bool(re.search("position|velocity|commanded torque", out["aborted"]))
    end = int(ends[0])
    late = (CYCLE, STRAY) if log.kind[end] == ENDED else (CYCLE,)  # an answer may cross the arm's own stop
    out["after"] = int(np.isin(log.kind[end:], late).sum())
    now = log.between(row, end + 1)
    stalled = int((now.kind == MISSED).sum())
    cycles = now.cycles
    out["stalled"] = stalled
    if case.kind == "arm's process killed":
        out["rest_ms"] = int(log.cycle[end] - log.cycle[row])
        if len(cycles.cycle) or stalled > MAX_MISSED:
            out["wrong"] = f"{len(cycles.cycle)} commands after the death"
    elif log.kind[end] == ENDED and len(cycles.cycle):
        speed = np.abs(cycles.dq / ROBOT.dq_max).max(1)
        moves = np.abs(cycles.dq).max() > 2 * REST
        out["braking_ms"] = int(cycles.cycle[speed.argmax()] - cycles.cycle[0]) if moves else 0
        out["rest_ms"] = int(log.cycle[end] - cycles.cycle[0])
        out["speed"] = float(np.abs(cycles.dq[-1]).max())
    if case.stop:
        driven = bool(log.kind[end] == ENDED) and case.kind != "arm's process killed"
        out |= contact_faults.judge_force(case.stop, case.twin_seed, log, row, end, driven)
        out["over"] += out["over_force"]
        out["wrong"] = out["wrong"] or out["undecided"]
    return out | {"wrong": out["wrong"] or mistake(case, out, bool(log.kind[end] == ABORTED))}


def over_rules(case: Case, log: Log) -> int:
    """Return how many cycles broke a rule of the arm: torque, step, not finite, or a limit of a joint."""
    c, robot = log.cycles, ROBOT if case.client == "panda" else within_fr3(ROBOT)
    bad = ~np.isfinite(c.tau).all(1) | (np.abs(c.tau) > robot.tau_max).any(1)
    bad |= (np.abs(c.tau - c.last) > robot.dtau_max * SIM_DT).any(1)
    if case.kind != "torque step":
        bad |= (c.q < ROBOT.q_min).any(1) | (c.q > ROBOT.q_max).any(1) | (np.abs(c.dq) > ROBOT.dq_max).any(1)
    return int(bad.sum())


def cause_row(case: Case, log: Log, folder: Path) -> int | None:
    """Return the row of the fault; of a harmless one, of the SIGTERM that follows."""
    if (folder / "fault").exists() and not case.harmless:
        at = float((folder / "fault").read_text())
        rows = np.flatnonzero(log.time >= at)
    elif SIGNALLED in log.kind:
        rows = np.flatnonzero(log.kind == SIGNALLED)
    else:
        rows = np.flatnonzero((log.motion == 0) & (log.cycle >= case.cycle) & (log.kind != SIGNALLED))
    if not len(rows):
        rows = np.flatnonzero(log.kind == ABORTED)
    return int(rows[0]) if len(rows) else None


def cause_in(folder: Path) -> str:
    """Return the first cause that the policy's process reports: of stops.txt, else why the run ended."""
    with suppress(OSError):
        result = json.loads((folder / "result.json").read_text())
        return str((result["stops"] or [result["halted"] or result["error"]])[0])
    return ""


def expected(case: Case) -> str:
    """Return the pattern of the first cause."""
    by_kind = {
        **dict.fromkeys(NETWORK, COMMUNICATION), "policy stalls": SILENT, "policy frozen": SILENT,
        "action not finite": SILENT, "adapter not finite": SILENT, "adapter raises": "an adapter's own mistake",
        "stop button": BUTTON, "button released": BUTTON, "torque step": "controller_torque_discontinuity",
        "joint limit": "joint_position_limits_violation", "policy killed": "", "two signals": SIGNALS[case.count % 5],
        "signal": SIGNALS[case.count % 5],
        "arm's process killed": "the process that drove the arm has ended" if case.live else "^$",
    }  # fmt: skip
    if case.kind == "held link":
        return "joint_reflex|off its path|SIGTERM|cartesian_reflex"
    if case.kind == "wrong load":
        return "SIGTERM|joint_reflex|off its path"
    if case.kind == "policy stalls" and case.harmless:
        return f"SIGTERM|{SILENT}"  # a busy computer may stall the policy longer than the case does
    return "SIGTERM" if case.harmless else by_kind[case.kind]


def mistake(case: Case, out: dict, aborted: bool) -> str:
    """Return what was not as it must be, or ""."""
    reflexes = (*NETWORK, "stop button", "button released", "torque step", "joint limit")
    stops_itself = case.kind in reflexes and not case.harmless
    stops_itself |= case.kind in ("held link", "wrong load", "arm's process killed")
    if aborted and not stops_itself:
        return f"the arm stopped itself: {out['aborted']}"
    if not re.search(expected(case), out["cause"]):
        return f"first cause: {out['cause'] or 'none'}"
    if aborted or out["braking_ms"] is None:
        return ""
    stalled = out["stalled"]  # answers that a busy machine gave too late
    allowed = BRAKED_S / SIM_DT + LAG + stalled
    if case.kind in ("policy stalls", "action not finite", "adapter not finite", "policy frozen"):
        allowed += case.substeps  # the deadline counts from the last command
    if out["braking_ms"] > allowed and not case.stop and case.kind not in ("held link", "wrong load"):
        return f"braking after {out['braking_ms']} ms"
    latest = DEADLINE_S + DAMP_S + REST_S * (out["speed"] > STILL)  # a joint that friction does not hold slides
    if out["rest_ms"] > latest / SIM_DT + LAG + stalled:
        return f"rest after {out['rest_ms']} ms"
    return f"not damped: {out['speed']:.3f} rad/s" if out["speed"] > REST else ""


# --- the campaign


def work(seed: int, numbers: list[int], results: Path, keep: bool, contact: bool) -> None:
    """Run faults and append their results."""
    warm(ROBOT)
    if contact:
        warm_press()
    for number in numbers:
        case, began = draw(seed, number, contact), time.monotonic()
        for attempt in range(ATTEMPTS):
            folder = Path(tempfile.mkdtemp(prefix="fault_"))
            try:
                out = judge(case, folder, run_case(case, folder))
            except Exception:
                out = asdict(case) | {"wrong": traceback.format_exc(), "over": 0, "after": 0, "hung": True}
            out |= {"wall_s": round(time.monotonic() - began, 2), "attempt": attempt}
            if not keep:
                shutil.rmtree(folder, ignore_errors=True)
            if not ((case.realtime or case.live) and out["wrong"].startswith(EARLY)):
                break  # else the computer was too late before the fault: for real time, or with the policy's process
        with open(results, "a") as file:
            file.write(json.dumps(out) + "\n")
        if out["wrong"] or out["over"] or out["after"] or out["hung"] or keep:
            print(json.dumps(out), folder if keep else "", flush=True)


def warm_press() -> None:
    """Compile what presses."""
    task = contact_faults.press("release")
    goals = task.goals(contact_faults.ARM, np.random.default_rng(0), 1)
    for variant in ("rigid", "elastic"):
        twin = make_twin(contact_faults.ARM, variant=variant, surface=contact_faults.SURFACE)
        runner = PolicyRunner(twin, task, NEW.level)
        state = runner.place(task.begin(contact_faults.ARM.q_home[None], goals), 0)
        control = task.control(contact_faults.ARM)
        runner.step(control.command(np.zeros((1, control.action_dim)), task, state.t, goals))
        runner.end()


@contextmanager
def busy(loops: int) -> Iterator[None]:
    """Compute in as many processes."""
    processes = [FORK.Process(target=spin, daemon=True) for _ in range(loops)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.terminate()


def spin() -> None:
    """Compute for ever."""
    while True:
        pass


def page(rows: pd.DataFrame, seed: int, words: str, o: argparse.Namespace, repeated: int) -> None:
    """Write benchmarks/results/safety_campaign.md, or its section of faults beside a load; repeated: run again."""
    table = {}
    for (kind, motion), group in rows.groupby(["kind", "motion"], sort=False):
        wrong = group.wrong.fillna("").astype(bool) | group.hung
        table[f"{kind}, {motion}"] = {
            "faults": len(group), "over a rule": int(group.over.sum()), "commands after": int(group.after.sum()),
            "ms to braking": longest(group.braking_ms), "ms to rest": longest(group.rest_ms),
            "wrong": int(wrong.sum()),
        }  # fmt: skip
    frame = pd.DataFrame.from_dict(table, orient="index").rename_axis("fault, motion").sort_index()
    total = (
        f"{len(rows)} faults of seed {seed}, {int(rows.realtime.sum())} in real time, {repeated} run again: "
        f"{int(rows.over.sum())} cycles over a rule, {int(rows.after.sum())} commands after a stop, "
        f"{int(frame['wrong'].sum())} otherwise wrong."
    )
    wrong = [
        f"- {r.number}: {r.kind}, {r.motion}, {r.client}, {r.twin}: {r.wrong}" for r in rows.itertuples() if r.wrong
    ]
    parts = [markdown(frame.fillna("")), *(["\n".join(wrong)] if wrong else [])]
    name = "safety_campaign" + "_contact" * o.contact
    if o.contact:
        total += (
            f" Forces: at most {rows.share.max():.2f} of the bound of docs/explanation/safety.md, "
            f"{int(rows.over_force.sum())} over it; "
            f"{int((rows.undecided.fillna('') != '').sum())} stops not as decided."
        )
    if o.load:
        page = RESULTS / f"{name}.md"
        put_section(page, "Beside busy loops on all cores", [stamp(words), total, *parts])
    else:
        write_page(
            name, "Safety campaign" + " in contact" * o.contact, words, [total, __doc__.split("\n\n")[2], HOW, *parts]
        )


HOW = """
Over a rule: torque, step of torque, not finite, position, speed. ms to braking: from the cause to the greatest speed
after it, of the emulated arm with its own delay (up to 12 ms). ms to rest: to the end of the motion. Both are the
longest of the row, in cycles of the robot; empty where the arm stops itself. Wrong: another first cause, an arm that
stopped itself, braking or rest too late, too fast at the end, or a process left. The motion ends within 0.55 s below
0.02 rad/s; with a joint that friction does not hold, or a wrong load, within 1.05 s below 0.06 rad/s. In real time
answers that this computer gives late count as missed and extend both times; 20 of them stop the arm only in faults of
network and arm's process. A motion that ended before its fault, because this computer was too late for real time or
for the policy's process, is run again.
""".strip()


def longest(values: pd.Series) -> str:
    """Return the largest of the numbers, or nothing."""
    known = values.dropna()
    return f"{known.max():.0f}" if len(known) else ""


def main() -> None:
    """Run the faults that have no result yet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("seed", 0), ("first", 0), ("count", 1000), ("workers", 2)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--contact", action="store_true", help="faults of an arm that presses")
    parser.add_argument("--load", action="store_true", help="busy loops on all cores beside")
    parser.add_argument("--page", action="store_true", help="write the page from the results so far")
    o = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # no process is left; the workers inherit it
    FAULTS.mkdir(parents=True, exist_ok=True)
    results = FAULTS / f"seed_{o.seed}{'_contact' * o.contact}{'_load' * o.load}.jsonl"
    known = read_results(results)
    numbers = [k for k in range(o.first, o.first + o.count) if o.count == 1 or k not in known]
    if not o.page:
        live = [k for k in numbers if draw(o.seed, k, o.contact).realtime]
        with busy((os.cpu_count() or 1) if o.load else 0):
            run_workers(o.workers, [k for k in numbers if k not in live], (o.seed, results, o.count == 1, o.contact))
            run_workers(1, live, (o.seed, results, o.count == 1, o.contact))  # real time needs two cores for itself
    if o.count > 1 or o.page:
        words = " ".join(["python", "benchmarks/safety_campaign.py", *(w for w in sys.argv[1:] if w != "--page")])
        rows = pd.DataFrame(sorted(read_results(results).values(), key=lambda r: r["number"]))
        repeated = len(results.read_text().splitlines()) - len(rows) + int(rows.attempt.sum())
        page(rows, o.seed, words, o, repeated)


def run_workers(count: int, numbers: list[int], settings: tuple[int, Path, bool, bool]) -> None:
    """Run faults in `count` processes; settings: seed, file of results, whether to keep a fault's files, contact."""
    seed, *others = settings
    parts = [numbers[i::count] for i in range(min(count, len(numbers)))]
    workers = [FORK.Process(target=work, args=(seed, part, *others)) for part in parts]
    try:
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    finally:
        for worker in workers:
            worker.terminate()


def read_results(path: Path) -> dict[int, dict]:
    """Return the latest result of each fault by its number."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {row["number"]: row for row in map(json.loads, lines)}


if __name__ == "__main__":
    main()
