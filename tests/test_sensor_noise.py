"""Sensor noise from recordings: injected noise is found, also if a sensor low-passes its speeds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from test_wrench import ROBOT, free, run, swing, truth

from r2s.adaptation import tuning
from r2s.adaptation.sensor_noise import SensorNoise, sensor_noise
from r2s.adaptation.wrench import WrenchObserver
from r2s.physics.robot import SIM_DT
from r2s.recordings.recording import Recording


def motion(speed, angle, gain=1.0, seconds=20.0):
    """Return a recording of three joints, the first with a third of this noise; speeds pass a low-pass per cycle."""
    t, rng = np.arange(0.0, seconds, SIM_DT), np.random.default_rng(0)
    rates, share = 2.0 * np.pi * np.array([0.2, 0.35, 0.5]), np.array([1.0 / 3.0, 1.0, 1.0])
    q, dq = np.sin(np.outer(t, rates)), rates * np.cos(np.outer(t, rates))
    noise = share * rng.standard_normal((2, *q.shape))
    dq = dq + lfilter([gain], [1.0, gain - 1.0], speed * noise[0], axis=0)
    return Recording(t, q + angle * noise[1], dq, np.zeros_like(q), "commanded")


@pytest.mark.parametrize("gain", [1.0, 0.6])
@pytest.mark.parametrize("scale", [0.3, 1.0, 10.0])
def test_injected_noise_is_found(gain, scale):
    """The noise is found at any scale, and also if the sensor low-passes dq. The noise of q does not add to it.

    40 calm pieces of 50 ms with a correlation time of 5 ms have 400 independent values: 3.5 % standard error. The
    median over pieces is 3 % lower than the mean. Two low-passes in series (gains 0.2 and 0.6) pass 0.83 of the
    variance that the first alone passes: 9 % less noise.
    """
    found = sensor_noise([motion(3e-3 * scale, 2e-5 * scale, gain)])
    assert found.speed == pytest.approx(3e-3 * scale, rel=0.2)
    assert found.angle == pytest.approx(2e-5 * scale, rel=0.1)


def test_noise_has_a_lower_bound_and_short_recordings_yield_the_default():
    """The lower bound is for simulated arms without noise."""
    found, panda = sensor_noise([motion(0.0, 0.0)]), SensorNoise()
    assert found.speed == pytest.approx(tuning.LEAST_NOISE * panda.speed)
    assert found.angle == pytest.approx(tuning.LEAST_NOISE * panda.angle)
    assert sensor_noise([motion(3e-2, 2e-4, seconds=0.05)]) == panda


@pytest.mark.long
def test_an_observer_of_noisy_sensors_reports_no_false_contact():
    """At five times a Panda's noise, an observer that assumes a Panda's noise reports a contact in free motion.

    A calibrated observer does not. It detects a force of 10 N within 50 ms, and its intervals contain the force.
    """
    push = noisy(swing(lambda t: np.array([0.0, 0.0, 10.0 * (t >= 1.5)]), seed=3), 9)
    observer = WrenchObserver(ROBOT, truth())
    observer.calibrate(ROBOT, [noisy(free(seed), seed) for seed in (1, 2)])
    default = WrenchObserver(ROBOT, truth(), observer.thresholds)
    assert tuple(run(default, push))[2][:1500].any()
    force, half, touches = run(observer, push)
    assert not touches[:1500].any()
    assert touches[1550:].all()
    late = slice(1550, None)
    assert (np.abs(force - [0.0, 0.0, 10.0]) < half)[late].mean() > 0.95


def noisy(recording, seed, factor=5.0):
    """Return the recording with additional noise."""
    noise = np.random.default_rng(seed).standard_normal((2, *recording.q.shape))
    q, dq = recording.q + factor * 2e-5 * noise[0], recording.dq + factor * 3e-3 * noise[1]
    return replace(recording, q=q, dq=dq)
