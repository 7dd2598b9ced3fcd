"""Check and follow plans on a surface, for policies that press or wipe; training uses tasks/surface_task.py instead.

Each row of a plan describes one control step: a point on the nominal plane, the plane's normal, the target's depth
below this point, the requested force, the path's velocity, the start posture and the controller's setpoint.
This module imports only NumPy and modules that `r2s export` also copies into r2s_runtime.py.
"""

from typing import Any

import numpy as np

from r2s.export.control import Control
from r2s.export.inverse_dynamics import InverseDynamics
from r2s.export.law import BundleError, Model
from r2s.export.plan import NO_PLAN, finite_plan

WIDTHS = {"place": 3, "normal": 3, "depth": 1, "force": 1, "velocity": 3}  # number of columns; q and setpoint follow
NEAR_M = 1e-3  # m, allowed distance between the tip at the start posture and the target in the plan's first row
# setpoint columns: target velocity, m/s; for control=hybrid: normal, force N, measured force N, whether measured;
# for a sliding target: feedforward force, N
VELOCITY, CONTACT, PULL = slice(3, 6), slice(6, 12), slice(12, 15)
ROUNDING = 1e-6  # m and N, tolerance with which a plan is compared with the training's ranges


def columns_of(n: int, setpoints: int) -> dict[str, list[int]]:
    """Return {name: [first column, column after the last]} for each group of columns in a plan."""
    widths = {**WIDTHS, "q": n, "setpoint": setpoints}
    ends = np.cumsum([0, *widths.values()]).tolist()
    return {name: [begin, end] for name, begin, end in zip(widths, ends[:-1], ends[1:], strict=True)}


def check_surface_plan(contract: dict[str, Any], model: Model, plan: np.ndarray) -> None:
    """Raise BundleError if a plan leaves the training's plane, area, depth or force range.

    Also raise BundleError if the setpoint contradicts the other columns, or if the start posture is wrong.
    """
    goal = contract["goal"]
    at, own, trained = goal["columns"], contract["law"]["joint"], goal["trained"]
    place, normal, depth, force, q = (plan[:, slice(*at[k])] for k in ("place", "normal", "depth", "force", "q"))
    if (off := np.abs(normal - np.array(trained["normal"])).max(1)).max() > ROUNDING:
        row = int(off.argmax())
        raise BundleError(f"row {row} of the plan: a normal of {normal[row].tolist()}, expected {trained['normal']}")
    away = place - np.array(trained["point_m"])
    if (high := np.abs((away * normal).sum(1))).max() > ROUNDING:
        row = int(high.argmax())
        raise BundleError(f"row {row} of the plan is {1e3 * high[row]:.1f} mm off the nominal plane")
    if (far := np.linalg.norm(away, axis=1)).max() > trained["spread_m"] + ROUNDING:
        row = int(far.argmax())
        raise BundleError(
            f"row {row} of the plan is {far[row]:.3f} m from the middle; the training had up to "
            f"{trained['spread_m']:g} m"
        )
    most = trained["force_N"][1]
    if force.max() > most + ROUNDING or force.min() < -ROUNDING:
        row = int(np.abs(force - 0.5 * most).argmax())
        raise BundleError(f"row {row} of the plan asks for {force[row, 0]:.3g} N; the training had up to {most:g} N")
    low, deepest = trained["depth_m"]
    if depth.max() > deepest + ROUNDING or depth.min() < low - ROUNDING:
        row = int(np.abs(depth - 0.5 * (low + deepest)).argmax())
        raise BundleError(
            f"row {row} of the plan: a target {1e3 * depth[row, 0]:.1f} mm below the plane; the training had "
            f"{1e3 * low:.1f} to {1e3 * deepest:.1f} mm"
        )
    check_setpoint(goal, plan)
    low, high_q = (np.array([s if v is None else v for v in own[k]]) for k, s in LIMITS.items())
    if (beyond := (q[0] < low) | (q[0] > high_q)).any():
        j = int(beyond.argmax())
        raise BundleError(f"row 0 of the plan: joint {j + 1} at {q[0, j]:.3f} rad is beyond its limit")
    model.place(q[0])
    tip = model.point(np.array(goal["tip_m"]))[0]
    if (apart := np.linalg.norm(tip - place[0] + depth[0] * normal[0])) > NEAR_M:
        raise BundleError(f"the tip is {1e3 * apart:.1f} mm from where the plan begins")


