"""How wrong what is believed of an arm may be: from its identification, and from motion without a payload."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from r2s.adaptation.balance import Balance, Kept, observe
from r2s.adaptation.believed import FIRM, Believed
from r2s.adaptation.kalman import Filter, Noise, T, update
from r2s.adaptation.momentum import BODY
from r2s.adaptation.refinement import LEAST, Beyond, beyond, corrected
from r2s.identification.parameters import ParameterSpace
from r2s.physics.payload import FARTHEST_M, MOST_KG
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

MASS = MOST_KG / np.sqrt(3)  # kg, root mean square of what is uniform up to the most
MOMENT = MASS * FARTHEST_M / np.sqrt(5)  # kg m, of each axis, for centres uniform in the ball
TENSOR = 4e-3  # kg m^2: 0.87 kg, 5 cm from the hand and 5 cm thick
WARMED = 0.07  # share of friction that warmth may have changed since the identification
WARMING = 0.007  # 1/sqrt(s): 7 % in 100 s
DRIFTED, DRIFTING = 0.02, 0.003  # of friction's level; per sqrt(s)
RESTING = 0.02  # kg^2/s: after a second as wide as what friction hides, b / (r g), 0.1 to 0.25 kg
CREEPING = 0.003  # 1/sqrt(s)
LEARNING = 0.04  # per span: what surprises has half a second to become noise
LASTING = 0.3  # s
# where no motion without a payload says how wrong the model is: shares of friction's level
WHITE, MOVING, MODEL, TURNING = 0.2, 0.1, 0.1, 0.1
LAGS = range(3, 16)  # spans, between which the errors of a balance have forgotten the noise of the speeds
FINEST = 0.03  # of the level: better nobody knows friction
SHARPER = 0.7  # times the noise of a model that has learnt from half as much; chosen on development twins
LEAST_SCALE, MOST_SCALE, ROUNDS = 0.5, 1.5, 8
FAR = 3.0  # standard deviations: what is farther off counts as that far, as the filter weighs it less
LOADED = 0.015  # Nm per Nm of a payload: friction that goes with load


@dataclass(frozen=True)
class Prior:
    """Standard deviations of friction's share (n,) and of the offsets (n,) Nm, as an identification left them."""

    friction: np.ndarray
    offset: np.ndarray


def prior_of(space: ParameterSpace, samples: np.ndarray) -> Prior:
    """Return what the draws (S, P) of an identification say."""
    d = space.dynamics(samples)
    firm = np.full(space.n, FIRM)
    levels = 0.5 * (d.friction(firm) - d.friction(-firm))
    middle = np.maximum(np.abs(np.median(levels, 0)), 1e-9)
    return Prior(levels.std(0) / middle, np.broadcast_to(d.offset, levels.shape).std(0))


def noise_of(arm: Believed, prior: Prior | None = None) -> Noise:
    """Return the noise of an arm of which no motion is known, or the draws of an identification alone."""
    n = len(arm.level)
    zero = np.zeros(n)
    known = prior or Prior(zero + 0.3, 0.3 * arm.level)
    friction = np.hypot(known.friction, WARMED)
    offset = np.hypot(known.offset, DRIFTED * arm.level)
    payload = np.array([MASS, *[MOMENT] * 3, *[TENSOR] * 3, *[0.5 * TENSOR] * 3])
    return Noise(
        white=WHITE * arm.level,
        moving=zero + MOVING,
        model=MODEL * arm.level,
        lasting=LASTING,
        turning=zero + TURNING,
        level=arm.level,
        edge=arm.edge,
        inertia=np.zeros((n, n)),
        late=np.zeros((n, n)),
        loaded=LOADED,
        warming=WARMING,
        drifting=DRIFTING * arm.level,
        resting=RESTING,
        creeping=CREEPING,
        learning=LEARNING,
        prior=(sigma := np.concatenate([payload, friction, offset, MODEL * arm.level, zero + MOVING])),
        start=np.zeros_like(sigma),
    )


def balances(arm: Believed, recording: Recording) -> list[Balance]:
    """Return the balances of a recording of commanded torque, of every span in it."""
    n, out = recording.n_joints, []
    for stretch in recording.stretches:
        kept, b = Kept.fresh(n), Balance.empty(n)
        for k in range(stretch.start, stretch.stop):
            if observe(arm, kept, recording.q[k], recording.dq[k], recording.tau[k], b):
                out.append(Balance(*(a.copy() for a in b)))
    return out


