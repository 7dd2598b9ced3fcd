"""Sensor noise from recordings: injected noise is found, also if a sensor low-passes its speeds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from test_wrench import BAND, ROBOT, free, run, truth

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
@pytest.mark.parametrize("factor", [2.0, 5.0])
def test_noisy_sensors_cause_no_force_on_a_resting_arm(factor):
    """The command rises to 0.9 of the breakaway torque, so friction hides it, at several times a Panda's noise.

    An observer that assumes a Panda's noise takes joints at rest for moving ones, and reports a contact. A calibrated
    one does not.
    """
    dynamics = replace(truth(), breakaway=np.column_stack([-BAND, BAND]), delay=0.0, lag=0.0)
    calibrated = WrenchObserver(ROBOT, dynamics)
    calibrated.calibrate(ROBOT, [noisy(free(seed), seed, factor) for seed in (1, 2)])
    default = WrenchObserver(ROBOT, dynamics, calibrated.thresholds)
    t, rest = np.arange(1500) * SIM_DT, np.tile(ROBOT.q_home, (1500, 1))
    recording = Recording(t, rest, np.zeros_like(rest), 0.9 * BAND * np.minimum(t, 1.0)[:, None], "commanded")
    recording = noisy(recording, 0, factor)
    assert tuple(run(default, recording))[2].any()
    force, half, touches = run(calibrated, recording)
    assert not touches.any()
    assert (np.abs(force) < half).mean() > 0.95


def noisy(recording, seed, factor):
    """Return the recording with additional noise."""
    noise = np.random.default_rng(seed).standard_normal((2, *recording.q.shape))
    q, dq = recording.q + factor * 2e-5 * noise[0], recording.dq + factor * 3e-3 * noise[1]
    return replace(recording, q=q, dq=dq)
