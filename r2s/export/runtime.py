"""Run a bundle of `r2s export` on an arm, with NumPy and ONNX Runtime but without r2s.

    python r2s_runtime.py BUNDLE         check the bundle, and print what it requires of an arm

    runtime = Runtime("BUNDLE", Arm(joints=[...], cycle_hz=1000, torque="without gravity", ...))
    runtime.reset()                      # at rest, before a motion
    with stopped_by_signals(runtime):    # Ctrl-C and similar signals bring the arm to rest
        while not runtime.done:          # every millisecond
            tau = runtime(q, dq, tau_J_d, goal)

If the policy follows plans, pass a plan to `reset` and no goal to `runtime`. `Runtime.plan` makes a plan from a joint
motion. contract.json lists what the bundle requires of an arm; a BundleError names a requirement that is not met.
"""

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from r2s.export.arm import Arm, fits
from r2s.export.control import LAWS, Control
from r2s.export.fences import PolicyThread, check_plan, check_start, outside, stopped_by_signals  # noqa: F401
from r2s.export.law import BundleError, Driver, Model
from r2s.export.plan import Follower, plan_of
from r2s.export.push import PushLimit
from r2s.export.surface import SurfaceFollower, check_surface_plan

FORMAT = 8


def seal_of(contract: dict[str, Any]) -> str:
    """Return the SHA-256 digest of a contract without its key `seal`."""
    sealed = {k: v for k, v in contract.items() if k != "seal"}
    return hashlib.sha256(json.dumps(sealed, sort_keys=True, allow_nan=False).encode()).hexdigest()


def load(folder: str | Path) -> dict[str, Any]:
    """Check that a bundle is complete and unchanged, and return its contract.

    Raises:
        BundleError: a file is missing or was changed, or this runtime lacks the bundle's control law.
    """
    path = Path(folder) / "contract.json"
    try:
        contract = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise BundleError(f"{path} cannot be read: {error}") from None
    seen = contract.get("format") if isinstance(contract, dict) else None
    if seen != FORMAT:
        raise BundleError(f"{path} is of format {seen!r}; this runtime reads {FORMAT}")
    try:
        for name, digest in contract["files"].items():
            file = Path(folder) / name
            if not file.is_file():
                raise BundleError(f"{name} is missing in {folder}")
            if hashlib.sha256(file.read_bytes()).hexdigest() != digest:
                raise BundleError(f"{name} is not what was exported: its sha256 is another")
        if contract["seal"] != seal_of(contract):
            raise BundleError("contract.json is not what was exported: its seal is another")
        if contract["control"]["name"] not in LAWS:
            raise BundleError(
                f"contract.json: control is '{contract['control']['name']}'; this runtime has {', '.join(LAWS)}, "
                "the r2s_runtime.py of the bundle has its own"
            )
    except BundleError:
        raise
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise BundleError(f"contract.json is damaged: {type(error).__name__} {error}") from None
    return contract


