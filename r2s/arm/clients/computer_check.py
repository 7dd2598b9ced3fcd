"""Check whether kernel, permissions and network let this computer command an arm in real time."""

import os
import resource
from pathlib import Path

import numpy as np

from r2s.arm.clients.connection_check import Finding
from r2s.physics.robot import SIM_DT

LOST_SHARE = 0.01  # largest allowed share of lost states; as for lost commands, which use the same cable
GAP_S = 0.02  # s, longest allowed time between two states: the arm stops after 20 cycles without an answer
REALTIME = Path("/sys/kernel/realtime")  # where libfranka looks for a real-time kernel
LIMITS = resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK


def computer_findings(realtime: bool) -> list[Finding]:
    """Check kernel and permissions; if `realtime`, forbid motion without a real-time kernel or without SCHED_FIFO."""
    kernel = REALTIME.is_file() and REALTIME.read_text().strip() == "1"
    fifo, (priority, _), (memory, _) = _may_use_fifo(), *map(resource.getrlimit, LIMITS)
    locked = "unlimited" if memory == resource.RLIM_INFINITY else f"{memory / 2**20:.0f} MiB"
    system = f"{'' if kernel else 'not '}real-time, {os.uname().release}"
    right = f"{'' if fifo else 'not '}allowed, rtprio {priority}"
    return [
        Finding("kernel", "real-time", system, realtime and not kernel),
        Finding("scheduler", "SCHED_FIFO allowed", right, realtime and not fifo),
        Finding("memory that may be locked (memlock)", "unlimited", locked),
    ]


def network_findings(arm: np.ndarray, here: np.ndarray) -> list[Finding]:
    """Check for lost or late states.

    arm, here: (k,) s, time of each state by the arm's clock and by the computer's clock.
    """
    if len(arm) < 2:
        return [Finding("states", "one per ms", f"{len(arm)} in all", True)]
    cycles, gaps = np.rint(np.diff(arm) / SIM_DT), np.diff(here)
    lost, share = int((cycles - 1).sum()), float(1 - len(cycles) / cycles.sum())
    period = f"median {1e3 * np.median(gaps):.2f} ms, 99.9 % within {1e3 * np.quantile(gaps, 0.999):.2f} ms"
    return [
        Finding("period of the states", "1 ms", period),
        Finding("longest gap", f"below {1e3 * GAP_S:g} ms", f"{1e3 * gaps.max():.1f} ms", bool(gaps.max() >= GAP_S)),
        Finding("lost states", f"at most {LOST_SHARE:.0%}", f"{lost} of {cycles.sum():.0f}", share > LOST_SHARE),
    ]


def _may_use_fifo() -> bool:
    """Return whether this process may use SCHED_FIFO at the highest priority; restore the previous scheduler."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(os.sched_get_priority_max(os.SCHED_FIFO)))
    except PermissionError:
        return False
    os.sched_setscheduler(0, *before)
    return True
