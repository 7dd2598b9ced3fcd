"""Compute the spectra of slides under a multisine torque, and the response of a motor on an elastic gear."""

from dataclasses import dataclass

import numpy as np

from r2s.errors import UserError
from r2s.excitation.multisine import LINES_HZ, PERIOD_S
from r2s.recordings.recording import Recording

RATE = 2.5  # least number of samples per period of the fastest line
EXCITED = 3.0  # a line of the torque must exceed its unexcited neighbors by this factor, in the median over the lines
NEIGHBORS = 6  # number of unexcited lines next to an excited one from which its noise is estimated
LOWEST = (
    4  # lowest line, in periods per slide, that counts as a neighbor: below, ramps and drift leak into the spectrum
)
LINEAR = 0.03  # least standard deviation of a response, relative: friction is not exactly constant


@dataclass(frozen=True, eq=False)
class Slides:
    """Spectra of W slides at the F lines LINES_HZ, with complex amplitudes at the phase of the slide's start.

    Attributes:
        joint: (W,) index of the sliding joint. q: (W, n) rad, mean angles. speed: (W,) rad/s, mean speed.
        angles: (W, F, n) rad, amplitudes of all motor angles. torque: (W, F) Nm, of the sliding joint's command.
        sigma: (W, F) rad/Nm, standard deviation of `response`.
    """

    joint: np.ndarray
    q: np.ndarray
    speed: np.ndarray
    angles: np.ndarray
    torque: np.ndarray
    sigma: np.ndarray

    @property
    def response(self) -> np.ndarray:
        """(W, F) rad/Nm, amplitude of the sliding joint's angle over that of its command."""
        own = np.take_along_axis(self.angles, self.joint[:, None, None], 2)[..., 0]
        return own / self.torque


def slides_of(recording: Recording) -> Slides:
    """Return the spectra of a recording of slides; each trajectory is a slide of one joint for PERIOD_S or more.

    Raises:
        UserError: a slide is too short, or its torque has no multisine; the sampling is too slow or irregular; or a
            joint has no slide.
    """
    rows = []
    for stretch in recording.stretches:
        t, q, tau = recording.t[stretch], recording.q[stretch], recording.tau[stretch]
        name = f"data.gears: trajectory {int(recording.trajectory[stretch.start])}"
        step = float(np.median(np.diff(t))) if len(t) > 1 else np.inf
        count = round(PERIOD_S / step) if np.isfinite(step) else 0
        if len(t) < count + 1 or count == 0:
            raise UserError(f"{name} lasts {t[-1] - t[0]:.3g} s, expected a steady slide of {PERIOD_S:g} s or more")
        if (least := RATE * LINES_HZ[-1]) > 1 / step:
            raise UserError(
                f"{name}: {1 / step:.4g} Hz, expected {least:g} Hz or more for lines to {LINES_HZ[-1]:g} Hz"
            )
        if np.abs(np.diff(t[: count + 1]) - step).max() > 0.5 * step:
            raise UserError(f"{name}: the time steps vary; expected every sample of {1e3 * step:g} ms")
        rows.append(_spectra(t[: count + 1], q[: count + 1], tau[:count], name))
    slides = Slides(*(np.array(x) for x in zip(*rows, strict=True)))
    if missing := sorted(set(range(recording.n_joints)) - set(slides.joint.tolist())):
        raise UserError(f"data.gears: no slide of joint {missing[0] + 1}; every joint must slide in turn")
    return slides


def _spectra(t: np.ndarray, q: np.ndarray, tau: np.ndarray, name: str) -> tuple:
    """Return one row of each field of `Slides` from a slide with end point: t (N + 1,), q (N + 1, n), tau (N, n)."""
    count, joint = len(tau), int(np.ptp(q, axis=0).argmax())
    line = np.linspace(0.0, 1.0, count + 1)[:, None] * (q[-1] - q[0])  # a constant speed has no spectrum of its own
    angles = np.fft.rfft(q[:-1] - line[:-1], axis=0) * 2 / count
    torque = np.fft.rfft(tau[:, joint]) * 2 / count
    lines = np.round(LINES_HZ * PERIOD_S).astype(int)
    others = np.setdiff1d(np.arange(LOWEST, int(1.25 * lines[-1])), lines)
    near = others[np.argsort(np.abs(others - lines[:, None]), axis=1, kind="stable")[:, :NEIGHBORS]]
    seen = np.abs(torque[lines]) / np.sqrt((np.abs(torque[near]) ** 2).mean(1))
    if (clear := float(np.median(seen))) < EXCITED:
        raise UserError(
            f"{name}: the torque of joint {joint + 1} does not have the multisine of data.gears; its lines exceed "
            f"their neighbors {clear:.2g} times, expected {EXCITED:g} or more"
        )
    noise = np.sqrt((np.abs(angles[near, joint]) ** 2).mean(1)) / np.abs(torque[lines])
    sigma = np.hypot(noise, LINEAR * np.abs(angles[lines, joint] / torque[lines]))
    speed = float(q[-1, joint] - q[0, joint]) / float(t[-1] - t[0])
    return joint, q.mean(0), speed, angles[lines], torque[lines], sigma


@dataclass(frozen=True, eq=False)
class Drives:
    """Rotors, gears and drives of n joints, each (n,).

    Attributes:
        rotor: kg m^2, inertia of the motor at the joint's side of the gear. stiffness: Nm/rad, of the gear.
        damping: Nm s/rad, of the gear. loop: Nm s/rad, damping of the gear by the drive's torque control.
        viscous: Nm s/rad, slope of the friction over speed. delay, lag: s, of the torque behind the command.
    """

    rotor: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    loop: np.ndarray
    viscous: np.ndarray
    delay: np.ndarray
    lag: np.ndarray


def motor_response(slides: Slides, mass: np.ndarray, drives: Drives) -> np.ndarray:
    """Return the response (W, F) rad/Nm of the sliding joints' motors to their commands.

    For motor angles y, link angles q, gear torque g = K (y - q) + D (y' - q'), and command u of the sliding joint:
        rotor y'' + viscous y' + g + loop (y' - q') = u, delayed and lagged (sliding joint only)
        M q'' = g (all joints; Spong, ASME J. Dyn. Sys. Meas. Control 109, 1987, without the links' effect on rotors)
    The other motors move as measured, or rest, held by their friction. A zero-order hold adds half a sample.

    Args:
        mass: (W, n, n) kg m^2, mass matrices of the links without rotors.
    """
    s = 2j * np.pi * LINES_HZ
    j, each = slides.joint, np.arange(len(slides.joint))
    n = mass.shape[1]
    gear = drives.stiffness + s[:, None] * drives.damping  # (F, n)
    links = mass[:, None] * (s**2)[:, None, None] + gear[:, :, None] * np.eye(n)
    others = slides.angles * gear
    others[each, :, j] = 0.0
    own = np.zeros_like(others)
    own[each, :, j] = gear[:, j].T
    moved = np.linalg.solve(links, np.stack([own, others], -1))  # link angles per rad of the motor; from other motors
    moved = moved[each, :, j]  # (W, F, 2)
    coupling = gear[:, j].T + drives.loop[j, None] * s
    motor = drives.rotor[j, None] * s**2 + drives.viscous[j, None] * s + coupling * (1.0 - moved[..., 0])
    late = np.exp(-s * drives.delay[j, None]) / (1.0 + s * drives.lag[j, None])
    return (late + coupling * moved[..., 1] / slides.torque) / motor
