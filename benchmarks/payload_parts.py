"""Measurements of benchmarks/payload.py on one twin: a row or more per piece."""

import pickle
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from common import JUDGING, ROBOT, VARIANT_SEED, fourier, record, replace

from r2s.adaptation.arm_model import make_arm_model
from r2s.adaptation.estimator import Estimate, Estimator
from r2s.adaptation.kalman import Noise
from r2s.adaptation.model_correction import ModelCorrection, apply_correction
from r2s.adaptation.offline_estimation import estimate_recording, fit_correction
from r2s.adaptation.tuning import SPAN, T
from r2s.arm.interface import ArmState
from r2s.arm.twins import elastic_joints as elastic
from r2s.arm.twins import lugre_joints as lugre
from r2s.arm.twins.elastic_twin import ElasticTwin
from r2s.arm.twins.make_twin import make_twin
from r2s.arm.twins.twin_base import TwinBase
from r2s.compiled import njit
from r2s.files import atomic_write
from r2s.identification.parameter_file import load_parameters, load_posterior
from r2s.physics.dynamics import Dynamics
from r2s.physics.payload import USUAL, dynamics_with_payload, payload_of
from r2s.physics.robot import SIM_DT
from r2s.recordings.readers import read

SECONDS = 12.0  # of a motion
LEARN, SOON_S, LATE_S = round(2.0 / T), 0.2 + 1e-9, 0.5 + 1e-9
PIECE = 25  # consecutive unloaded motions of one estimator: 5 minutes
FALL, TAU_S, COLD, WARMS = 0.25, 60.0, 3, 20  # of friction: drop, time constant; motions before and during it
NEAR = 0.1  # of the friction change
LAGS_S = np.arange(0.0, 60.5, 0.5)
DECLARED = {"right": 1.0, "half the mass": 0.5, "nothing": 0.0, "half too much": 1.5}  # declared / true mass


class IdentifiedTwin(NamedTuple):
    """A twin and its identified model."""

    variant: str
    seed: int
    dynamics: Dynamics
    correction: ModelCorrection
    noise: Noise
    keep: Path | None = None

    def arm(self, stream: int, **given) -> TwinBase:
        """Return the twin, cold, with its own sensor noise per stream."""
        return make_twin(ROBOT, variant=self.variant, seed=self.seed, noise=stream, **given)

    def rng(self, *stream: int) -> np.random.Generator:
        """Return the random generator of a piece."""
        return np.random.default_rng([VARIANT_SEED[self.variant], self.seed, *stream])

    def estimator(self, declared=None) -> Estimator:
        """Return a new estimator of an arm with this declared payload."""
        declared = payload_of(declared, ROBOT.payload_max)
        arm = make_arm_model(ROBOT, dynamics_with_payload(ROBOT, self.dynamics, None, declared))
        return Estimator(apply_correction(arm, self.correction), self.noise)

    def kept(self, name: str, make: Callable[[], list]) -> list:
        """Return the result of `make`, or its copy in the folder `keep`."""
        if self.keep is None:
            return make()
        path = self.keep / f"{self.variant}_{self.seed}_{name}.pickle"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as part:
                part.write_bytes(pickle.dumps(make()))
        return pickle.loads(path.read_bytes())


def folder(root: Path, variant: str, seed: int) -> Path:
    """Return the run folder of a twin's identification: identify/VARIANT_SEED, or an existing judge_SEED."""
    names = [f"{variant}_{seed}", *([f"judge_{seed}"] if seed >= JUDGING[variant][0] else [])]
    found = [root / "identify" / n for n in names if (root / "identify" / n / "posterior.npz").is_file()]
    if not found:
        return root / "identify" / names[0]
    arm = yaml.safe_load((found[0] / "config.yaml").read_text())["arm"]
    if (arm["variant"], arm["seed"]) != (variant, seed):
        sys.exit(f"error: expected {variant} twin {seed}, got {arm['variant']} twin {arm['seed']} ({found[0]})")
    return found[0]


