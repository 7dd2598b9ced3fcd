"""A faulty arm always ends stopped, after commands within its torque limits; see also test_fuzz.py."""

import contextlib
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_fuzz import PANDA, PAPER, TASK, examples

from r2s.arm.interface import ArmStopped, Reflexes
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.recorder import record
from r2s.arm.simulated import SimulatedArm
from r2s.errors import UserError
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.excitation.motion import Excitation
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.policy import make_policy
from r2s.physics.robot import SIM_DT
from r2s.tasks.rollout import rollout


class FaultyArm(SimulatedArm):
    """A simulated Panda that fails in given cycles, {cycle: fault}, and records the commands of its motion."""

    def __init__(self, faults):
        self.faults, self.commands, self.stopped = {}, [], True
        super().__init__(PANDA, replace(PAPER, delay=4e-3, lag=1e-3), position_noise=2e-5, velocity_noise=3e-3)
        self.faults = faults

    def move_to(self, q):
        """Begin a motion."""
        self.stopped, self.commands, self.last = False, [], None
        return super().move_to(q)

    def read(self):
        """Return the state, wrong if a sensor fails in this cycle."""
        state = super().read()
        fault = self.faults.get(self._cycle)
        if fault == "frozen" and self.last is not None:
            return self.last
        change = {"nan q": {"q": np.full(7, np.nan)}, "inf dq": {"dq": np.full(7, np.inf)}}
        change |= {"jump q": {"q": state.q + 1.0}, "jump dq": {"dq": state.dq + 5.0}}
        self.last = replace(state, **change.get(fault, {}))
        return self.last

    def command(self, tau):
        """Take a command, or end the motion by a reflex of its own."""
        assert not self.stopped, "a command after the stop"
        self.commands.append(np.array(tau))
        if self.faults.get(self._cycle) == "reflex":
            raise ArmStopped("a reflex of the arm")
        super().command(tau)

    def stop(self):
        """End the motion."""
        self.stopped = True
        super().stop()


FAULTS = st.dictionaries(
    st.integers(0, 380), st.sampled_from(["nan q", "inf dq", "jump q", "jump dq", "frozen", "reflex"]), max_size=3
)


@pytest.mark.long
@examples(6)
@given(faults=FAULTS, spoil_from=st.integers(0, 20), acts=st.booleans())
def test_a_faulty_arm_ends_stopped_and_within_its_torque_limits(faults, spoil_from, acts):
    """Failing sensors, reflexes and a policy that returns NaN: every command is finite and within range and rate."""
    arm = FaultyArm(faults)
    t = SIM_DT * np.arange(401)
    end = PANDA.q_home + 0.05 * np.array([1.0, 0.3, 0.2, 0.3, 0.2, 0.3, 0.4])
    with contextlib.suppress(ArmStopped, UserError):  # a UserError names readings that are not finite
        record(arm, Excitation(t, *minimum_jerk(PANDA.q_home, end, 0.4, t[:, None])))
    check_ended(arm)

    task, steps = replace(TASK, episode_s=0.4), iter(range(1000))
    policy = make_policy(PANDA, task, (8,))

    class Spoilt:
        """The policy until step `spoil_from`, then NaN."""

        def __getattr__(self, name):
            return getattr(policy, name)

        def action(self, *args):
            action = policy.action(*args)
            return action if acts or next(steps) < spoil_from else torch.full_like(action, math.nan)

    runner = PolicyRunner(arm, task, PAPER.level)
    rollout(Spoilt(), runner, task, *fixed_episodes(PANDA, task, 1))
    check_ended(arm)


def check_ended(arm: FaultyArm) -> None:
    """Fail unless the arm is stopped and would have taken each command after the one before."""
    assert arm.stopped
    commands = np.array([np.zeros(7), *arm.commands])
    assert np.isfinite(commands).all()
    assert Reflexes(PANDA).accepts(commands[1:], commands[:-1]).all()
