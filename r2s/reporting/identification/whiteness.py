"""Test the whiteness of the torque residual: compare the residual with equally filtered white noise."""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import butter, freqz_sos

from r2s.identification.posterior import Z_95
from r2s.physics.robot import SIM_DT
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.log_rows import without_pauses
from r2s.reporting.figures.panels import joint_panels
from r2s.reporting.tables import number

LAGS_S = 1.0  # s, longest lag of the autocorrelation


def whiteness_figure(
    path: Path, t: np.ndarray, error: Mapping[str, np.ndarray], cutoff_hz: float, block_s: float
) -> Path:
    """Draw the autocorrelation of torque residuals {label: (T, n) Nm} over t (T,) s.

    Args:
        path: figure file (PNG). cutoff_hz: cutoff frequency of the zero-phase low-pass, Hz. block_s: length of
            bootstrap blocks, s.
    """
    colour = colours(error)
    lags, white, band = _filtered_white(t, cutoff_hz)
    title = "autocorrelation of the torque residual, mean removed"
    with joint_panels(path, next(iter(error.values())).shape[1], title) as axes:
        for j, axis in enumerate(axes):
            name = "95 % band of white noise after the same filter"
            axis.fill_between(lags, white - band, white + band, color="#9aa0a6", alpha=0.35, linewidth=0, label=name)
            for label, e in error.items():
                axis.plot(lags, autocorrelation(t, e[:, [j]], len(lags))[:, 0], color=colour[label], label=label)
            axis.axvline(block_s, color="#555555", linewidth=0.8, linestyle=":", label="block of the bootstrap")
            axis.set_title(f"joint {j + 1}", loc="left")
            axis.set(xlabel="lag, s", ylabel="autocorrelation", xlim=(0, lags[-1]), ylim=(-1, 1.03))
    return path


def whiteness_table(t: np.ndarray, error: np.ndarray, cutoff_hz: float) -> pd.DataFrame:
    """Return a row per joint: mean, standard deviation and autocorrelation of the residual (T, n) Nm at t (T,) s."""
    lags, white, band = _filtered_white(t, cutoff_hz)
    far = lags > 2 / cutoff_hz
    rows = []
    for j in range(error.shape[1]):
        r = autocorrelation(t, error[:, [j]], len(lags))[:, 0]
        below = np.flatnonzero(r < 1 / np.e)
        outside = 100 * np.mean(np.abs(r - white)[far] > band[far]) if far.any() else np.nan
        reach = f"{lags[below[0]]:.2f}" if len(below) else f"more than {lags[-1]:.2g}"
        rows.append([number(error[:, j].mean()), number(error[:, j].std()), reach, number(outside, "{:.0f}")])
    columns = ["mean, Nm", "standard deviation, Nm", "below 1/e after, s", "far lags outside the band, %"]
    index = pd.Index([str(j + 1) for j in range(error.shape[1])], name="joint")
    return pd.DataFrame(rows, columns=columns, index=index)


def autocorrelation(t: np.ndarray, x: np.ndarray, count: int) -> np.ndarray:
    """Return the autocorrelation (count, n) of x (T, n) at lags of 0, 1, ... rows; no pair of rows spans a pause."""
    x = x - x.mean(0)
    edges = [0, *without_pauses(t)[1], len(t)]
    total, pairs = np.zeros((count, x.shape[1])), np.zeros(count)
    for start, stop in pairwise(edges):
        own = x[start:stop]
        for k in range(min(count, len(own))):
            total[k] += (own[: len(own) - k] * own[k:]).sum(0)
            pairs[k] += len(own) - k
    mean = total / np.maximum(pairs, 1)[:, None]
    return mean / np.maximum(mean[0], 1e-300)


def _filtered_white(t: np.ndarray, cutoff_hz: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return lags (L,) s, the autocorrelation (L,) of filtered white noise, and half the width (L,) of its 95 % band.

    The filter is `Recording.smooth`. The band follows Bartlett (JRSS Supplement 8(1), 1946) for large lags.
    """
    step = float(np.median(np.diff(t)))
    edges = np.array([0, *without_pauses(t)[1], len(t)])
    longest = int(np.diff(edges).max())
    lags = np.arange(max(min(round(LAGS_S / step) + 1, longest // 2), 2))
    _, h = freqz_sos(butter(4, cutoff_hz, fs=1 / SIM_DT, output="sos"), worN=np.arange(8192) / 8192 * np.pi)
    power = np.abs(h) ** 4  # power gain of both filter passes
    white = np.fft.irfft(np.append(power, 0.0))
    white = np.interp(lags * step, SIM_DT * np.arange(len(white) // 2), white[: len(white) // 2] / white[0])
    pairs = np.maximum(np.diff(edges)[:, None] - lags, 0).sum(0)
    sigma = np.sqrt((white[0] + 2 * np.sum(white[1:] ** 2)) / np.maximum(pairs, 1))
    return lags * step, white, np.where(lags > 0, Z_95 * sigma, 0.0)