@cache
def identified(root: Path, variant: str, seed: int, keep: Path | None = None) -> IdentifiedTwin:
    """Return a twin with its identified model; `keep` is the folder of kept recordings."""
    at = folder(root, variant, seed)
    space, x = load_parameters(at, ROBOT)
    unloaded = tuple(read(at / f"{name}.npz", torque="commanded") for name in ("train", "validation"))
    dynamics = space.dynamics(x)
    correction, noise = fit_correction(ROBOT, dynamics, (space, load_posterior(at, space)), unloaded)
    return IdentifiedTwin(variant, seed, dynamics, correction, noise, keep)


@cache
def motion(k: int):
    """Return the k-th slow motion, the same for all twins."""
    slow = replace(ROBOT, dq_max=0.6 * ROBOT.dq_max, ddq_max=0.6 * ROBOT.ddq_max)
    return fourier(slow, duration=SECONDS, seed=1000 + k)


def draw_payload(rng: np.random.Generator) -> dict:
    """Return a payload."""
    way = rng.normal(size=3)
    centre = way / np.linalg.norm(way) * USUAL * ROBOT.payload_max[1] * rng.uniform() ** (1 / 3)
    on, off = rng.uniform(2, 4), rng.uniform(7, 9)
    return {"mass": float(rng.uniform(0.05, 1.5)), "centre": centre.tolist(), "on_s": float(on), "off_s": float(off)}


def settled_estimate(estimates: list[Estimate], payload) -> Estimate:
    """Return the estimate after 2 s of motion with a payload, or the last one before its removal."""
    with_payload = [e for e in estimates if payload.on_s <= e.t < payload.off_s]
    moving = [e for e in with_payload if not e.rests]
    return moving[LEARN] if len(moving) > LEARN else with_payload[-1]


def errors(estimates: list[Estimate], payload) -> dict:
    """Return the errors in kg and m, and the shares of motion and rest in which the interval covers the mass."""
    at = settled_estimate(estimates, payload)
    true = [float(payload.mass) * bool(payload.attached(e.t)) for e in estimates]
    covered = np.array([abs(e.mass - m) <= e.mass_half for e, m in zip(estimates, true, strict=True)])
    changes = (0.0, payload.on_s, payload.off_s)
    settled = np.array([not any(0 <= e.t - s < LATE_S for s in changes) for e in estimates])
    rests = np.array([e.rests for e in estimates])
    return {
        "mass": float(payload.mass),
        "mass_error": abs(at.mass - float(payload.mass)),
        "centre_error": float(np.linalg.norm(at.centre - payload.centre)),
        "moving": np.mean(covered[~rests & settled]),
        "resting": np.mean(covered[rests & settled]) if (rests & settled).any() else np.nan,
    }


def events(of: IdentifiedTwin, k: int) -> list[dict]:
    """Return the estimates of a payload that is attached and removed in motion k."""
    given = draw_payload(of.rng(k))
    payload, estimator = payload_of(given, ROBOT.payload_max), of.estimator()
    arm = of.arm(100 + k, payload=given)
    (recording,) = of.kept(f"events_{k}", lambda: [record(arm, motion(k), loaded=True)])
    began = time.process_time()
    estimates = estimate_recording(ROBOT, estimator, recording)
    us = 1e6 * (time.process_time() - began) / len(recording.t)
    at, alarms = (payload.on_s, payload.off_s), estimator.changes

    def moving_s(since: float, until: float) -> float:
        return T * sum(not e.rests for e in estimates if since < e.t <= until)

    moved = [[moving_s(s, c) for c in alarms if c > s] for s in at]
    real = sum(any(c > s and moving_s(s, c) <= LATE_S for s in at) for c in alarms)
    after = [min((c - s for c in alarms if c > s), default=np.nan) for s in at]
    rests = [all(e.rests for e in estimates if s <= e.t <= s + SOON_S) for s in at]
    row = {"on_after": after[0], "off_after": after[1], "seen": sum(x <= SOON_S for x in after)}
    row |= {"seen_moving": sum(min(m, default=np.inf) <= SOON_S for m in moved)}
    row |= {"at_rest": sum(rests), "seen_at_rest": sum(x <= SOON_S for x, r in zip(after, rests, strict=True) if r)}
    return [errors(estimates, payload) | row | {"false": len(alarms) - real, "us": us}]


