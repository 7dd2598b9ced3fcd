"""What benchmarks/payload.py measures on one twin, a row or more of each piece of it."""

import pickle
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from common import ROBOT, fourier, record, replace

from r2s.adaptation.balance import SPAN
from r2s.adaptation.believed import believed
from r2s.adaptation.estimator import Estimate, Estimator
from r2s.adaptation.kalman import Noise, T
from r2s.adaptation.listen import learn, listen
from r2s.adaptation.refinement import Beyond, refined
from r2s.arm import elastic_joints as elastic
from r2s.arm import twin as rigid
from r2s.arm.elastic_twin import ElasticTwin
from r2s.arm.hidden_arm import HiddenArm
from r2s.arm.interface import ArmState
from r2s.arm.twins import twin
from r2s.compiled import njit
from r2s.files import whole
from r2s.identification.parameter_file import load_parameters, load_posterior
from r2s.physics.dynamics import Dynamics
from r2s.physics.payload import FARTHEST_M, MOST_KG, loaded, payload_of
from r2s.physics.robot import SIM_DT
from r2s.recordings.readers import read

SECONDS = 12.0  # of a motion
LEARN, SOON_S, LATE_S = round(2.0 / T), 0.2 + 1e-9, 0.5 + 1e-9
PIECE = 25  # unloaded motions that one estimator hears in a row: 5 minutes
FALL, TAU_S, COLD, WARMS = 0.25, 60.0, 3, 20  # of friction; motions before it warms, and while
NEAR = 0.1  # of the change
LAGS_S = np.arange(0.0, 60.5, 0.5)
TOLD = {"right": 1.0, "half the mass": 0.5, "nothing": 0.0, "half too much": 1.5}  # of the mass
JUDGING = {1: 100, 2: 200}  # the first of a hundred seeds


class Known(NamedTuple):
    """A twin and what its identification says of it."""

    make: int
    seed: int
    dynamics: Dynamics
    more: Beyond
    noise: Noise
    keep: Path | None = None

    def arm(self, stream: int, **given) -> HiddenArm:
        """Return the twin, cold, with another noise for each stream."""
        return twin(ROBOT, make=self.make, seed=self.seed, noise=stream, **given)

    def ear(self, load=None) -> Estimator:
        """Return an estimator that has heard nothing, of an arm that was told of this load."""
        arm = believed(ROBOT, loaded(ROBOT, self.dynamics, None, payload_of(load)))
        return Estimator(refined(arm, self.more), self.noise)

    def kept(self, name: str, made: Callable[[], list]) -> list:
        """Return what `made` returns, from `keep` where it was made before."""
        if self.keep is None:
            return made()
        path = self.keep / f"m{self.make}_{self.seed}_{name}.pickle"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole(path) as part:
                part.write_bytes(pickle.dumps(made()))
        return pickle.loads(path.read_bytes())


def folder(root: Path, make: int, seed: int) -> Path:
    """Return the identification of a twin beneath root: m{make}_{seed}, or judge_{seed} where only that is there."""
    names = [f"m{make}_{seed}", f"judge_{seed}"][: 2 if JUDGING[make] <= seed < JUDGING[make] + 100 else 1]
    there = [root / "identify" / n for n in names if (root / "identify" / n / "posterior.npz").is_file()]
    if not there:
        return root / "identify" / names[0]
    arm = yaml.safe_load((there[0] / "config.yaml").read_text())["arm"]
    if (arm["make"], arm["seed"]) != (make, seed):
        sys.exit(
            f"error: {there[0]} is of make {arm['make']}, seed {arm['seed']}; make {make}, seed {seed} is wanted"
        )
    return there[0]


@cache
def known(root: Path, make: int, seed: int, keep: Path | None = None) -> Known:
    """Return what the identification of a twin says; recordings are kept in `keep`."""
    at = folder(root, make, seed)
    space, x = load_parameters(at, ROBOT)
    unloaded = tuple(read(at / f"{name}.npz", torque="commanded") for name in ("train", "validation"))
    dynamics = space.dynamics(x)
    return Known(make, seed, dynamics, *learn(ROBOT, dynamics, (space, load_posterior(at, space)), unloaded), keep)


