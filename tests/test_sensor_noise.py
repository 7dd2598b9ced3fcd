"""Sensor noise from recordings: injected noise is found, also if a sensor low-passes its speeds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from test_wrench import BAND, ROBOT, free, run, truth

from r2s.adaptation import tuning
from r2s.adaptation.sensor_noise import panda_noise, sensor_noise
from r2s.adaptation.wrench import GAUSSIAN, WrenchObserver
from r2s.adaptation.wrench_fusion import FusedWrench
from r2s.physics.robot import SIM_DT
from r2s.physics.surface import Surface
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
    found, panda = sensor_noise([motion(0.0, 0.0)]), panda_noise()
    assert found.speed == pytest.approx(tuning.LEAST_NOISE * panda.speed)
    assert found.angle == pytest.approx(tuning.LEAST_NOISE * panda.angle)
    assert sensor_noise([motion(3e-2, 2e-4, seconds=0.05)]) == panda


@pytest.mark.parametrize(
    ("speed", "angle"), [(6e-3, 4e-5), (1.5e-2, 1e-4), (3e-3, 1e-4), (1e-3, 4e-5), (3e-4, 2e-5), (0.0, 2e-5)]
)
def test_sensor_noise_causes_no_force_on_a_resting_arm(speed, angle):
    """The command rises to 0.9 of the breakaway torque, so friction hides it, also if noise of q dominates.

    An observer that assumes a Panda's noise takes joints with five times this noise for moving ones, and reports a
    contact.
    """
    dynamics = replace(truth(), breakaway=np.column_stack([-BAND, BAND]), delay=0.0, lag=0.0)
    t, rest = np.arange(1500) * SIM_DT, np.tile(ROBOT.q_home, (1500, 1))
    noise = np.random.default_rng(1).standard_normal((2, *rest.shape))
    tau = 0.9 * BAND * np.minimum(t, 1.0)[:, None]
    recording = Recording(t, rest + angle * noise[0], speed * noise[1], tau, "commanded")
    thresholds = np.array([GAUSSIAN, np.inf])
    if min(speed / 3e-3, angle / 2e-5) >= 5.0:
        assert tuple(run(WrenchObserver(ROBOT, dynamics, thresholds), recording))[2].any()
    found = sensor_noise([motion(speed, angle)])
    force, half, touches = run(WrenchObserver(ROBOT, dynamics, thresholds, found), recording)
    assert not touches.any()
    assert (np.abs(force) < half).mean() > 0.95


def test_only_recordings_of_one_row_per_millisecond_count():
    """Interpolation would change the noise: at 500 Hz, and with 0.1 ms of jitter, a Panda's noise remains."""
    even = motion(6e-3, 4e-5)
    slow = Recording(even.t[::2], even.q[::2], even.dq[::2], even.tau[::2], "commanded")
    jitter = replace(even, t=even.t + 1e-4 * np.sin(np.arange(len(even.t))))
    for recordings in ([slow], [jitter]):
        assert sensor_noise(recordings) == panda_noise()
    assert sensor_noise([slow, even]) == sensor_noise([even])
    kept = np.delete(np.arange(len(even.t)), 7000)  # one lost row
    lost = Recording(even.t[kept], even.q[kept], even.dq[kept], even.tau[kept], "commanded")
    assert sensor_noise([lost]).combined == pytest.approx(sensor_noise([even]).combined, rel=0.05)


@pytest.mark.long
def test_a_calibrated_observer_has_the_noise_of_its_recordings():
    """Also with a surface, whose force depends on the noise of the angles."""
    noise, surface = np.random.default_rng(1).standard_normal((2, 3000, 7)), Surface(np.zeros(3), np.eye(3)[2], 1e4)
    recordings = [
        replace(free(seed), q=free(seed).q + 1e-4 * noise[0], dq=free(seed).dq + 1e-2 * noise[1]) for seed in (1, 2)
    ]
    found = sensor_noise(recordings)
    for observer in (WrenchObserver(ROBOT, truth()), FusedWrench(ROBOT, truth(), surface)):
        observer.calibrate(ROBOT, recordings)
        assert observer.sensors == found
        assert observer._noise.speed == found.combined > 2.0 * panda_noise().combined
        assert observer._noise.angle == found.angle > 2.0 * panda_noise().angle
    assert observer._law.angle == found.angle