def check_setpoint(goal: dict[str, Any], plan: np.ndarray) -> None:
    """Raise BundleError if the setpoint of the controller contradicts the plan's target, normal or force.

    A setpoint's target must lie between the plan's targets of the same row and of the next row, because a sliding
    target's setpoint contains the target in the middle of the control period. The contract limits target velocity and
    feedforward force.

    Args:
        goal: entry `goal` of the contract. plan: (rows, columns), a plan on a surface.
    """
    at = goal["columns"]
    place, normal, depth, force, setpoint = (
        plan[:, slice(*at[k])] for k in ("place", "normal", "depth", "force", "setpoint")
    )
    if not setpoint.shape[1]:
        return
    away, after = setpoint[:, :3] - place, np.append(depth[1:], 2.0 * depth[-1:] - depth[-2:-1], axis=0)
    deep = -(away * normal).sum(1, keepdims=True)
    moved = np.linalg.norm(np.diff(place, axis=0, append=place[-1:]), axis=1)
    aside = np.linalg.norm(away + deep * normal, axis=1) - moved
    off = np.hstack([deep - np.maximum(depth, after), np.minimum(depth, after) - deep, aside[:, None]]).max(1)
    if off.max() > ROUNDING:
        row = int(off.argmax())
        raise BundleError(f"row {row} of the plan: the setpoint's target is {1e3 * off[row]:.1f} mm off the plan's")
    for what, columns, most, unit in (
        ("a target velocity", VELOCITY, goal["trained"]["target_m_per_s"], "m/s"),
        ("a feedforward force", PULL, goal["trained"]["feedforward_N"], "N"),
    ):
        size = np.linalg.norm(setpoint[:, columns], axis=1)
        if size.max() > most + ROUNDING:
            row = int(size.argmax())
            raise BundleError(
                f"row {row} of the plan: {what} of {size[row]:.3g} {unit}, expected at most {most:.3g} {unit}"
            )
    if setpoint.shape[1] < CONTACT.stop:
        return
    own = goal["trained"]["contact"]
    asked = np.hstack([normal, force]) if own is None else np.tile(own, (len(plan), 1))
    asked = np.hstack([asked, np.zeros((len(plan), 2))])  # a plan contains no measured force
    given = setpoint[:, CONTACT]
    if (unlike := np.abs(given - asked).max(1)).max() > ROUNDING:
        row = int(unlike.argmax())
        raise BundleError(
            f"row {row} of the plan: a setpoint with normal and force {given[row].tolist()}, expected "
            f"{asked[row].tolist()}"
        )


LIMITS = {"q_stop_low": -np.inf, "q_stop_high": np.inf}  # limit in the contract: value if null


class SurfaceFollower:
    """Follow a plan on a surface; a call returns a control step's observation values and the controller's setpoint.

    Args:
        contract: contract with plans on a surface as goals. control: not used. model: the arm's `Model`.
    """

    def __init__(self, contract: dict[str, Any], control: Control, model: Model):
        goal = contract["goal"]
        self._steps, self._shape = goal["steps"], tuple(goal["shape"])
        self._at = {name: slice(*ends) for name, ends in goal["columns"].items()}
        self._tip, self._regular = np.array(goal["tip_m"], dtype=float), goal["regular_m2"] * np.eye(3)
        self._dynamics, self._model = InverseDynamics(contract), model
        self._plan = np.zeros((0, self._shape[1]))

    def take(self, plan: Any) -> None:
        """Store the next motion's plan; raise BundleError if the plan is missing, not finite, or of a wrong shape."""
        self._plan = finite_plan(plan, self._shape)

    @property
    def start(self) -> np.ndarray:
        """Joint angles (n,) rad at which the plan begins."""
        if not len(self._plan):
            raise BundleError(NO_PLAN)
        return self._plan[0, self._at["q"]]

    def __call__(self, step: int, seen: dict[str, np.ndarray], limited: float) -> dict[str, np.ndarray]:
        """Return {name: values} for a control step: the values for the observation, and the controller's `setpoint`.

        After the last step the target stays at the end of the plan. Call `model.place(q)` before this function.

        Args:
            step: number of the control step, from 0. seen: measured q, dq (n,) rad, rad/s, tau_J_d (n,) Nm.
            limited: fraction of the last control period in which the safety filter changed the command.
        """
        now = self._plan[min(step, self._steps)]
        point, normal, depth, force, velocity = (now[self._at[k]] for k in WIDTHS)
        place, jacobian = self._model.point(self._tip)
        offset, speed = place - point, jacobian @ seen["dq"]
        height, rate = offset @ normal, speed @ normal
        felt = self._force(seen, jacobian) @ normal
        made = {"goal": point, "tip": offset, "height": height, "tip_velocity": speed, "rate": rate, "force": force}
        made |= {"force_error": force + felt, "above_target": height + depth, "limited": limited}
        made |= {"path_error": offset - height * normal, "velocity": velocity, "setpoint": now[self._at["setpoint"]]}
        return {name: np.atleast_1d(value) for name, value in made.items()}

    def _force(self, seen: dict[str, np.ndarray], jacobian: np.ndarray) -> np.ndarray:
        """Return the estimated force (3,) N that the tip exerts on the surface."""
        q, dq = seen["q"], seen["dq"]
        external = seen["tau_J_d"] - self._dynamics.equations(q, dq, np.zeros_like(q))[1]
        return np.linalg.solve(jacobian @ jacobian.T + self._regular, jacobian @ external)