class Runtime:
    """Run a policy with controller and driver; one call per cycle maps the joint state to the torque command.

    Attributes:
        contract: content of contract.json. driver: the `Driver`, which makes the torque obey the arm's limits.

    Args:
        folder: the bundle. arm: the arm that executes the policy. soft_start_s: s, time over which torque fades in.
        live: whether the arm runs in real time, so that the policy must run in a separate thread.

    Raises:
        BundleError: the bundle is damaged or made for another arm.
    """

    def __init__(self, folder: str | Path, arm: Arm, soft_start_s: float = 0.0, live: bool = False):
        import onnxruntime

        self.contract = contract = load(folder)
        fits(contract, arm)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # one thread: no waiting for others
        try:
            self._policy = onnxruntime.InferenceSession(Path(folder) / "policy.onnx", options)
        except Exception as error:  # ONNX Runtime raises many types of exceptions
            raise BundleError(f"policy.onnx cannot be loaded: {' '.join(str(error).split())}") from None
        self._model = Model(contract["model"])
        self._control = Control(contract)
        push = None if contract["law"]["push"] is None else PushLimit(contract["law"], self._model)
        self.driver = Driver(contract["law"], self._model, soft_start_s, self._control, push)
        self._every = contract["rates"]["cycle_hz"] // contract["rates"]["policy_hz"]
        self._entries = [(e["of"], e["divided_by"], e["tanh"]) for e in contract["observation"]["entries"]]
        followers = {"point": None, "plan": Follower, "surface": SurfaceFollower}
        make = followers[contract["goal"]["kind"]]
        self._follower = None if make is None else make(contract, self._control, self._model)
        self._trained = contract["goal"].get("trained")
        self._thread = PolicyThread(self.act) if live else None
        self._cycle = self._limited = self._motion = 0
        self._goal: np.ndarray | None = None

    def reset(self, plan: np.ndarray | None = None) -> None:
        """Prepare the next motion, which begins at rest with zero torque.

        Args:
            plan: (rows, columns), in the format of the contract's entry `goal`; None if goals are points. The arm
                must be at the joint angles of the plan's first row. Computed-torque setpoints take 0.1 s to compute.

        Raises:
            BundleError: the plan is missing, not finite, of a wrong shape, beyond the arm's limits or outside the
                training's region; or the policy's goals are points, but `plan` is not None.
        """
        if self._follower is not None:
            self._follower.take(plan)
            check = check_surface_plan if self.contract["goal"]["kind"] == "surface" else check_plan
            check(self.contract, self._model, np.array(plan, dtype=float))
        elif plan is not None:
            raise BundleError("the policy of this bundle takes a point in every cycle, and no plan")
        self.driver.reset()
        self._cycle = self._limited = 0
        self._goal = None
        self._motion += 1

    def stop(self, why: str = "asked for") -> None:
        """Bring the arm to rest from the next cycle on; `driver.stopping` stores the first call's reason `why`."""
        self.driver.stopping = self.driver.stopping or why

    @property
    def done(self) -> bool:
        """Whether a stop of the arm has ended, see `Driver.done`; `driver.stopping` is the reason for the stop."""
        return self.driver.done

    def __call__(
        self, q: np.ndarray, dq: np.ndarray, tau_J_d: np.ndarray, goal: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the torque (n,) Nm to send in this cycle.

        Args:
            q, dq: measured joint state (n,) rad, rad/s. tau_J_d: (n,) Nm, the torque that the arm applied last.
            goal: finite point (3,) m in the base frame; None if the policy follows a plan, which begins in the first
                cycle after `reset`.

        If a goal during a motion is outside the region of the training's goals, the runtime brings the arm to rest.

        Raises:
            BundleError: an argument has a wrong shape, the plan is missing, the motion is over, the first goal is
                outside the training's region, or the motion does not begin at rest at the start posture.
        """
        if self.done:
            raise BundleError(f"the motion is over, {self.driver.stopping}: call reset before the next one")
        q, dq, tau_J_d = (np.asarray(x, dtype=float) for x in (q, dq, tau_J_d))
        if goal is not None:
            goal = np.asarray(goal, dtype=float)
        asked = None if goal is None else goal.shape
        if not q.shape == dq.shape == tau_J_d.shape == (self._model.n,) or asked != (
            None if self._follower else (3,)
        ):
            shapes = ", ".join(map(str, (q.shape, dq.shape, tau_J_d.shape, asked)))
            size = "no goal" if self._follower else "3"
            raise BundleError(
                f"q, dq, tau_J_d and goal are of shapes {shapes}; {self._model.n} joints and {size} are allowed"
            )
        self._admit(q, dq, goal)
        with np.errstate(invalid="ignore", over="ignore"):  # the driver stops at values that are not finite
            self._model.place(q)
            command = None if self._thread is None else self._thread.newest(self._motion)
            if self._cycle % self._every == 0:
                made = self._look(q, dq, tau_J_d, goal)
                seen, setpoint = self.observe(made), made.get("setpoint", np.zeros(0))
                if not np.isfinite(seen).all():
                    command = None
                elif self._thread is not None:
                    self._thread.give(self._motion, seen, setpoint)
                else:
                    try:
                        command = np.concatenate([self.act(seen), setpoint])
                    except Exception as error:
                        self.stop(f"the policy failed: {error}")
            self._cycle += 1
            return self.driver(q, dq, tau_J_d, command, placed=True)

    def _admit(self, q: np.ndarray, dq: np.ndarray, goal: np.ndarray | None) -> None:
        """Raise BundleError if start or first goal is not allowed; stop the arm if a later goal is not allowed."""
        if self._cycle == 0:
            home = self.contract["start"].get("q_rad") if self._follower is None else self._follower.start
            check_start(self.contract["start"], np.array(home), q, dq)
        if goal is None or self._trained is None or np.array_equal(goal, self._goal):  # type: ignore[arg-type]
            return
        if why := outside(self._trained, goal):
            if self._cycle == 0:
                raise BundleError(why)
            self.stop(why)
        self._goal = goal.copy()

    def _look(
        self, q: np.ndarray, dq: np.ndarray, tau_J_d: np.ndarray, goal: np.ndarray | None
    ) -> dict[str, np.ndarray]:
        """Return {name: values}, the input of `observe`; call `model.place(q)` before this function."""
        ee, jacobian = self._model.hand()
        made = {"q": q, "dq": dq, "ee": ee, "effort": self.driver.effort, "tau_J_d": tau_J_d}
        if self._follower is not None:
            changed = (self.driver.limited - self._limited) / self._every
            self._limited = self.driver.limited
            made |= self._follower(self._cycle // self._every, made, changed)
        elif goal is not None:
            made["goal"] = goal
            made["setpoint"] = goal if self.contract["control"]["setpoint"] == "goal" else np.zeros(0)
        made["error"] = made["goal"] - ee
        return made | {"pull": jacobian.T @ made["error"]}

    def observe(self, made: dict[str, np.ndarray]) -> np.ndarray:
        """Compute the observation (d,) float32 from the result of `_look`."""
        scaled = [made[of] if by is None else made[of] / by for of, by, _ in self._entries]
        parts = [np.tanh(x) if tanh else x for x, (_, _, tanh) in zip(scaled, self._entries, strict=True)]
        return np.concatenate(parts).astype(np.float32)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the policy's action (a,) in SI units for an observation (d,)."""
        return self._policy.run(None, {"observation": observation[None]})[0][0].astype(float)

    def plan(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return the plan of the joint motion q, dq, ddq (rows, n) rad, rad/s, rad/s^2; call only between motions.

        The time between two rows is one control step. The motion must begin and end at rest. The first `steps` + 1
        rows are the path; one more row follows for each row that the policy previews.

        Raises:
            BundleError: the policy's goals are points or plans on a surface, or the motion has a wrong shape.
        """
        if self.contract["goal"]["kind"] != "plan":
            kinds = {"point": "points", "surface": "plans on a surface"}[self.contract["goal"]["kind"]]
            raise BundleError(f"the policy of this bundle takes {kinds}, not plans")
        q, dq, ddq = (np.asarray(x, dtype=float) for x in (q, dq, ddq))
        allowed = self.contract["goal"]["shape"][0], self._model.n
        if not q.shape == dq.shape == ddq.shape == allowed:
            raise BundleError(f"expected q, dq and ddq of shape {allowed}, got {q.shape}, {dq.shape}, {ddq.shape}")
        return plan_of(self._model, q, dq, ddq)


def main() -> int:
    """Check a bundle, and print what it requires of an arm."""
    try:
        contract = load(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent)
    except BundleError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rates, torque, limits = contract["rates"], contract["torque"], contract["limits"]
    print(f"whole: {contract['robot']}, joints {' '.join(contract['joints'])}")
    print(f"policy {rates['policy_hz']} Hz, torque {torque['convention']} at {rates['cycle_hz']} Hz")
    goal = contract["goal"]
    kind = "plan on a surface" if goal["kind"] == "surface" else goal["kind"]
    print(f"goal: a {kind} of {' x '.join(map(str, goal['shape']))} numbers, {goal['unit']}")
    for name, values in {"max_Nm": torque["max_Nm"], **limits}.items():
        print(f"{name}: {values}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
