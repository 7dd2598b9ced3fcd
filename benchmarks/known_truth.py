"""Identification against a known truth: the paper's NEW values, from its OLD ones, least squares beside the GA alone.

`python benchmarks/known_truth.py` records 20 s of a simulated Panda (encoder noise 2e-5 rad, velocity noise 3e-3
rad/s) and writes docs/known_truth.md. Each search gets the same recording; the GA stops at G_max = 40 generations.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np
import yaml

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from r2s.arm.record import record  # noqa: E402
from r2s.arm.simulated import SimulatedArm  # noqa: E402
from r2s.excitation import fourier  # noqa: E402
from r2s.friction import friction_level, friction_torque  # noqa: E402
from r2s.identify import identify, prediction_errors  # noqa: E402
from r2s.parameters import inertia_scale, nominal_dynamics  # noqa: E402
from r2s.robot import load_robot  # noqa: E402
from r2s.runs import _cpu  # noqa: E402
from r2s.search_ga import ga_search  # noqa: E402
from r2s.search_least_squares import least_squares_search  # noqa: E402


def conf(path: str) -> dict:
    """Read one file of conf/."""
    return yaml.safe_load((ROOT / "conf" / f"{path}.yaml").read_text())


def main() -> None:
    """Record, identify with each search, and write the table."""
    robot, data, settings = load_robot(**conf("robot/panda")), conf("data/simulated"), conf("config")["identify"]
    truth = nominal_dynamics(robot, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
    old = nominal_dynamics(robot, **conf("friction/gaz2019"))
    noise = {k: data[k] for k in ("position_noise", "velocity_noise")}
    motions = [
        record(SimulatedArm(robot, truth, **noise, seed=seed), fourier(robot, duration=data["seconds"], seed=seed))
        for seed in (0, 1)
    ]
    fastest = np.quantile(np.abs(motions[0].dq), 0.98, axis=0)
    speeds = np.linspace(-1, 1, 201)[:, None] * fastest
    level = friction_level(truth.phi, fastest)
    how = {"window_s": settings["window_s"], "cutoff_hz": settings["cutoff_hz"]}
    searches = {"least squares": [least_squares_search()], "GA alone": [ga_search(population=72, generations=40)]}
    columns = ["search", "seconds", "friction curve, worst joint, % of its level", "offset, worst joint, Nm"]
    columns += ["inertia scale, % per link", "open loop 0.5 s, mm", "open loop 2 s, mm"]
    lines = [
        "# Known truth: the paper's NEW values, from its OLD ones",
        "",
        f"`benchmarks/known_truth.py` on {_cpu()}, {os.cpu_count()} cores: {data['seconds']:g} s at 1 kHz, encoder",
        f"noise {data['position_noise']:g} rad, velocity noise {data['velocity_noise']:g} rad/s; end-effector errors",
        "on other motion.",
        "",
        "| " + " | ".join(columns) + " |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, search in searches.items():
        began = time.perf_counter()
        found = identify(
            robot,
            old,
            motions[0],
            search,
            bounds=settings["bounds"],
            prior=settings["prior"]["commanded"],
            breakaway=settings["breakaway"] if name == "least squares" else None,
            window_s=settings["window_s"],
            stride=settings["stride"],
        )
        seconds = time.perf_counter() - began
        d = found.dynamics
        curve = np.abs(friction_torque(speeds, d.phi) - friction_torque(speeds, truth.phi)).max(0) / level
        offset = np.abs(d.offset - truth.offset).max()
        scale = 100 * np.abs(inertia_scale(d.inertia, truth.inertia) - 1)
        ahead = prediction_errors(robot, old, d, motions[1], **how)["ee_error_mm"]
        cells = [
            name,
            f"{seconds:.0f}",
            f"{100 * curve.max():.2f}",
            f"{offset:.4f}",
            " ".join(f"{s:.1f}" for s in scale),
        ]
        lines.append("| " + " | ".join([*cells, f"{ahead['0.5']:.2f}", f"{ahead['2']:.1f}"]) + " |")
        print(lines[-1], flush=True)
    start = prediction_errors(robot, old, old, motions[1], **how)["ee_error_mm"]
    lines += ["", f"The OLD values themselves: {start['0.5']:.0f} mm after 0.5 s and {start['2']:.0f} mm after 2 s."]
    (ROOT / "docs" / "known_truth.md").write_text("\n".join(lines) + "\n")
    print("written: docs/known_truth.md")


if __name__ == "__main__":
    main()