@cache
def motion(k: int):
    """Return the k-th calm motion, the same for all twins."""
    calm = replace(ROBOT, dq_max=0.6 * ROBOT.dq_max, ddq_max=0.6 * ROBOT.ddq_max)
    return fourier(calm, duration=SECONDS, seed=1000 + k)


def drawn(rng: np.random.Generator) -> dict:
    """Return a payload."""
    way = rng.normal(size=3)
    centre = way / np.linalg.norm(way) * FARTHEST_M * rng.uniform() ** (1 / 3)
    on, off = rng.uniform(2, 4), rng.uniform(7, 9)
    return {"mass": float(rng.uniform(0.05, 1.5)), "centre": centre.tolist(), "on_s": float(on), "off_s": float(off)}


def asked(told: list[Estimate], thing) -> Estimate:
    """Return what is told after 2 s of motion with a payload, or just before it is taken off."""
    carries = [e for e in told if thing.on_s <= e.t < thing.off_s]
    moves = [e for e in carries if not e.rests]
    return moves[LEARN] if len(moves) > LEARN else carries[-1]


def errors(told: list[Estimate], thing) -> dict:
    """Return kg and m by which that is wrong, and the shares of motion and rest in which the mass is covered."""
    at = asked(told, thing)
    true = [float(thing.mass) * bool(thing.there(e.t)) for e in told]
    hit = np.array([abs(e.mass - m) <= e.mass_half for e, m in zip(told, true, strict=True)])
    settled = np.array([not any(0 <= e.t - s < LATE_S for s in (0.0, thing.on_s, thing.off_s)) for e in told])
    rests = np.array([e.rests for e in told])
    return {
        "mass": float(thing.mass),
        "mass_error": abs(at.mass - float(thing.mass)),
        "centre_error": float(np.linalg.norm(at.centre - thing.centre)),
        "moving": np.mean(hit[~rests & settled]),
        "resting": np.mean(hit[rests & settled]) if (rests & settled).any() else np.nan,
    }


def events(of: Known, k: int) -> list[dict]:
    """Return what is told of a payload that is put on and taken off in motion k."""
    given = drawn(np.random.default_rng([of.make, of.seed, k]))
    thing, ear = payload_of(given), of.ear()
    arm = of.arm(100 + k, payload=given)
    (heard,) = of.kept(f"events_{k}", lambda: [record(arm, motion(k), laden=True)])
    began = time.process_time()
    told = listen(ROBOT, ear, heard)
    us = 1e6 * (time.process_time() - began) / len(heard.t)
    at = (thing.on_s, thing.off_s)

    def moves(since: float, until: float) -> float:
        """Return for how many s of that time the arm moved."""
        return T * sum(not e.rests for e in told if since < e.t <= until)

    moved = [[moves(s, c) for c in ear.changes if c > s] for s in at]
    real = sum(any(c > s and moves(s, c) <= LATE_S for s in at) for c in ear.changes)
    seen = [min((c - s for c in ear.changes if c > s), default=np.nan) for s in at]
    rests = [all(e.rests for e in told if s <= e.t <= s + SOON_S) for s in at]
    late = {"on_after": seen[0], "off_after": seen[1], "seen": sum(x <= SOON_S for x in seen)}
    late |= {"seen_moving": sum(min(m, default=np.inf) <= SOON_S for m in moved)}
    late |= {"at_rest": sum(rests), "seen_at_rest": sum(x <= SOON_S for x, r in zip(seen, rests, strict=True) if r)}
    return [errors(told, thing) | late | {"false": len(ear.changes) - real, "us": us}]


def quiet(of: Known, k: int) -> list[dict]:
    """Return the alarms of five minutes of unloaded motion, one estimator and one arm all along."""
    arm, ear = of.arm(1000 + k), of.ear()
    motions, odds = range(PIECE * k, PIECE * (k + 1)), -np.inf
    for heard in of.kept(f"quiet_{k}", lambda: [record(arm, motion(i), laden=True) for i in motions]):
        odds = max(odds, *(now.odds for now in listen(ROBOT, ear, heard)))
    at = " ".join(f"{c:.2f}" for c in ear.changes)
    return [{"minutes": PIECE * SECONDS / 60, "alarms": len(ear.changes), "at_s": at, "odds": odds}]


