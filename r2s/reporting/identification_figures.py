"""Figures of an identification: torque, position, friction, convergence, and whether the residual is white."""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import butter, freqz_sos

from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT
from r2s.reporting.colours import colours
from r2s.reporting.figures import joint_panels, log_axis, panels
from r2s.reporting.log_rows import thin, without_pauses
from r2s.reporting.tables import number

LONGEST = 30.0  # s of torque in a figure: more is a solid band
LAGS_S = 1.0  # of the residual's autocorrelation
SCANS = ("family", "breakaway")  # steps of the history whose cost, where they have one, is of another kind


def torque_figure(
    path: Path, t: np.ndarray, measured: np.ndarray, predicted: Mapping[str, np.ndarray], title: str
) -> Path:
    """Draw measured (T, n) and predicted {label: (T, n)} torque, Nm, over t (T,) s: the paper's fig. 4.

    The first `LONGEST` seconds are drawn, pauses cut short; the RMSE in the titles is over everything.
    """
    colour, (clock, pauses) = colours(["measured", *predicted]), without_pauses(t)
    rows = np.flatnonzero(clock <= LONGEST)
    title += f" (the first {LONGEST:g} s of {clock[-1]:.0f} s)" if len(rows) < len(t) else ""
    rows = rows[thin(len(rows))]
    breaks = np.searchsorted(rows, pauses[pauses <= rows[-1]])  # no line over a pause

    def line(values: np.ndarray) -> np.ndarray:
        return np.insert(values[rows], breaks, np.nan)

    with joint_panels(path, measured.shape[1], title) as axes:
        for j, axis in enumerate(axes):
            x = line(clock)
            axis.plot(x, line(measured[:, j]), color=colour["measured"], linewidth=2.2, alpha=0.7, label="measured")
            scores = []
            for label, tau in predicted.items():
                axis.plot(x, line(tau[:, j]), color=colour[label], linewidth=0.9, label=label)
                scores.append(f"{label} {np.sqrt(np.mean((tau[:, j] - measured[:, j]) ** 2)):.3g}")
            axis.set_title(f"joint {j + 1}: RMSE {', '.join(scores)} Nm", loc="left")
            seconds = "time, s, pauses cut short" if len(pauses) else "time, s"
            axis.set(xlabel=seconds, ylabel="torque, Nm", xlim=(0, clock[rows[-1]]))
    return path


def position_figure(
    path: Path, windows_q: np.ndarray, predicted: Mapping[str, np.ndarray], dt: float = SIM_DT
) -> Path:
    """Draw the open-loop joint error of predicted {label: (W, S, n)} rad against windows_q (W, S, n).

    Lines are medians over the W windows, bands hold 90 % of them; one of the S rows per `dt` s.
    """
    colour, t = colours(predicted), dt * np.arange(1, windows_q.shape[1] + 1)
    title = f"open-loop error over {len(windows_q)} windows: median and 90 % band"
    early = windows_q.shape[1] // 20  # before that the error is still the noise of the start
    with joint_panels(path, windows_q.shape[2], title) as axes:
        for j, axis in enumerate(axes):
            bottom = np.inf
            for label, q in predicted.items():
                error = 1e3 * np.abs(q[..., j] - windows_q[..., j])
                low, median, high = np.quantile(error, [0.05, 0.5, 0.95], axis=0)
                axis.fill_between(t, low, high, color=colour[label], alpha=0.2, linewidth=0)
                axis.plot(t, median, color=colour[label], label=label)
                bottom = min(bottom, max(median[early], 1e-3) / 5)
            log_axis(axis, ticks=(1.0,))
            axis.set_ylim(bottom=bottom)
            axis.set_title(f"joint {j + 1}", loc="left")
            axis.set(xlabel="time since the measured start, s", ylabel="error, mrad", xlim=(0, t[-1]))
    return path