def learnt(
    robot: Robot, arm: Believed, prior: Prior | None, train: list[Balance], unloaded: list[Balance]
) -> tuple[Beyond, Noise]:
    """Return what motion without a payload, such as the two of an identification, says beyond `arm`, and its noise.

    What all of it says is used in the end. The noise is that of `unloaded`, which should be other motion, with what
    `train` alone says. Per joint: the model's error from covariances at lags of 60 to 300 ms, white noise and its
    growth with the momentum's rate from what is left. Then all of a joint's are scaled so that the filter's
    innovations on that motion have the variances that it believes, and all joints' until no odds of a payload are
    above the number of spans. Friction and offsets begin with what all of the motion says.
    """
    some = beyond(robot, arm, train)
    noise = _of_motion(noise_of(arm, prior)._replace(learning=0.0), corrected(robot, arm, some, unloaded))
    noise = _scaled(noise, np.full(len(arm.level), SHARPER))
    more = beyond(robot, arm, [*train, *unloaded])
    filter = _run(_bare(noise), corrected(robot, arm, more, [*train, *unloaded]))[0]
    n = len(arm.level)
    start, prior_now = np.zeros_like(noise.prior), noise.prior.copy()
    drift = np.concatenate([np.full(n, WARMED), DRIFTED * arm.level])
    slow = slice(BODY, BODY + 2 * n)
    start[slow] = filter.x[slow]
    prior_now[slow] = np.hypot(np.sqrt(np.diag(filter.P)[slow]), drift)
    noise = noise._replace(inertia=more.inertia, late=more.late, prior=prior_now, start=start, learning=LEARNING)
    return more, noise


def _of_motion(noise: Noise, unloaded: list[Balance]) -> Noise:
    """Return the noise that these balances without a payload have."""
    n, level = len(noise.level), noise.level
    change = np.array([b.change for b in unloaded])
    white, moving, model = (getattr(noise, name).copy() for name in ("white", "moving", "model"))
    for j in range(n):
        own, y, used = _plain(unloaded, j)
        if used.sum() < LEAST:
            continue
        error = np.where(used, y - own @ np.linalg.lstsq(own[used], y[used], rcond=None)[0], 0.0)
        alike = []
        for lag in LAGS:
            both = used[lag:] & used[:-lag]
            if both.sum() > LEAST:
                alike.append((error[lag:] * error[:-lag])[both].mean() / np.exp(-lag * T / LASTING))
        most = error[used].std()
        model[j] = np.sqrt(max(np.mean(alike), 0.0)) if alike else model[j]
        model[j] = max(min(model[j], most), FINEST * level[j])
        square = error[used] ** 2
        weight = 1 / (square.mean() + change[used, j] ** 2 * 1e-2)
        both = np.column_stack([np.ones(used.sum()), change[used, j] ** 2]) * weight[:, None]
        (floor, grows), _ = nnls(both, square * weight)
        white[j] = np.sqrt(max(floor - model[j] ** 2, (0.1 * most) ** 2, (FINEST * level[j]) ** 2))
        moving[j] = np.sqrt(grows)
    noise = noise._replace(white=white, moving=moving, model=model, prior=_with_model(noise.prior, model, moving))
    for _ in range(2):
        noise = _scaled(noise, np.maximum(_surprise(noise, unloaded), LEAST_SCALE))
    allowed = np.log(len(unloaded))
    for _ in range(ROUNDS):  # odds that no payload there speaks for
        if (most := _odds(noise, unloaded)) <= allowed:
            break
        noise = _scaled(noise, np.full(n, min(np.sqrt(most / allowed), MOST_SCALE)))
    return noise


def _scaled(noise: Noise, scale: np.ndarray) -> Noise:
    """Return the noise with that of each joint times scale (n,)."""
    parts = {name: getattr(noise, name) * scale for name in ("white", "moving", "model", "turning")}
    return noise._replace(**parts, prior=_with_model(noise.prior, parts["model"], parts["moving"]))


def _plain(rows: list[Balance], j: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return joint j's friction and ones (M, 2), its balances (M,), and where it slid (M,)."""
    own = np.array([[b.rub[j], 1.0] for b in rows])
    return own, np.array([b.y[j] for b in rows]), np.array([b.slides[j] > 0 for b in rows])


def _with_model(prior: np.ndarray, model: np.ndarray, moving: np.ndarray) -> np.ndarray:
    out = prior.copy()
    out[-2 * len(model) :] = np.concatenate([model, moving])
    return out


def _bare(noise: Noise) -> Noise:
    """Return the noise of an arm that is known to carry nothing."""
    prior = noise.prior.copy()
    prior[:BODY] = 1e-6
    return noise._replace(prior=prior, resting=0.0)


def _run(noise: Noise, rows: list[Balance]) -> tuple[Filter, np.ndarray, np.ndarray]:
    """Return the filter after these balances, its surprises (M, n), nan where a joint was held, and log odds (M,)."""
    filter, seen, odds = Filter.fresh(noise), [], []
    for b in rows:
        update(filter, noise, b)
        seen.append(np.where(b.slides > 0, filter.seen[0] / np.sqrt(filter.seen[1]), np.nan))
        odds.append(filter.odds[0])
    return filter, np.array(seen), np.array(odds)


def _odds(noise: Noise, unloaded: list[Balance]) -> float:
    """Return the largest log odds of a payload in motion without one."""
    return float(_run(noise, unloaded)[2][len(unloaded) // 10 :].max())


def _surprise(noise: Noise, unloaded: list[Balance]) -> np.ndarray:
    """Return (n,), by how much the innovations are larger than the filter believes, where it knows of no payload."""
    surprise = np.abs(_run(_bare(noise), unloaded)[1])[len(unloaded) // 10 :]  # offsets are being found
    scale = np.ones(surprise.shape[1])
    for j in range(len(scale)):
        own = surprise[np.isfinite(surprise[:, j]), j]
        if len(own) >= LEAST:
            scale[j] = np.sqrt(np.mean(np.minimum(own, FAR) ** 2))
    return scale