def load(of: Known, k: int) -> list[dict]:
    """Return what is told of a payload that is there all along, whatever the arm itself was told of it."""
    rng, rows = np.random.default_rng([of.make, of.seed, k, 1]), []
    given = drawn(rng) | {"mass": float(rng.uniform(0.05, MOST_KG / max(TOLD.values()))), "on_s": 0.0, "off_s": None}
    for name, share in TOLD.items():
        told = {"mass": share * given["mass"], "centre": given["centre"]} if share else None
        ear, arm = of.ear(told), of.arm(200 + k, payload=given, load=told)
        heard = record(arm, motion(k), laden=True)
        rows.append({"told": name} | errors(listen(ROBOT, ear, heard), payload_of(given)))
        rows[-1]["changes"] = len(ear.changes)
    return rows


class Warming:
    """A twin whose friction becomes 1 - FALL (1 - exp(-t / TAU_S)) of what it was; its own warmth is held.

    Attributes:
        rubbed: Nm of friction in each cycle, less what the control box of make 2 compensates of it.
        scale: of each cycle.
    """

    def __init__(self, arm: HiddenArm, begins_s: float):
        self.arm, self.robot, self._begins = arm, arm.robot, begins_s
        self._elastic = isinstance(arm, ElasticTwin)
        e = elastic
        box = [e.C_NEG, e.C_POS, e.MU, e.VISCOUS, e.HELP, e.HELP_VISCOUS]
        self._rows = box if self._elastic else [rigid.C_NEG, rigid.C_POS, rigid.MU, rigid.S2]
        self._cold = arm._hidden[self._rows]  # type: ignore[attr-defined]
        self.rubbed: list[np.ndarray] = []
        self.scale: list[float] = []

    def move_to(self, q: np.ndarray) -> ArmState:
        """Place the arm; see `Arm`."""
        return self.arm.move_to(q)

    def read(self) -> ArmState:
        """Return the state."""
        return self.arm.read()

    def command(self, tau: np.ndarray) -> None:
        """Give a command with the friction of now."""
        since = max(len(self.scale) * SIM_DT - self._begins, 0.0)
        self.scale.append(1.0 + FALL * np.expm1(-since / TAU_S))
        p, s = self.arm._hidden, self.arm._state  # type: ignore[attr-defined]
        p[self._rows] = self.scale[-1] * self._cold
        if self._elastic:
            s[elastic.HEAT] = 0.0
        self.arm.command(tau)
        self.rubbed.append(rubs(p, s) if self._elastic else s[rigid.FRICTION].copy())

    def stop(self) -> None:
        """End the motion."""
        self.arm.stop()


@njit
def rubs(p, s):
    """Return (n,) Nm of friction at the motors of make 2, less what its control box compensates."""
    out = np.zeros(s.shape[1])
    for i in range(len(out)):
        w, seen = s[elastic.W, i], s[elastic.DQ_SEEN, i]
        factor = elastic.warmth(p, s[elastic.HEAT, i], i) * elastic.ripple(p, s[elastic.THETA, i], i)
        out[i] = np.sign(w) * factor * elastic.level(p, w, s[elastic.S_AT, i], np.sign(w), i)
        out[i] -= p[elastic.HELP, i] * np.tanh(seen / p[elastic.HELP_WIDTH, i]) + p[elastic.HELP_VISCOUS, i] * seen
    return out


def warmed(twin: HiddenArm, begins: float, k: int) -> list[tuple]:
    """Return of each motion the recording, Nm of friction in each cycle, and the scale of it."""
    arm, out = Warming(twin, begins), []
    for i in range(COLD + WARMS):
        since = len(arm.scale)
        heard = record(arm, motion(100 * k + i), laden=True)
        out.append((heard, np.array(arm.rubbed[since:]), np.array(arm.scale[since:])))
    return out


