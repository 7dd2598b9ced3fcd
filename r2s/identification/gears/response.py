"""Compute the spectra of slides under a multisine torque, and the response of a motor on an elastic gear."""

from dataclasses import dataclass

import numpy as np

from r2s.errors import UserError
from r2s.excitation.multisine import LINES_HZ, PERIOD_S
from r2s.recordings.recording import Recording

RATE = 2.5  # least number of samples per period of the fastest line
EXCITED = 3.0  # least median ratio of the torque's excited lines to their unexcited neighbors
GAP = 0.5  # longest gap between samples, in periods of the fastest line
MOVED = 3.0  # another motor is treated as moving at a line if amplitude / noise exceeds this ratio
NEIGHBORS = 6  # number of neighboring unexcited lines that determine the noise of an excited line
LOWEST = 4  # periods per slide of the lowest unexcited neighbor; ramps and drift leak into lower lines
# least relative standard deviation of a response, because friction varies (value from the elastic twins 1 to 3)
LINEAR = 0.06


@dataclass(frozen=True, eq=False)
class Slides:
    """Spectra of W slides at the F lines LINES_HZ: complex amplitudes, with phases relative to the slide's start.

    Attributes:
        joint: (W,) index of the sliding joint. q: (W, n) rad, mean angles. speed: (W,) rad/s, mean speed.
        angles: (W, F, n) rad, amplitudes of all motor angles. torque: (W, F) Nm, amplitudes of the sliding joint's
            command. Amplitudes of other motors that hardly exceed noise (MOVED) are set to 0.
        sigma: (W, F) rad/Nm, standard deviation of the real and of the imaginary part of `response`.
    """

    joint: np.ndarray
    q: np.ndarray
    speed: np.ndarray
    angles: np.ndarray
    torque: np.ndarray
    sigma: np.ndarray

    @property
    def response(self) -> np.ndarray:
        """(W, F) rad/Nm, amplitude of the sliding joint's angle / amplitude of the joint's command."""
        own = np.take_along_axis(self.angles, self.joint[:, None, None], 2)[..., 0]
        return own / self.torque


def slides_of(recording: Recording) -> Slides:
    """Return the spectra of a recording of slides; each trajectory is a slide of one joint for PERIOD_S or more.

    Slides whose torque has no multisine are dropped; lost samples are interpolated.

    Raises:
        UserError: a slide is too short, the sampling is too slow or has gaps, or a joint has no slide with the
            multisine.
    """
    rows, faint = [], dict[int, float]()
    for stretch in recording.stretches:
        t, q, tau = recording.t[stretch], recording.q[stretch], recording.tau[stretch]
        name = f"data.gears: trajectory {int(recording.trajectory[stretch.start])}"
        step = float(np.median(np.diff(t))) if len(t) > 1 else np.inf
        if t[-1] - t[0] < PERIOD_S - 0.5 * step or not np.isfinite(step):
            raise UserError(f"{name} lasts {t[-1] - t[0]:.4g} s, expected a steady slide of {PERIOD_S:g} s or more")
        if (least := RATE * LINES_HZ[-1]) > 1 / step:
            lines = f"for lines to {LINES_HZ[-1]:g} Hz"
            raise UserError(f"{name}: {1 / step:.4g} Hz, expected {least:g} Hz or more {lines}")
        if (gap := float(np.diff(t).max())) > GAP / LINES_HZ[-1]:
            raise UserError(f"{name}: a gap of {1e3 * gap:.3g} ms, allowed up to {1e3 * GAP / LINES_HZ[-1]:.2g} ms")
        at = np.linspace(0.0, PERIOD_S, round(PERIOD_S / step) + 1)
        q, tau = (np.stack([np.interp(at, t - t[0], x) for x in values.T], 1) for values in (q, tau))
        joint, clear, row = _spectra(q, tau[:-1])
        if clear < EXCITED:
            faint[joint] = clear
        else:
            rows.append(row)
    found = {row[0] for row in rows}
    for joint in range(recording.n_joints):
        if joint not in found:
            why = "every joint must slide in turn"
            if joint in faint:
                why = f"the lines of its torque exceed their neighbors {faint[joint]:.2g} times, expected {EXCITED:g}"
            raise UserError(f"data.gears: no slide of joint {joint + 1} with the multisine of data.gears: {why}")
    return Slides(*(np.array(x) for x in zip(*rows, strict=True)))


def _spectra(q: np.ndarray, tau: np.ndarray) -> tuple[int, float, tuple]:
    """Return a slide's joint, the median ratio of excited to unexcited lines of its torque, and a row of `Slides`.

    Args:
        q: (N + 1, n) rad, angles during one period, end point included. tau: (N, n) Nm, commands.
    """
    count, joint = len(tau), int(np.ptp(q, axis=0).argmax())
    # motion at constant speed, which is not part of the response
    line = np.linspace(0.0, 1.0, count + 1)[:, None] * (q[-1] - q[0])
    angles = np.fft.rfft(q[:-1] - line[:-1], axis=0) * 2 / count
    torque = np.fft.rfft(tau[:, joint]) * 2 / count
    lines = np.round(LINES_HZ * PERIOD_S).astype(int)
    others = np.setdiff1d(np.arange(LOWEST, int(1.25 * lines[-1])), lines)
    near = others[np.argsort(np.abs(others - lines[:, None]), axis=1, kind="stable")[:, :NEIGHBORS]]
    clear = float(np.median(np.abs(torque[lines]) / np.sqrt((np.abs(torque[near]) ** 2).mean(1))))
    noise = np.sqrt((np.abs(angles[near]) ** 2).mean(1))  # (F, n), of complex amplitudes
    moved, own = np.where(np.abs(angles[lines]) > MOVED * noise, angles[lines], 0.0), angles[lines, joint]
    moved[:, joint] = own
    sigma = np.hypot(noise[:, joint] / np.sqrt(2.0), LINEAR * np.abs(own)) / np.abs(torque[lines])
    speed = float(q[-1, joint] - q[0, joint]) / PERIOD_S
    return joint, clear, (joint, q.mean(0), speed, moved, torque[lines], sigma)


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

    The model has motor angles y, link angles q, and gear torques g = K (y - q) + D (y' - q') (Spong, ASME J. Dyn.
    Sys. Meas. Control 109, 1987, without the links' effect on rotors). u is the delayed and lagged command:
        motor of the sliding joint: rotor y'' + viscous y' + g + loop (y' - q') = u
        links of all joints: M q'' = g
    Each other motor moves as measured, or friction holds it at rest. A zero-order hold delays the command by half a
    sample.

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
    # link angles: per rad of the sliding joint's motor; due to the other motors
    moved = np.linalg.solve(links, np.stack([own, others], -1))
    moved = moved[each, :, j]  # (W, F, 2)
    coupling = gear[:, j].T + drives.loop[j, None] * s
    motor = drives.rotor[j, None] * s**2 + drives.viscous[j, None] * s + coupling * (1.0 - moved[..., 0])
    late = np.exp(-s * drives.delay[j, None]) / (1.0 + s * drives.lag[j, None])
    return (late + coupling * moved[..., 1] / slides.torque) / motor
