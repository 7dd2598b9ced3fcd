"""Costs of a training: their values on a motion, their multipliers, and policies that keep the limits."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import conf
from test_press import PANDA, make_draw, make_task, resting

from r2s.errors import UserError
from r2s.learning.ddpg import DDPG
from r2s.learning.env import TaskEnv
from r2s.learning.sac import SAC
from r2s.learning.td3 import TD3
from r2s.learning.tqc import TQC
from r2s.physics.robot import load_robot
from r2s.physics.tip import Tip
from r2s.tasks.costs import COSTS, MARGIN_RAD, MOST, PATIENCE, ConstrainedReward
from r2s.tasks.reach import ReachTask
from r2s.tasks.rewards import Reward
from r2s.tasks.task import State

LIMITS = {"excess_force": 0.5, "impact_speed": 0.01, "limit_margin": 0.02}


def test_costs_have_their_units():
    """4 N beyond the force asked for, the tip's speed into what it touches, and a joint 0.03 rad from its limit."""
    task, rng = make_task(), np.random.default_rng(0)
    goals = task.goals(PANDA, rng, 3)
    q, dq = goals[:, 9:].copy(), rng.normal(size=(3, PANDA.n))
    q[2, 5] = PANDA.q_range[1][5] - 0.03
    normal = task.normals(goals)
    force = -(goals[:, 6] + [4.0, -1.0, 0.0])[:, None] * normal  # what the tool exerts is against the normal
    force[2] = 0.0
    state = resting(q, dq=dq, force=force)
    excess, speed, margin = (COSTS[name](PANDA, task, state, goals) for name in LIMITS)
    inwards = [-n @ Tip(PANDA)(at)[1] @ v for n, at, v in zip(normal, q, dq, strict=True)]
    np.testing.assert_allclose(excess, [4.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(speed, [max(inwards[0], 0.0), max(inwards[1], 0.0), 0.0], atol=1e-9)
    np.testing.assert_allclose(margin[2], MARGIN_RAD - 0.03)
    assert not margin[:2].any()


def test_a_joint_without_limits_has_a_margin_of_its_own():
    """A turn of a limitless joint costs nothing; beside its neighbour's limit, the neighbour's margin counts."""
    robot = load_robot(**conf("robot/kinova_gen3"))
    assert np.isinf(robot.q_max[0])
    q = np.tile(robot.q_home, (3, 1))
    q[0, 0], q[1, 0] = robot.q_home[0] + np.pi - 0.02, 7.0
    q[2, 1] = robot.q_max[1] - 0.03
    state = replace(State.at_home(robot), q=q)
    np.testing.assert_allclose(COSTS["limit_margin"](robot, None, state, q), [0.0, 0.0, MARGIN_RAD - 0.03])
    endless = replace(robot, q_min=np.full(robot.n, -np.inf), q_max=np.full(robot.n, np.inf))
    assert not COSTS["limit_margin"](endless, None, state, q).any()


def test_a_reward_is_charged_its_costs():
    """The environment's reward is the task's minus multiplier times cost over limit."""
    reward = ConstrainedReward(Reward(), PANDA, LIMITS)
    task = make_task()
    env, plain = (TaskEnv(PANDA, task, make_draw(), 4, nthread=1, reward=r) for r in (reward, Reward()))
    multipliers = np.array([2.0, 3.0, 0.5])
    env.weights = reward.weights(task, 0.0, np.array([1.0, *multipliers]))
    paid = [e.step(e.reset().set("action", torch.ones(4, e.control.action_dim)))["next"] for e in (env, plain)]
    costs = paid[0]["reward_terms"][:, -3:].numpy() / np.array(list(LIMITS.values()))
    charged, free = (p["reward"][:, 0].numpy() for p in paid)
    np.testing.assert_allclose(charged, free - costs @ multipliers, atol=1e-5)


@pytest.mark.parametrize(("light", "end"), [(3.0, np.log(3.0)), (0.5, 0.0), (1e9, MOST)])
def test_a_multiplier_settles_where_the_cost_is_at_its_limit(light, end):
    """For a policy that costs light exp(-multiplier) of the limit; a cost below it has no multiplier."""
    reward = ConstrainedReward(Reward(), PANDA, {"excess_force": 0.5})
    factor = reward.factor
    for _ in range(4000):
        seen = np.array([0.0, 0.5 * light * np.exp(-factor[1])])
        factor = reward.adapt(factor, 0.0, seen, PATIENCE // 40)
    assert factor[1] == pytest.approx(end if light < 1e9 else np.log(1e9), rel=1e-3, abs=1e-9)
    assert reward.adapt(np.array([1.0, MOST]), 0.0, np.array([0.0, 9.0]), PATIENCE)[1] == MOST


def test_rare_large_costs_count_by_their_mean():
    """One step in 50 costs 100 times the limit, the others nothing: as a constant cost of twice the limit."""
    reward = ConstrainedReward(Reward(), PANDA, {"excess_force": 0.5})
    rare = constant = np.array([1.0, 5.0])
    for step in range(500):
        rare = reward.adapt(rare, 0.0, np.array([0.0, 50.0 * (step % 50 == 0)]), PATIENCE // 1000)
        constant = reward.adapt(constant, 0.0, np.array([0.0, 1.0]), PATIENCE // 1000)
    np.testing.assert_allclose(rare, constant, rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("kind", [DDPG, TD3, SAC, TQC])
def test_a_constrained_policy_keeps_its_limit(kind):
    """A point x' = x + a/2 that wants to be at 1, and may be at 0.5 on average.

    With the multiplier m the best place is 1 - m / (2 d), at the limit d for m = 2 d (1 - d) = 0.5.
    """
    torch.manual_seed(0)
    change: dict = {"explore_std": 0.1} if kind in (DDPG, TD3) else {"target_entropy": -2.0}
    change |= {"hidden": (32, 32), "gamma": 0.5, "lr": 3e-3, "tau": 0.05}
    algo = kind((torch.zeros(1), torch.ones(1)), torch.ones(1), **change)
    reward = ConstrainedReward(Reward(), PANDA, {"limit_margin": 0.5})
    factor, kept, x = reward.factor, [], 2 * torch.rand(64, 1) - 1
    settled = []
    for step in range(900):
        if step % 12 == 0:
            x = 0.2 * torch.rand(64, 1) + 0.4
        a = algo.explore(x) if step >= 20 else 2 * torch.rand(64, 1) - 1
        after = x + 0.5 * a
        terms = torch.stack([-((after[:, 0] - 1) ** 2), after[:, 0]], 1)
        kept.append({"observation": x, "action": a, "next_observation": after, "terms": terms})
        x = after
        if step < 20:
            continue
        factor = reward.adapt(factor, 0.0, terms.mean(0).numpy(), PATIENCE // 100)
        if step % 20 == 0:
            replay = {k: torch.cat([row[k] for row in kept[-200:]]) for k in kept[0]}
        pick = torch.randint(len(replay["action"]), (128,))
        batch = {k: v[pick] for k, v in replay.items()}
        weights = torch.tensor([1.0, -factor[1] / 0.5], dtype=torch.float32)
        algo.update(batch | {"reward": batch["terms"] @ weights, "terminated": torch.zeros(128)})
        if step >= 600:
            settled.append((factor[1], float(terms[:, 1].mean())))
    multiplier, cost = np.mean(settled, axis=0)
    assert cost == pytest.approx(0.5, abs=0.05)
    assert multiplier == pytest.approx(0.5, abs=0.15)


def test_wrong_costs_are_one_line():
    with pytest.raises(UserError, match=r"^costs: force is not allowed; allowed: excess_force, impact_speed, lim"):
        ConstrainedReward(Reward(), PANDA, {"force": 1.0})
    with pytest.raises(UserError, match=r"^costs.excess_force: expected a number in \(0, inf\), got 0$"):
        ConstrainedReward(Reward(), PANDA, {"excess_force": 0})
    with pytest.raises(UserError, match=r"^costs.impact_speed: ReachTask touches nothing; limit_margin is allowed$"):
        ConstrainedReward(Reward(), PANDA, {"impact_speed": 0.1}).terms(ReachTask())