def friction_figure(
    path: Path,
    dynamics: Mapping[str, Dynamics],
    dq_max: np.ndarray,
    data: tuple[np.ndarray, np.ndarray] | None = None,
    draws: np.ndarray | None = None,
) -> Path:
    """Draw friction over speed up to dq_max (n,) rad/s, and bars at rest for the breakaway edges.

    `data` is (dq (T, n) rad/s, friction torque (T, n) Nm) from a recording; `draws` (S, n, K), parameters of the last
    of `dynamics`, give it a 95 % band.
    """
    colour = colours(dynamics)
    grid = np.linspace(-1, 1, 401)
    grid = np.sign(grid) * np.abs(grid) ** 1.5  # denser about rest, where friction turns
    speed = grid[:, None] * dq_max
    with joint_panels(path, len(dq_max), "friction over speed") as axes:
        for j, axis in enumerate(axes):
            seen = []
            if data is not None:
                some = thin(len(data[0]))
                cloud = {"marker": "o", "linestyle": "", "color": "#6e7781", "markeredgewidth": 0}
                axis.plot(data[0][some, j], data[1][some, j], markersize=1.8, alpha=0.45, zorder=3, **cloud)
                axis.plot([], [], markersize=6, label="recording", **cloud)
                seen.append(np.quantile(data[1][:, j], [0.005, 0.995]))
            for label, d in dynamics.items():
                curve = d.friction(speed)[:, j]
                axis.plot(speed[:, j], curve, color=colour[label], label=label)
                seen.append(curve)
                if np.any(d.breakaway[j]) and not d.family.has_memory:
                    mark = {"marker": "_", "markersize": 14, "markeredgewidth": 2, "linewidth": 1, "linestyle": ":"}
                    axis.plot([0, 0], d.breakaway[j], color=colour[label], label=f"breakaway, {label}", **mark)
                    seen.append(d.breakaway[j])
            low, high = min(x.min() for x in seen), max(x.max() for x in seen)
            if draws is not None:
                label, d = list(dynamics.items())[-1]
                spread = d.family.torque(speed[:, None, [j]], draws[:, [j]])[..., 0]
                bottom, top = np.quantile(spread, [0.025, 0.975], axis=1)
                band = {"color": colour[label], "alpha": 0.25, "linewidth": 0}
                axis.fill_between(speed[:, j], bottom, top, label=f"95 % band, {label}", **band)
                reach = 0.4 * (high - low)  # a wide band may leave the picture rather than flatten the rest
                low = min(low, max(bottom.min(), low - reach))
                high = max(high, min(top.max(), high + reach))
            margin = 0.05 * (high - low) + 1e-6
            axis.set_title(f"joint {j + 1}", loc="left")
            axis.set(xlabel="speed, rad/s", ylabel="friction, Nm", xlim=(-dq_max[j], dq_max[j]))
            axis.set_ylim(low - margin, high + margin)
    return path


def convergence_figure(path: Path, history: pd.DataFrame) -> Path:
    """Draw the cost over seconds, a line per search, relative to where it began; what has no such cost is shaded.

    Costs compare only within one search: residuals are weighed anew between two.
    """
    history = history.assign(seconds=_running(history["seconds"].to_numpy(float)))
    name = history["search"].astype(str)
    stage = (name != name.shift()) | (history["done"] <= history["done"].shift())
    colour = colours(name.where(~name.str.startswith("family"), "family"))
    with panels(path, 1, 1, "convergence of the identification", height=4.2) as (axis,):
        began, told, most = 0.0, dict.fromkeys(colour, 0.0), 1.0
        for _, rows in history.groupby(stage.cumsum()):
            label, ended = str(rows["search"].iloc[0]).split(" ")[0].rstrip(","), rows["seconds"].iloc[-1]
            if label in SCANS:
                shown = "friction families compared" if label == "family" else "breakaway scanned"
                shade = "#9aa0a6" if label == "family" else "#c9a227"
                axis.axvspan(began, ended, color=shade, alpha=0.2, linewidth=0, label=shown)
            else:
                label = str(rows["search"].iloc[0])
                told[label] += rows["evaluations"].iloc[-1]
                cost = rows["cost"].dropna()
                relative = cost / cost.iloc[0]
                most = min(most, relative.min())
                axis.plot(rows.loc[cost.index, "seconds"], relative, color=colour[label], marker="o", markersize=3.5)
            began = ended
        for label, count in told.items():
            if count:
                axis.plot(
                    [], [], color=colour[label], marker="o", markersize=3.5, label=f"{label}: {count:.0f} evaluations"
                )
        log_axis(axis)
        axis.set_ylim(most / 1.3, 1.3)
        axis.set_xlim(left=0)
        axis.set(xlabel="seconds", ylabel="cost, relative to where each search began")
    return path