def quiet(of: IdentifiedTwin, k: int) -> list[dict]:
    """Return the alarms in five minutes of unloaded motion of one estimator and one arm."""
    arm, estimator = of.arm(1000 + k), of.estimator()
    motions, odds = range(PIECE * k, PIECE * (k + 1)), -np.inf
    for recording in of.kept(f"quiet_{k}", lambda: [record(arm, motion(i), loaded=True) for i in motions]):
        odds = max(odds, *(now.odds for now in estimate_recording(ROBOT, estimator, recording)))
    at = " ".join(f"{c:.2f}" for c in estimator.changes)
    return [{"minutes": PIECE * SECONDS / 60, "alarms": len(estimator.changes), "at_s": at, "odds": odds}]


def load(of: IdentifiedTwin, k: int) -> list[dict]:
    """Return the estimates of a constant payload for several declared payloads of the arm."""
    rng, rows = of.rng(k, 1), []
    given = draw_payload(rng) | {"on_s": 0.0, "off_s": None}
    given["mass"] = float(rng.uniform(0.05, USUAL * ROBOT.payload_max[0] / max(DECLARED.values())))
    for name, share in DECLARED.items():
        declared = {"mass": share * given["mass"], "centre": given["centre"]} if share else None
        estimator = of.estimator(declared)
        recording = record(of.arm(200 + k, payload=given, declared_payload=declared), motion(k), loaded=True)
        found = estimate_recording(ROBOT, estimator, recording)
        row = {"declared": name} | errors(found, payload_of(given, ROBOT.payload_max))
        rows.append(row | {"changes": len(estimator.changes)})
    return rows


class WarmingTwin:
    """A twin whose friction scale falls as 1 - FALL (1 - exp(-t / TAU_S)); the twin's own warming is switched off.

    Attributes:
        friction: Nm in each cycle, minus the compensation of the elastic variant's control box.
        scale: of friction in each cycle.
    """

    def __init__(self, arm: TwinBase, begins_s: float):
        self.arm, self.robot, self._begins = arm, arm.robot, begins_s
        self._elastic = isinstance(arm, ElasticTwin)
        e = elastic
        box = [e.C_NEG, e.C_POS, e.MU, e.VISCOUS, e.HELP, e.HELP_VISCOUS]
        self._rows = box if self._elastic else [lugre.C_NEG, lugre.C_POS, lugre.MU, lugre.S2]
        self._cold = arm._hidden[self._rows]  # type: ignore[attr-defined]
        self.friction: list[np.ndarray] = []
        self.scale: list[float] = []

    def move_to(self, q: np.ndarray) -> ArmState:
        """Place the arm; see `Arm`."""
        return self.arm.move_to(q)

    def read(self) -> ArmState:
        """Return the state."""
        return self.arm.read()

    def command(self, tau: np.ndarray) -> None:
        """Send a command with the friction of this cycle."""
        since = max(len(self.scale) * SIM_DT - self._begins, 0.0)
        self.scale.append(1.0 + FALL * np.expm1(-since / TAU_S))
        p, s = self.arm._hidden, self.arm._state  # type: ignore[attr-defined]
        p[self._rows] = self.scale[-1] * self._cold
        if self._elastic:
            s[elastic.HEAT] = 0.0
        self.arm.command(tau)
        self.friction.append(net_friction(p, s) if self._elastic else s[lugre.FRICTION].copy())

    def stop(self) -> None:
        """End the motion."""
        self.arm.stop()


@njit
def net_friction(p, s):
    """Return friction (n,) Nm at the motors of an elastic twin, minus the compensation of its control box."""
    out = np.zeros(s.shape[1])
    for i in range(len(out)):
        w, dq = s[elastic.W, i], s[elastic.DQ_MEASURED, i]
        factor = elastic.warmth(p, s[elastic.HEAT, i], i) * elastic.ripple(p, s[elastic.THETA, i], i)
        out[i] = np.sign(w) * factor * elastic.level(p, w, s[elastic.S_AT, i], np.sign(w), i)
        out[i] -= p[elastic.HELP, i] * np.tanh(dq / p[elastic.HELP_WIDTH, i]) + p[elastic.HELP_VISCOUS, i] * dq
    return out


def record_warming(twin: TwinBase, begins: float, k: int) -> list[tuple]:
    """Return recording, friction, Nm, and friction scale per cycle of each motion."""
    arm, out = WarmingTwin(twin, begins), []
    for i in range(COLD + WARMS):
        since = len(arm.scale)
        recording = record(arm, motion(100 * k + i), loaded=True)
        out.append((recording, np.array(arm.friction[since:]), np.array(arm.scale[since:])))
    return out


