"""The faults of `safety_campaign.py`: how they are drawn, and how one runs against the emulated control box."""

import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import contact_faults
import numpy as np
from common import NEW, ROBOT, ROOT, SimulatedArm

sys.path.insert(0, str(ROOT / "tests"))

from robot_side import TASK, Kill, Motion, RobotSide, run_side

from r2s.arm.emulator.control import MAX_MISSED, Fault
from r2s.arm.twins.make_twin import make_twin
from r2s.physics.rigid_body import Kinematics

PATIENT = 400  # missed answers that stop a robot in real time: no real-time kernel runs the client here
LONGEST_S = 40.0  # of a fault
THEN = 400  # cycles after a harmless fault: SIGTERM
SIGNALS = ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP")
MOTIONS = ("approach", "episode", "record", "ramp")
CYCLES = {"approach": (50, 1200), "episode": (50, 900), "record": (50, 1000), "ramp": (50, 700)}  # of the cause
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