def warming(of: Known, k: int) -> list[dict]:
    """Return how friction that warms up is followed, a row per joint.

    The truth is the share of what is believed that fits the twin's own friction best while a joint slides, with a
    constant: one number of the cold joint, times the scale that is imposed.
    """
    begins, ear = COLD * SECONDS, of.ear()
    told, cold, scale, rub, slides = [], [], [], [], []

    def spans(cycles: np.ndarray) -> np.ndarray:
        """Return means as of a balance: between triangles of two spans each."""
        c = np.cumsum(cycles, axis=0)
        whole = c[: len(c) // SPAN * SPAN].reshape(-1, SPAN, *c.shape[1:])
        rises = np.arange(1, SPAN + 1) / SPAN**2
        triangles = np.tensordot(whole[:-1], rises, (1, 0)) + np.tensordot(whole[1:], 1 / SPAN - rises, (1, 0))
        return np.diff(triangles, axis=0) / SPAN

    for heard, rubbed, factors in of.kept(f"warming_{k}", lambda: warmed(of.arm(300 + k), begins, k)):
        mine: list[tuple] = []

        def hears(now: Estimate, mine=mine) -> None:
            b = ear.inside[2]
            mine.append((now, b.rub.copy(), b.slides > 0))

        listen(ROBOT, ear, heard, hears)
        seen, factor = spans(rubbed), spans(factors)
        m = min(len(mine), len(seen))
        told += [now for now, _, _ in mine[:m]]
        rub += [r for _, r, _ in mine[:m]]
        slides += [s for _, _, s in mine[:m]]
        cold += list(seen[:m] / factor[:m, None])
        scale += list(factor[:m])
    return followed(np.array(cold), np.array(rub), np.array(slides), np.array(scale), told, begins)


def followed(cold, rub, slides, scale, told: list[Estimate], begins: float) -> list[dict]:
    """Return a row per joint: cold, rub, slides (M, n), Nm, Nm, whether; scale (M,) of friction at each moment."""
    t = np.array([e.t for e in told])
    says, half = np.array([e.friction for e in told]), np.array([e.friction_half for e in told])
    moving = ~np.array([e.rests for e in told])
    before, last = (t > begins - SECONDS) & (t <= begins), t > t[-1] - SECONDS
    later, rows = t > begins, []
    motions = np.minimum((t[later] - begins) // SECONDS, WARMS - 1).astype(int)
    for j in range(rub.shape[1]):
        on = slides[:, j]
        share = np.linalg.lstsq(np.column_stack([rub[on, j], np.ones(on.sum())]), cold[on, j], rcond=None)[0][0]
        true, says_j = share * scale, says[:, j]
        change = true[last].mean() - true[before].mean()
        off = (says_j - says_j[before].mean()) - (true - true[before].mean())
        means = np.bincount(motions, off[later]) / np.bincount(motions)
        far = np.flatnonzero(np.abs(means) > NEAR * abs(change))
        near = int(far[-1]) + 1 if len(far) else 0  # motions after which all are near
        fits = []
        for lag in LAGS_S:
            shape = 1.0 + FALL * np.expm1(-np.maximum(t - begins - lag, 0.0) / TAU_S)
            columns = np.column_stack([np.ones(len(t)), shape])[t > begins - SECONDS]
            left = says_j[t > begins - SECONDS]
            fits.append(np.sum((left - columns @ np.linalg.lstsq(columns, left, rcond=None)[0]) ** 2))
        rows.append(
            {
                "joint": j + 1,
                "cold": share,
                "change": change,
                "error": abs(off[last].mean() / change),  # of the change
                "rms": np.sqrt(np.mean((off[later] / change) ** 2)),
                "absolute": abs((says_j - true)[last].mean() / change),
                "behind_s": LAGS_S[int(np.argmin(fits))],
                "near_after_s": near * SECONDS,
                "never": near == len(means),
                "covered": np.mean((np.abs(says_j - true) <= half[:, j])[moving]),
                "half": half[last, j].mean(),
            }
        )
    return rows
