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
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import contact_faults
import numpy as np
import pandas as pd
from common import NEW, RESULTS, ROBOT, ROOT, SimulatedArm, markdown, put_section, stamp, write_page

sys.path.insert(0, str(ROOT / "tests"))

from robot_side import (
    ABORTED,
    CYCLE,
    ENDED,
    MISSED,
    SIGNALLED,
    STRAY,
    TASK,
    Kill,
    Log,
    Motion,
    RobotSide,
    run_side,
    warm,
)

from r2s.arm.clients.fr3 import within_fr3
from r2s.arm.command_loop import REST_S, STILL
from r2s.arm.driver import DAMP_S, DEADLINE_S
from r2s.arm.emulator.control import MAX_MISSED, Fault
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.twins.make_twin import make_twin
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import SIM_DT

FORK = multiprocessing.get_context("fork")
FAULTS = ROOT / "runs" / "safety_campaign"
BRAKED_S = 0.05  # from the cause to the begin of braking
LAG = 12  # cycles in which a braked arm may become faster: its delay of 2 to 5 ms, lag of 3 ms and speed filter
REST = 0.06  # rad/s at the last command: SLIDING of `CommandLoop.rest`, and noise
PATIENT = 400  # missed answers that stop a robot in real time: no real-time kernel runs the client here
LONGEST_S = 40.0  # of a fault
ATTEMPTS, EARLY = 4, "the motion ended before its fault"
THEN = 400  # cycles after a harmless fault: SIGTERM
SIGNALS = ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP")
MOTIONS = ("approach", "episode", "record", "ramp")
CYCLES = {"approach": (50, 1200), "episode": (50, 900), "record": (50, 1000), "ramp": (50, 700)}  # of the cause
SILENT = r"no finite action for 50 ms"
COMMUNICATION = "communication_constraints_violation"
BUTTON = r"User Stop|user stop|emergency"
KINDS = {  # kind: motions in which it happens
    "signal": MOTIONS,
    "two signals": MOTIONS,
    "policy killed": ("approach", "episode"),
    "arm's process killed": MOTIONS,
    "policy stalls": ("episode",),
    "policy frozen": ("episode",),
    "arm's process frozen": MOTIONS,
    "late answers": MOTIONS,
    "lost states": MOTIONS,
    "action not finite": ("episode",),
    "adapter not finite": ("episode",),
    "adapter raises": ("episode",),
    "wrong load": MOTIONS,
    "stop button": MOTIONS,
    "button released": MOTIONS,
    "held link": MOTIONS,
    "torque step": MOTIONS,
    "joint limit": MOTIONS,
}
CONTACT = tuple(kind for kind in KINDS if kind != "held link")  # twins hold no link
NETWORK = ("late answers", "lost states", "arm's process frozen")
EMULATED = {"late answers": "late", "lost states": "drop", "stop button": "estop", "button released": "press",
            "held link": "hold", "torque step": "discontinuity", "joint limit": "joint_limit"}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One fault. count: its cycles (packets, a released button), ms (a stall) or number of a signal.

    payload, declared: kg of the load and of what gravity compensation assumes.
    """

    number: int
    kind: str
    motion: str
    client: str
    twin: str
    realtime: bool
    live: bool
    cycle: int
    target: str
    count: int
    gap: int
    payload: float
    declared: float
    twin_seed: int
    stop: str = ""  # of `r2s.physics.push_limit.STOPS`; "": in free motion

    @property
    def step(self) -> int:
        """Step of the policy at which a fault of the policy or of its adapter comes."""
        return self.cycle // self.substeps

    @property
    def substeps(self) -> int:
        """Cycles of a step of the policy."""
        return contact_faults.press(self.stop).substeps if self.stop else TASK.substeps

    @property
    def harmless(self) -> bool:
        """Whether the motion must go on, or may."""
        if self.kind in NETWORK[:2]:
            return self.count < MAX_MISSED
        return self.kind in ("wrong load", "held link") or (self.kind == "policy stalls" and self.count < 60)


def draw(seed: int, number: int, contact: bool = False) -> Case:
    """Return fault `number` of a seed."""
    rng = np.random.default_rng([seed, number])
    kinds = list(CONTACT if contact else KINDS)
    kind = kinds[number % len(kinds)]
    motion = "episode" if contact else str(rng.choice(KINDS[kind]))
    realtime = bool(rng.random() < 0.25)
    if kind in ("policy stalls", "arm's process frozen"):
        realtime = True  # in lock-step the arm would wait
    own = motion in ("record", "ramp")  # no process of the arm
    cycles = contact_faults.CYCLES if contact else CYCLES[motion]
    live = not own and (realtime or kind.startswith("policy") or rng.random() < 0.5)
    counts: dict[str, Any] = {"late answers": (1, 31), "lost states": (1, 31), "policy stalls": (20, 400)}
    counts |= {"button released": (5, 300), "held link": (100, 350), "action not finite": (0, 4)}
    count = int(rng.integers(*counts.get(kind, (0, len(SIGNALS)))))
    if realtime and kind in NETWORK and 12 < count < MAX_MISSED:
        count -= 10  # a busy machine loses some cycles more
    if kind == "policy stalls" and count < 60:
        count = 10  # well before the deadline
    wrong = kind == "wrong load"
    return Case(
        number=number, kind=kind, motion=motion, client=str(rng.choice(["panda", "fr3"])),
        twin="simulated" if kind == "held link" else str(rng.choice(["rigid", "elastic"])),
        realtime=realtime, live=live, cycle=int(rng.integers(*cycles)),
        target=str(rng.choice(["policy", "arm"])),
        count=count, gap=int(rng.integers(1, 100)),
        payload=float(rng.uniform(0.2, 1.5)) if wrong else 0.0,
        declared=float(rng.uniform(0.0, 1.5)) if wrong and rng.random() < 0.5 else 0.0,
        twin_seed=int(rng.integers(10)),
        stop=contact_faults.stop_of(number, len(kinds)) if contact else "",
    )  # fmt: skip


# --- the parts of a case


class Acts:
    """A policy that keeps the arm in motion, with the fault of a case; it notes the fault's time in `folder`."""

    def __init__(self, case: Case, folder: Path):
        self._case, self._folder = case, folder

    def __call__(self, k: int) -> np.ndarray:
        """Return the action of step k."""
        # from a turning point, so that the arm swings about its start and keeps clear of itself
        swing = 0.6 * (-1) ** self._case.number * np.cos(0.12 * k)
        action = swing * np.array([1, 0.5, -1, 0.5, 0.3, 1, 0.3])
        if self._case.stop:  # hybrid control presses; the action moves its target
            action = 0.3 * action[: contact_faults.press(self._case.stop).control(contact_faults.ARM).action_dim]
        if self._case.kind == "policy stalls" and k == self._case.step:
            note(self._folder)
            time.sleep(1e-3 * self._case.count)
        if self._case.kind == "action not finite" and k >= self._case.step:
            note(self._folder)
            action = np.where(
                np.arange(len(action)) <= 6 * (self._case.count % 2), (np.nan, np.inf)[self._case.count // 2], action
            )
        return action


class Adapts:
    """An adapter of the weight that compensation does not know, with the fault of a case."""

    def __init__(self, case: Case, folder: Path):
        self._case, self._folder, self._kinematics = case, folder, Kinematics(ROBOT)

    def __deepcopy__(self, memo: dict) -> "Adapts":
        """Return the copy that the warm-up runs: the fault belongs to the motion."""
        return Adapts(replace(self._case, kind="wrong load"), self._folder)

    def begin(self) -> None:
        """Begin a motion."""
        self._cycle = 0

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return (7,) Nm."""
        self._cycle += 1
        weight = 9.81 * (self._case.payload - self._case.declared)
        if self._case.kind.startswith("adapter") and self._cycle >= self._case.cycle:
            note(self._folder)
            if self._case.kind == "adapter raises":
                raise ZeroDivisionError("an adapter's own mistake")
            return np.full(7, np.nan)
        return weight * self._kinematics(q)[1][2]


def note(folder: Path) -> None:
    """Write the time of a fault, once."""
    with suppress(FileExistsError), open(folder / "fault", "x") as file:
        file.write(repr(time.monotonic()))


def arm_of(case: Case) -> Any:
    """Return the arm behind the emulator."""
    if case.twin == "simulated":
        return SimulatedArm(ROBOT, NEW, position_noise=2e-5, velocity_noise=3e-3)
    load = {"payload": case.payload, "declared_payload": case.declared or None}
    if case.stop:
        load |= {"surface": contact_faults.SURFACE}
    return make_twin(robot_of(case)[0], variant=case.twin, seed=case.twin_seed, **load)


def robot_of(case: Case) -> tuple[Any, dict[str, Any]]:
    """Return the robot of a case, and further settings of its motion."""
    return contact_faults.setting(case.stop, (case.twin_seed, case.number)) if case.stop else (ROBOT, {})


def kills_of(case: Case) -> tuple[Kill, ...]:
    """Return the signals that the robot sends."""
    first = getattr(signal, SIGNALS[case.count % len(SIGNALS)])
    if case.kind == "signal":
        return (Kill(0, case.cycle, case.target, first),)
    if case.kind == "two signals":
        second = getattr(signal, SIGNALS[case.gap % len(SIGNALS)])
        return Kill(0, case.cycle, case.target, first), Kill(0, case.cycle + case.gap, case.target, second)
    if case.kind in ("policy killed", "arm's process killed"):
        return (Kill(0, case.cycle, "policy" if case.kind == "policy killed" else "arm", signal.SIGKILL),)
    if case.kind in ("policy frozen", "arm's process frozen"):
        return (Kill(0, case.cycle, "policy" if case.kind == "policy frozen" else "arm", signal.SIGSTOP),)
    return (Kill(0, case.cycle + THEN, "policy", signal.SIGTERM),) if case.harmless else ()


def run_case(case: Case, folder: Path) -> bool:
    """Run a case; return whether every process ended by itself."""
    name = EMULATED.get(case.kind)
    faults = () if name is None else (Fault(name, case.cycle, cycles=max(1, case.count)),)
    if name in ("discontinuity", "joint_limit", "estop"):
        faults = (Fault(name, case.cycle),)
    patient = case.realtime and (case.harmless or case.kind not in (*NETWORK, "arm's process killed"))
    side = RobotSide(
        partial(arm_of, case), case.client, case.realtime, faults, kills_of(case), PATIENT if patient else MAX_MISSED
    )
    settings = {"adapter": Adapts(case, folder)} if case.motion == "episode" else {}
    own = {"far": 0.5, "loaded": case.kind == "wrong load", "wakes": case.kind.endswith("frozen")}
    robot, given = robot_of(case)
    own |= {"declared": case.declared or None, "realtime": case.realtime} | given
    motion = Motion(case.motion, case.live, Acts(case, folder), settings, **own)  # type: ignore[arg-type]
    return not run_side(side, robot, motion, folder, LONGEST_S)


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
