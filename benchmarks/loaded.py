"""Identify the payload of loaded recordings: errors of mass, centre and tensor, and coverage of their 95 % intervals.

    python benchmarks/loaded.py [part=synthetic|independent|twins] [arms=FOLDER] [root=RUNS] [payloads=N]

- `synthetic`: arms of conf/robot with drawn links, friction and offsets, identified from measured and from motor
  torque of 12 s; then payloads=N, each in another motion of 12 s, with friction that has changed by N(0, 5 %) and,
  for motor torque, rises by 1 % of the joint's load.
- `independent`: arms of benchmarks/independent_arms.py in arms=FOLDER/<name> (train.npz, validation.npz, ramps.npz,
  truth.json), with a simulator that shares no code with r2s, identified from commands by stage=identify.
- `twins`: rigid and elastic twins 0 and 1, identified from commands; 80 % of the payload is declared.

A payload has U(0.5, 0.9) of the rated mass (0.3 to 0.6 on independent arms, whose controller does not know it), is a
box of 4 to 20 cm edges, and has its centre within half of robot.payload_far beyond the flange. Rows go to
ROOT/bench/loaded_PART.csv, tables to benchmarks/results/loaded.md.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
from common import RESULTS, ROOT, conf, fourier, identify_settings, markdown_rows, put_section, record, searches

from r2s.errors import UserError
from r2s.identification.arm_uncertainty import Arm
from r2s.identification.identify import identify
from r2s.identification.parameter_file import load_parameters, load_posterior
from r2s.identification.payload.estimate import identify_payload
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.friction import COULOMB
from r2s.physics.payload import Payload, dynamics_with_payload
from r2s.physics.rigid_body import set_links, tensor_elements
from r2s.physics.robot import load_robot
from r2s.recordings.recording import Recording

ROBOTS = ("panda", "ur10e", "iiwa14", "xarm7", "kinova_gen3")
SECONDS = 12.0
# shares of tau_max: Coulomb, viscous (per rad/s), offset; noise of a torque sensor
COULOMB_SHARE, VISCOUS_SHARE, OFFSET_SHARE, NOISE_SHARE = 0.04, 0.01, 0.003, 0.002
WARMER, LOAD_FRICTION = 0.05, 0.01  # standard deviation of friction's factor; Nm per Nm


def draw_payload(robot, rng, least=0.5, most=0.9) -> Payload:
    """Return a box of uniform density in front of the flange."""
    mass, far = robot.payload_max[0] * rng.uniform(least, most), robot.payload_max[1]
    edges = rng.uniform(0.04, 0.2, 3)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    tensor = mass / 12 * (axes * ((edges**2).sum() - edges**2)) @ axes.T
    centre = 0.5 * far * np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(0.2, 0.8)])
    return Payload(np.array(mass), centre, tensor)


def scored(name: str, kind: str, arm: Arm, recording: Recording, payload: Payload, declared=None) -> dict:
    """Return errors, and which of the 95 % intervals have the truth."""
    found = identify_payload(arm, recording, declared=declared)
    true = {"mass": payload.mass, "centre": payload.centre, "inertia": tensor_elements(payload.inertia)}
    row = {"arm": name, "torque": kind, "mass_kg": float(payload.mass), "found_kg": found.mass}
    for key, value in true.items():
        low, high = found.interval(key)
        row |= {f"{key}_inside": int(np.sum((low <= value) & (value <= high))), f"{key}_of": int(np.size(value))}
        row[f"{key}_half"] = float(np.max(0.5 * (high - low)))
        row[f"{key}_known"] = float(np.mean(found.identifiable[key]))
    row["centre_error"] = float(np.linalg.norm(found.centre - payload.centre))
    row["inertia_error"] = float(np.linalg.norm(found.tensor - payload.inertia) / np.linalg.norm(payload.inertia))
    row["without_Nm"], row["with_Nm"] = (float(np.nanmean(found.rmse(x))) for x in (found.without, found.predicted))
    print({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()}, flush=True)
    return row


def drawn_arm(robot, rng) -> Dynamics:
    """Return true dynamics: masses N(1, 5 %), centres N(0, 5 mm), friction, offsets."""
    tau, n = robot.tau_max, robot.n
    factor, level = np.exp(0.05 * rng.normal(size=n)), np.exp(0.3 * rng.normal(size=n))
    phi = np.stack([COULOMB_SHARE * tau * level, np.zeros(n), VISCOUS_SHARE * tau * level], -1)
    mass, com = robot.mass * factor, robot.com + 5e-3 * rng.normal(size=(n, 3))
    d = replace(Dynamics.of(robot, phi, COULOMB), mass=mass, com=com, inertia=robot.inertia * factor[:, None, None])
    return replace(d, offset=OFFSET_SHARE * tau * rng.normal(size=n))


def log(robot, truth: Dynamics, torque: str, motion, rng, load: float = 0.0) -> Recording:
    """Return the recording of a prescribed motion; `load`: friction, Nm per Nm of the joint's torque."""
    t, q, dq, ddq = motion.t, motion.q, motion.dq, motion.ddq
    model = robot.model(gravity=True)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    set_links(
        model, truth.mass, truth.com, truth.inertia, truth.armature if torque == "motor" else 0 * robot.armature
    )
    data, tau = mujoco.MjData(model), np.empty_like(q)
    for k in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], dq[k], ddq[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    friction = truth.friction(dq) + load * np.abs(tau) * np.tanh(dq / 0.01)
    tau += friction * (1.0 if torque == "motor" else 0.05) - truth.offset  # a link-side sensor sees little friction
    tau += NOISE_SHARE * robot.tau_max * rng.normal(size=tau.shape)
    return Recording(t, q + 2e-5 * rng.normal(size=q.shape), dq + 3e-3 * rng.normal(size=q.shape), tau, torque)


def synthetic(words: dict) -> list[dict]:
    """Return the rows of arms of conf/robot from measured and motor torque."""
    rows = []
    for number, name in enumerate(words.get("robots", ",".join(ROBOTS)).split(",")):
        settings = {k: v for k, v in conf(f"robot/{name}").items()}
        robot = load_robot(**settings if name == "panda" else conf("robot/other") | settings)
        rng = np.random.default_rng([7, number])
        motions = [
            fourier(robot, duration=SECONDS, seed=k, gravity=True, effort=0)
            for k in range(1 + int(words["payloads"]))
        ]
        for torque in ("measured", "motor"):
            truth = drawn_arm(robot, rng)
            how = identify_settings(torque, family="coulomb", breakaway=None)
            start = nominal_dynamics(robot, **conf("friction/uniform"))
            unloaded = log(robot, truth, torque, motions[0], rng)
            found = identify(robot, start, unloaded, searches("staged")[:1], how)
            arm = Arm(found.space, found.x, found.found.samples)
            for motion in motions[1:]:
                payload = draw_payload(robot, rng)
                warm = replace(truth, phi=truth.phi * np.exp(WARMER * rng.normal(size=(robot.n, 1))))
                loaded = dynamics_with_payload(robot, warm, payload)
                load = LOAD_FRICTION if torque == "motor" else 0.0
                rows.append(scored(name, torque, arm, log(robot, loaded, torque, motion, rng, load), payload))
    return rows


def calibrated(folder: Path, robot) -> Arm:
    """Return the identified arm of a run folder."""
    space, x = load_parameters(folder, robot)
    return Arm(space, x, load_posterior(folder, space))


def independent(words: dict) -> list[dict]:
    """Return the rows of arms of the independent simulator."""
    from common import ROBOT
    from independent import identify_arm
    from independent_arms import COMPENSATED, carrying, friction, make_arm, record_motion

    rows, folder = [], Path(words["arms"])
    for number, at in enumerate(sorted(p.parent for p in folder.glob("*/truth.json"))):
        if (run := identify_arm(at.resolve(), f"independent_{at.name}", [])) is None:
            continue
        truth, rng = json.loads((at / "truth.json").read_text()), np.random.default_rng([8, number])
        fast = np.ones(ROBOT.n)
        feedforward = COMPENSATED * 0.5 * (friction(truth, fast) - friction(truth, -fast))
        for k in range(int(words["payloads"])):
            payload = draw_payload(ROBOT, rng, 0.3, 0.6)
            arrays = record_motion(carrying(make_arm(truth), payload), feedforward, truth["seed"], 10 + k)
            recording = Recording(arrays["t"], arrays["q"], arrays["dq"], arrays["tau_J_d"], "commanded")
            rows.append(scored(at.name, "commanded", calibrated(run, ROBOT), recording, payload))
    return rows


def twins(words: dict) -> list[dict]:
    """Return the rows of rigid and elastic twins."""
    from common import ROBOT, identify_twins

    from r2s.arm.interface import ArmStopped
    from r2s.arm.twins.make_twin import make_twin

    root, rows = Path(words["root"]), []
    each = [(v, s, root / "identify" / f"{v}_{s}") for v in ("rigid", "elastic") for s in (0, 1)]
    identify_twins(each, root)
    slow = replace(ROBOT, dq_max=0.6 * ROBOT.dq_max, ddq_max=0.6 * ROBOT.ddq_max)
    for variant, seed, run in each:
        rng = np.random.default_rng([9, seed, variant == "rigid"])
        for k in range(int(words["payloads"])):
            payload = draw_payload(ROBOT, rng)
            given = [
                {
                    "mass": s * float(payload.mass),
                    "centre": payload.centre.tolist(),
                    "inertia": (s * tensor_elements(payload.inertia)).tolist(),
                }
                for s in (1.0, 0.8)
            ]
            arm = make_twin(
                ROBOT, variant=variant, seed=seed, noise=50 + k, payload=given[0], declared_payload=given[1]
            )
            try:
                recording = record(arm, fourier(slow, duration=SECONDS, seed=300 + k, effort=0), loaded=True)
            except (ArmStopped, UserError) as stop:
                print(f"{variant} {seed}: {stop}")
                continue
            declared = Payload(0.8 * payload.mass, payload.centre, 0.8 * payload.inertia)
            rows.append(
                scored(f"{variant} {seed}", "commanded", calibrated(run, ROBOT), recording, payload, declared)
            )
    return rows


PARTS = {"synthetic": synthetic, "independent": independent, "twins": twins}


def lines(rows: pd.DataFrame) -> dict[str, dict[str, str]]:
    """Return a line per arm and torque, and one for all."""
    groups = [(f"{arm}, {kind}", own) for (arm, kind), own in rows.groupby(["arm", "torque"], sort=False)]
    out = {}
    for name, own in [*groups, ("all", rows)]:
        error = 100 * (own["found_kg"] / own["mass_kg"] - 1).abs()
        line = {
            "payloads": str(len(own)),
            "mass, median (worst) error, %": f"{error.median():.2f} ({error.max():.2f})",
        }
        line["95 % half width, %"] = f"{100 * (own['mass_half'] / own['mass_kg']).median():.2f}"
        line["centre, mm"] = f"{1e3 * own['centre_error'].median():.1f} ({1e3 * own['centre_error'].max():.1f})"
        line["tensor, %"] = f"{100 * own['inertia_error'].median():.0f} ({100 * own['inertia_error'].max():.0f})"
        for key, label in (("mass", "mass"), ("centre", "centre"), ("inertia", "tensor")):
            line[f"{label} inside"] = f"{own[f'{key}_inside'].sum()}/{own[f'{key}_of'].sum()}"
        line["torque RMSE, Nm, without → with"] = f"{own['without_Nm'].median():.2f} → {own['with_Nm'].median():.2f}"
        out[name] = line
    return out


def main() -> None:
    """Compute the parts, and write their tables."""
    words = {"part": "synthetic", "root": str(ROOT / "runs"), "payloads": "3"}
    for word in sys.argv[1:]:
        key, _, value = word.partition("=")
        if key not in (*words, "arms", "robots"):
            sys.exit(f"error: loaded.py: unknown argument '{word}'; allowed: part=, arms=, root=, payloads=, robots=")
        words[key] = value
    page = RESULTS / "loaded.md"
    if not page.is_file():
        page.write_text("# Payloads of loaded recordings\n\nWritten by `benchmarks/loaded.py`.\n")
    for part in words["part"].split(","):
        rows = pd.DataFrame(PARTS[part](words))
        at = Path(words["root"]) / "bench" / f"loaded_{part}.csv"
        at.parent.mkdir(parents=True, exist_ok=True)
        rows.to_csv(at, index=False)
        table = markdown_rows(lines(rows), "arm, torque")
        print(table)
        put_section(page, part, [stamp_of(words), table])


def stamp_of(words: dict) -> str:
    """Return machine, date, commit and command."""
    from common import stamp

    return stamp(
        "python benchmarks/loaded.py " + " ".join(w for w in sys.argv[1:] if not w.startswith(("arms=", "root=")))
    )


if __name__ == "__main__":
    main()