def _running(seconds: np.ndarray) -> np.ndarray:
    """Return seconds (K,) that go on where a resumed run started again at zero."""
    steps = np.diff(seconds, prepend=0.0)
    return np.cumsum(np.where(steps < 0, seconds, steps))


def whiteness_figure(
    path: Path, t: np.ndarray, error: Mapping[str, np.ndarray], cutoff_hz: float, block_s: float
) -> Path:
    """Draw the autocorrelation of torque errors {label: (T, n)} over t (T,) s, with that of filtered white noise.

    `cutoff_hz` is of the zero-phase filter behind t, `block_s` the length of the intervals' blocks.
    """
    colour = colours(error)
    lags, white, band = _filtered_white(t, cutoff_hz)
    title = "is the torque residual white? its autocorrelation, without the mean"
    with joint_panels(path, next(iter(error.values())).shape[1], title) as axes:
        for j, axis in enumerate(axes):
            name = "95 % band of white noise after the same filter"
            axis.fill_between(lags, white - band, white + band, color="#9aa0a6", alpha=0.35, linewidth=0, label=name)
            for label, e in error.items():
                axis.plot(lags, autocorrelation(t, e[:, [j]], len(lags))[:, 0], color=colour[label], label=label)
            axis.axvline(block_s, color="#555555", linewidth=0.8, linestyle=":", label="block of the intervals")
            axis.set_title(f"joint {j + 1}", loc="left")
            axis.set(xlabel="lag, s", ylabel="autocorrelation", xlim=(0, lags[-1]), ylim=(-1, 1.03))
    return path


def autocorrelation(t: np.ndarray, x: np.ndarray, count: int) -> np.ndarray:
    """Return (count, n): the correlation of x (T, n) with itself 0, 1, ... rows later, never across a pause of t."""
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
    """Return lags (L,) s up to `LAGS_S`, the autocorrelation (L,) of filtered white noise, and 1.96 sigma of it (L,).

    The filter is `Recording.smooth`'s. Sigma is Bartlett's (J. R. Stat. Soc. Suppl. 8(1), 1946) for far lags.
    """
    step = float(np.median(np.diff(t)))
    edges = np.array([0, *without_pauses(t)[1], len(t)])
    longest = int(np.diff(edges).max())
    lags = np.arange(max(min(round(LAGS_S / step) + 1, longest // 2), 2))
    _, h = freqz_sos(butter(4, cutoff_hz, fs=1 / SIM_DT, output="sos"), worN=np.arange(8192) / 8192 * np.pi)
    power = np.abs(h) ** 4  # both ways, squared
    white = np.fft.irfft(np.append(power, 0.0))
    white = np.interp(lags * step, SIM_DT * np.arange(len(white) // 2), white[: len(white) // 2] / white[0])
    pairs = np.maximum(np.diff(edges)[:, None] - lags, 0).sum(0)
    sigma = np.sqrt((white[0] + 2 * np.sum(white[1:] ** 2)) / np.maximum(pairs, 1))
    return lags * step, white, np.where(lags > 0, 1.96 * sigma, 0.0)


def whiteness_table(t: np.ndarray, error: np.ndarray, cutoff_hz: float) -> pd.DataFrame:
    """Return mean and correlation of the torque error (T, n) Nm over t (T,) s, a row per joint."""
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