def span_means(cycles: np.ndarray) -> np.ndarray:
    """Return means weighted same as in a momentum residual: between triangles of two spans each."""
    c = np.cumsum(cycles, axis=0)
    c = c[: len(c) // SPAN * SPAN].reshape(-1, SPAN, *c.shape[1:])
    rises = np.arange(1, SPAN + 1) / SPAN**2
    triangles = np.tensordot(c[:-1], rises, (1, 0)) + np.tensordot(c[1:], 1 / SPAN - rises, (1, 0))
    return np.diff(triangles, axis=0) / SPAN


def warming(of: IdentifiedTwin, k: int) -> list[dict]:
    """Return how the estimator tracks warming friction, a row per joint.

    The truth is the share of the model's friction, with a constant, that fits the twin's friction best while the
    joint slides: one number of the cold joint, times the imposed scale.
    """
    begins, estimator = COLD * SECONDS, of.estimator()
    estimates, cold, scale, model, slides = [], [], [], [], []
    for recording, friction, factors in of.kept(f"warming_{k}", lambda: record_warming(of.arm(300 + k), begins, k)):
        rows: list[tuple] = []

        def report(now: Estimate, rows=rows) -> None:
            residual = estimator.internals[2]
            rows.append((now, residual.friction.copy(), residual.sliding > 0))

        estimate_recording(ROBOT, estimator, recording, report)
        true, factor = span_means(friction), span_means(factors)
        m = min(len(rows), len(true))
        estimates += [now for now, _, _ in rows[:m]]
        model += [f for _, f, _ in rows[:m]]
        slides += [s for _, _, s in rows[:m]]
        cold += list(true[:m] / factor[:m, None])
        scale += list(factor[:m])
    return score_warming(np.array(cold), np.array(model), np.array(slides), np.array(scale), estimates, begins)


def score_warming(cold, model, slides, scale, estimates: list[Estimate], begins: float) -> list[dict]:
    """Return a row per joint: cold, model (M, n) Nm of friction; slides (M, n); scale (M,) of friction over time."""
    t = np.array([e.t for e in estimates])
    estimated, half = np.array([e.friction for e in estimates]), np.array([e.friction_half for e in estimates])
    moving = ~np.array([e.rests for e in estimates])
    before, last = (t > begins - SECONDS) & (t <= begins), t > t[-1] - SECONDS
    later, rows = t > begins, []
    motions = np.minimum((t[later] - begins) // SECONDS, WARMS - 1).astype(int)
    for j in range(model.shape[1]):
        on = slides[:, j]
        share = np.linalg.lstsq(np.column_stack([model[on, j], np.ones(on.sum())]), cold[on, j], rcond=None)[0][0]
        true, x = share * scale, estimated[:, j]
        change = true[last].mean() - true[before].mean()
        error = (x - x[before].mean()) - (true - true[before].mean())
        means = np.bincount(motions, error[later]) / np.bincount(motions)
        far = np.flatnonzero(np.abs(means) > NEAR * abs(change))
        near = int(far[-1]) + 1 if len(far) else 0  # motions after which all errors are small
        fits, rest = [], x[t > begins - SECONDS]
        for lag in LAGS_S:
            shape = 1.0 + FALL * np.expm1(-np.maximum(t - begins - lag, 0.0) / TAU_S)
            columns = np.column_stack([np.ones(len(t)), shape])[t > begins - SECONDS]
            fits.append(np.sum((rest - columns @ np.linalg.lstsq(columns, rest, rcond=None)[0]) ** 2))
        rows.append(
            {
                "joint": j + 1,
                "cold": share,
                "change": change,
                "error": abs(error[last].mean() / change),  # of the change
                "rms": np.sqrt(np.mean((error[later] / change) ** 2)),
                "absolute": abs((x - true)[last].mean() / change),
                "behind_s": LAGS_S[int(np.argmin(fits))],
                "near_after_s": near * SECONDS,
                "never": near == len(means),
                "covered": np.mean((np.abs(x - true) <= half[:, j])[moving]),
                "half": half[last, j].mean(),
            }
        )
    return rows
