"""Hostile torques against a surface, through the driver, with safety.force_max and without: forces beside the bound.

python benchmarks/push_limit.py [CYCLES]   until so many cycles in contact (default 1000000); writes
benchmarks/results/push_limit.md
"""

import sys
from dataclasses import replace

import numpy as np
import pandas as pd
from common import NEW, ROBOT, markdown, write_page

from r2s.arm.driver import DriverBatch
from r2s.physics.push_limit import PushLimit
from r2s.physics.simulator import Simulator
from r2s.physics.surface import Surface, load_tool
from r2s.physics.tip import Tip, tilted
from r2s.tasks.press import PressTask

TOUCHING = 0.5  # N
PUSHES = 150.0, 60.0, 30.0, -20.0  # N
COLUMNS = [
    *("force_max, N", "speed_near, m/s", "delay, ms", "cycles in contact", "arms that touched", "largest force, N"),
    *("largest share of its bound", "over", "share, smooth", "over, smooth"),
]


def hostile(robot, dynamics, limit, seed, m, *, delay=0, cycles=3000, limited=True, stops=False):
    """Press m arms through the driver; return (m, 4): largest force and its bounds, N, and cycles in contact.

    On surfaces of 2e3 to 1e5 N/m, elsewhere than the plane by up to 5 mm and 5 degrees, by full torque, retreats,
    oscillations and noise, `delay` cycles late. An arm that the driver stops, for example at a position limit, counts
    until its motion has ended. stops: each falls silent in the second half of the time, is stopped as `limit.stop`
    says, and counts to the end. Bounds: `PushLimit.bound` in the posture of the largest force, with the surface's
    friction and without.
    """
    rng, n, up = np.random.default_rng(seed), robot.n, limit.normal
    k = np.exp(rng.uniform(np.log(2e3), np.log(1e5), m))
    k[: m // 4] = 1e5
    normal = tilted(up, rng.uniform(0, 2 * np.pi, (m, 1)), np.radians(rng.uniform(0, 5, (m, 1))))
    place = limit.point + rng.uniform(-5e-3, 5e-3, (m, 1)) * up
    exponent, mu = rng.choice([1.0, 1.25], m), rng.uniform(0, 0.5, m)
    surface = Surface(place, normal, k, exponent, 0.5, mu, 1e-4)
    sim, torque = Simulator(robot, replace(dynamics, surface=surface), m, 1), 0.3 * robot.tau_max
    driver = DriverBatch(robot, torque, m, friction=dynamics.level, push_limit=limit if limited else None)
    starts = PressTask().goals(robot, rng, m)[:, 9:]
    sim.reset(starts, np.zeros((m, n)))
    inwards = -np.einsum("mkn,k->mn", np.array([Tip(robot)(q)[1] for q in starts]), up)
    stiff = 10 ** rng.uniform(1, 3, (m, 1)) * robot.tau_max / robot.tau_max.max()
    damps = 0.2 * (rng.random((m, 1)) < 0.7)  # s; the others oscillate
    force, touched, push, late = np.zeros(m), np.zeros(m), np.full(m, PUSHES[0]), [np.zeros((m, n))] * (delay + 1)
    at_peak, silent = starts.copy(), rng.integers(cycles // 2, cycles - 700, m) if stops else np.full(m, cycles)
    for cycle in range(cycles):
        if cycle % 20 == 0:
            push = np.where((rng.random(m) < 0.1) & (cycle > 0), rng.choice(PUSHES, m), push)
            shake = rng.uniform(-0.3, 0.3, (m, n)) * torque * (rng.random((m, 1)) < 0.3)
        command = push[:, None] * inwards + stiff * (starts - sim.q - damps * sim.dq) + shake
        command[silent <= cycle] = np.nan
        late.append(driver(sim.q.copy(), sim.dq.copy(), late[-1], command))
        sim.rollout(late[-1 - delay][:, None], record=())
        pressing = (sim.contact_force * normal).sum(1) * (stops | ~driver.done)
        at_peak[pressing > force] = sim.q[pressing > force]
        force, touched = np.maximum(force, pressing), touched + (pressing > TOUCHING)
    bounds = [
        [limit.bound(robot, q, *how), limit.bound(robot, q, how[0])] for q, *how in zip(at_peak, k, mu, strict=True)
    ]
    return np.column_stack([force, bounds, touched])


def main() -> None:
    """Run rounds of 256 arms at delays of 0 to 8 ms until enough cycles were in contact."""
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    robot = replace(ROBOT, tool=load_tool("r2s:models/press_tool.json"))
    point, up = PressTask().plane(robot)
    rows, seed, done = [], 0, 0
    while done < wanted:
        limit = PushLimit((20.0, 30.0, 60.0)[seed % 3], (0.02, 0.05)[seed % 2], point, up, 5e-3, np.radians(5.0))
        delay = (0, 4, 8)[seed // 3 % 3]
        force, bound, smooth, touched = hostile(robot, NEW, limit, seed, 256, delay=delay).T
        over, share = (force > bound).sum(), (force / bound).max()
        shares = share, over, (force / smooth).max(), (force > smooth).sum()
        rows.append(
            (limit.force_max, limit.speed_near, delay, touched.sum(), (touched > 0).sum(), force.max(), *shares)
        )
        seed, done = seed + 1, done + int(touched.sum())
        print(
            f"{done:,} of {wanted:,} cycles in contact; largest share of a bound {share:.2f}, over it {over}",
            flush=True,
        )
    free, bound, *_ = hostile(robot, NEW, limit, seed, 256, cycles=500, limited=False).T
    table = pd.DataFrame(rows, columns=COLUMNS).groupby(COLUMNS[:3], as_index=False).agg(
        dict(zip(COLUMNS[3:], ("sum", "sum", "max", "max", "sum", "max", "sum"), strict=True))
    )  # fmt: skip
    text = (
        f"{done:,} cycles in contact of simulated Pandas (published friction) behind the driver in {seed * 256} "
        f"motions of 3 s: {table['over'].sum():g} over `PushLimit.bound`, which counts the surface's friction; "
        f"{table['over, smooth'].sum():g} over force_max + speed_near sqrt(k m), that of a smooth surface. Without a "
        f"limit {100 * (free > bound).mean():.0f} % of 256 arms are over it within 0.5 s, the largest force is "
        f"{free.max():.0f} N."
    )
    shown = markdown(table.map("{:.4g}".format).rename_axis("set"))
    write_page(
        "push_limit", "Hostile torques against a surface", f"python benchmarks/push_limit.py {wanted}", [text, shown]
    )


if __name__ == "__main__":
    main()
