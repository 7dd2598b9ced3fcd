"""Compare physics engines on one arm: open loop, joint stops, a policy on 200 goals, contact, the paper's figure 7.

`python benchmarks/engines.py RUN`, with RUN a run folder of stage=train. Gazebo Classic has to be installed
(docs/how_to/gazebo.md). Writes benchmarks/results/engines.md and engines.png; finished transfers are not repeated.

MuJoCo is the reference. Each torque acts open loop on the arm at rest in its home posture, without gravity. Without
friction, an engine's own equations of motion are compared; with it also the torque of r2s/engines/interface.py.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import yaml
from common import NEW, RESULTS, ROBOT, ROOT, markdown_rows, replace, run_parallel, write_page

from r2s.engines.dart import dart
from r2s.engines.gazebo_classic import gazebo_classic
from r2s.engines.installed import installed
from r2s.engines.interface import Engine, FrictionTorque
from r2s.errors import UserError
from r2s.physics.dynamics import Dynamics
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import SIM_DT
from r2s.physics.simulator import single_arm
from r2s.reporting.figures.colours import OTHERS
from r2s.reporting.figures.panels import panels
from r2s.tasks.press_measures import PRESS
from r2s.tasks.wipe_measures import WIPE

REFERENCE, ODE = "MuJoCo", "Gazebo Classic, ODE"
MAKERS = {
    "DART": (dart, ("simulator=dart",)),
    ODE: (lambda robot: gazebo_classic(robot, "ode"), ("simulator=gazebo_classic",)),
    "Gazebo Classic, DART": (
        lambda robot: gazebo_classic(robot, "dart"),
        ("simulator=gazebo_classic", "simulator.physics=dart"),
    ),
}
CONTACT = {"press": PRESS, "wipe": WIPE}
MOTIONS = 4
SWING = 0.12  # rad, half of what each joint would move alone in a motion
STOP_SHARE = 0.03  # of each torque limit: pushes every joint into a stop
ROTORS = 2e-3 * ROBOT.tau_max  # kg m^2, of the size that identification finds on a Panda
CONTACT_GOALS = 24
GOALS = 4  # of the figure, as in the paper's
ALL_GOALS = 200


class MujocoEngine:
    """MuJoCo behind the interface of the other engines, without r2s's friction."""

    def __init__(self, dynamics: Dynamics):
        self.model = single_arm(ROBOT, dynamics)
        self.model.jnt_user[:] = 0.0
        self.data = mujoco.MjData(self.model)

    def reset(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Set q, dq (n,) rad, rad/s."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = q, dq

    def step(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply tau (n,) Nm for 1 ms; return the new (q, dq)."""
        self.data.qfrc_applied[:] = tau
        mujoco.mj_step(self.model, self.data)
        return self.data.qpos.copy(), self.data.qvel.copy()


def motions() -> list[np.ndarray]:
    """Return torques (T, n) Nm of 1 s, which accelerate and brake all joints from home."""
    model = single_arm(ROBOT, NEW)
    data, mass = mujoco.MjData(model), np.empty((ROBOT.n, ROBOT.n))
    data.qpos[:] = ROBOT.q_home
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    phase = 2 * np.pi * np.arange(0, 1, SIM_DT)
    swings = np.random.default_rng(0).uniform(-SWING, SWING, (MOTIONS, ROBOT.n))
    return [np.cos(phase)[:, None] * (4 * np.pi**2 * mass @ swing) for swing in swings]


def replay(engine: Engine, torques: np.ndarray, friction: Dynamics | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return q, dq (T, n) of an engine from home at rest; `friction`: dynamics whose friction acts too."""
    now = ROBOT.q_home.copy(), np.zeros(ROBOT.n)
    engine.reset(*now)
    law = FrictionTorque(ROBOT, friction) if friction else lambda q, dq, tau: np.zeros(ROBOT.n)
    path = [now := engine.step(tau + law(*now, tau)) for tau in torques]
    q, dq = zip(*path, strict=True)
    return np.array(q), np.array(dq)


def ee_path(q: np.ndarray) -> np.ndarray:
    """Return the end effector's path (T, 3) m."""
    kinematics = Kinematics(ROBOT)
    return np.array([kinematics(one)[0] for one in q])


def rmse(q: np.ndarray, reference: np.ndarray) -> float:
    """Return the RMSE of two end-effector paths, m."""
    return float(np.sqrt(((ee_path(q) - ee_path(reference)) ** 2).sum(1).mean()))


def open_loop(makers: dict[str, Callable[[Dynamics], Engine]]) -> list[str]:
    """Return a table of differences after motions of 1 s, and a line on the motions."""
    cases = {
        "without friction": (NEW, None),
        "with friction": (NEW, NEW),
        "with rotors, without friction": (rotors := replace(NEW, armature=ROTORS), None),
        "with both": (rotors, rotors),
    }
    torques, rows = motions(), {name: {} for name in makers}
    for case, (dynamics, friction) in cases.items():
        home = [replay(MujocoEngine(dynamics), tau, friction) for tau in torques]
        if case == "without friction":
            travel = [np.linalg.norm(np.diff(ee_path(q), axis=0), axis=1).sum() for q, _ in home]
            speed = max(np.abs(dq).max() for _, dq in home)
            left = min(np.minimum(q - ROBOT.q_min, ROBOT.q_max - q).min() for q, _ in home)
        for name, make in makers.items():
            engine = make(dynamics)
            apart = [rmse(replay(engine, tau, friction)[0], q) for tau, (q, _) in zip(torques, home, strict=True)]
            rows[name][f"{case}, m"] = f"{min(apart):.1e} to {max(apart):.1e}"
    text = (
        f"{MOTIONS} motions of 1 s, {min(travel):.2f} to {max(travel):.2f} m long, up to {speed:.1f} rad/s, at least "
        f"{left:.1f} rad from every joint stop. RMSE of the end effector's path against MuJoCo:"
    )
    return [text, markdown_rows(rows, "engine")]


def stops(makers: dict[str, Callable[[Dynamics], Engine]]) -> list[str]:
    """Return a table of what the engines do at joint stops."""
    torques = np.tile(STOP_SHARE * ROBOT.tau_max, (2000, 1))
    home, _ = replay(MujocoEngine(NEW), torques)
    rows = {}
    for name, make in {REFERENCE: MujocoEngine, **makers}.items():
        q, _ = replay(make(NEW), torques)
        over = np.maximum(q - ROBOT.q_max, ROBOT.q_min - q)
        gap = np.linalg.norm(ee_path(q) - ee_path(home), axis=1)
        first = int(np.argmax((over > -1e-3).any(1)))  # joint within 1 mrad of a stop
        rows[name] = {
            "first stop, s": f"{first * SIM_DT:.2f}",
            "farthest beyond a stop, mrad": f"{1e3 * over.max():.1f}",
            **{f"from MuJoCo after {s:g} s, mm": f"{1e3 * gap[round(s / SIM_DT) - 1]:.2g}" for s in (0.5, 1, 2)},
        }
    text = (
        f"{100 * STOP_SHARE:g} % of each torque limit for 2 s, without friction, drive the joints into their stops."
    )
    return [text, markdown_rows(rows, "engine")]


def policy_rows(run: str, goals: int = ALL_GOALS, task: str = "reach") -> dict[str, dict]:
    """Transfer a policy to each engine; return {engine: measures}, and MuJoCo's."""
    common = ["stage=transfer", f"policy={run}", "arm=none", f"evaluation.episodes={goals}"]
    run_parallel([*common, *words, f"name={transfer_folder(name, task).name}"] for name, (_, words) in MAKERS.items())
    found: dict[str, dict] = {}
    for name in MAKERS:
        rows = json.loads((transfer_folder(name, task) / "summary.json").read_text())
        found |= {REFERENCE: rows.pop("mujoco"), name: next(iter(rows.values()))}
    return found


def transfer_folder(name: str, task: str = "reach") -> Path:
    """Return the run folder of an engine's transfer."""
    return ROOT / "runs" / "transfer" / f"engines_{task}_{name.lower().replace(', ', '_').replace(' ', '_')}"


def contact_tables() -> list[str]:
    """Return the tables of the hybrid force controller in each engine, for both tasks in contact."""
    parts = [
        f"The model-based reference (`algo=hybrid_force`) on {CONTACT_GOALS} goals; `dr=contact` draws arm and "
        "surface. r2s computes the contact force, each engine moves the arm. Last column: mean difference of the "
        "normal force over goals and time."
    ]
    run_parallel(
        [f"task={task}", "algo=hybrid_force", f"evaluation.episodes={CONTACT_GOALS}", f"name=engines_{task}"]
        for task in CONTACT
    )
    for task, table in CONTACT.items():
        measures = policy_rows(str(ROOT / "runs" / "train" / f"engines_{task}"), CONTACT_GOALS, task)
        rows = {
            name: {table[key].column.replace("\n", " "): table[key].cell(row[key]) for key in table.rows}
            | {"force from MuJoCo, N": force_difference(name, task)}
            for name, row in measures.items()
        }
        parts.append(markdown_rows(rows, f"task={task}"))
    return parts


def force_difference(name: str, task: str) -> str:
    """Return the mean absolute difference of an engine's normal force from MuJoCo's, N."""
    if name == REFERENCE:
        return ""
    folder = transfer_folder(name, task)
    one, other = (np.load(path)["force"][..., 0] for path in sorted(folder.glob("episodes_*.npz")))
    return f"{np.abs(one - other).mean():.1e}"


def policy_table(run: str) -> list[str]:
    """Return the table of the policy."""
    rows = {
        name: {
            "< 5 mm, %": f"{100 * row['success_5mm']:.1f}",
            "< 1 cm, %": f"{100 * row['success_1cm']:.1f}",
            "return": f"{row['return_paper']:.2f}",
            "at rest, %": f"{100 * row['rest']:.1f}",
            "path from MuJoCo, RMSE, mm": f"{row['ee_path_rmse_mm']:.4f}" if "ee_path_rmse_mm" in row else "",
            "torque from MuJoCo, RMSE, Nm": f"{row['tau_rmse_Nm']:.4f}" if "tau_rmse_Nm" in row else "",
        }
        for name, row in policy_rows(run).items()
    }
    typed = yaml.safe_load((Path(run) / "overrides.yaml").read_text())
    how = " ".join(w for w in typed if not w.startswith(("name=", "root=", "threads=")))
    text = (
        f"A policy (`python run.py {how}`) on {ALL_GOALS} goals and the arms that its training draws. Friction, "
        "delay and safety filter are the same in every engine."
    )
    return [text, markdown_rows(rows, "engine")]


def draw_rewards() -> list[str]:
    """Draw the rewards of four goals in MuJoCo and in Gazebo, as the paper's figure 7."""
    folder = transfer_folder(ODE)
    pair = [np.load(folder / f"episodes_{name}.npz", allow_pickle=False) for name in ("mujoco", "gazebo_classic")]
    t, rewards, goals = pair[0]["t"], [one["reward"] for one in pair], pair[0]["goal"]
    with panels(RESULTS / "engines.png", GOALS, 2, "reward over time: same policy, same goals", 2.4) as axes:
        for k, axis in enumerate(axes):
            axis.plot(t, rewards[0][k], color=OTHERS[0], lw=4, alpha=0.5, label=REFERENCE)
            axis.plot(t, rewards[1][k], color="#222222", lw=1.2, ls="--", label=ODE)
            apart = np.abs(rewards[0][k] - rewards[1][k]).max()
            at = ", ".join(f"{x:.2f}" for x in goals[k])
            axis.set_title(f"goal {k + 1} at ({at}) m; rewards differ by at most {apart:.1g}", loc="left")
            axis.set(xlabel="time, s", ylabel="reward of eq. (2)")
    return [f"The first {GOALS} goals, as in the paper's figure 7:", "![rewards](engines.png)"]


def main(run: str) -> None:
    """Write the page."""
    try:
        makers = {name: make(ROBOT) for name, (make, _) in MAKERS.items()}
    except UserError as error:
        sys.exit(f"error: {error}")
    versions = "; ".join(f"`{name}`: {found}{needs and f' ({needs})'}" for name, found, needs in installed())
    parts = [
        f"Engines on this machine: {versions}. An engine that is not installed was not run.",
        *("## Motion in open loop", *open_loop(makers)),
        *("## Into joint stops", *stops(makers)),
        *("## A policy", *policy_table(run)),
        *("## In contact", *contact_tables()),
        *("## The paper's figure 7", *draw_rewards()),
    ]
    write_page("engines", "Physics engines", "python benchmarks/engines.py RUN", parts)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("error: engines.py: expected one argument, a run folder of stage=train")
    main(sys.argv[1])
