"""Identify synthetic arms of 2 to 8 joints and 5 to 400 Nm, logged at four rates, whose truth is known.

`python benchmarks/scaling.py [FOLDER]` prints the figures of each row, beside those of the checkout in FOLDER (an
earlier state of r2s; without it, those of the page), and writes benchmarks/results/scaling.md. `only=NAME` computes
one row, `json` prints figures.
"""

import inspect
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from common import conf, identify_settings, markdown_rows, searches, write_page
from scipy.signal import lfilter

from r2s.adaptation.arm_model import make_arm_model
from r2s.adaptation.estimator import Estimator
from r2s.adaptation.feedforward import plausible_payload
from r2s.adaptation.momentum import BODY
from r2s.adaptation.noise_model import default_noise
from r2s.identification.identify import identify
from r2s.identification.link_inertia import links
from r2s.identification.parameters import logarithmic
from r2s.physics.actuation import EARLY, Motors
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.friction import COULOMB
from r2s.physics.rigid_body import set_links
from r2s.physics.robot import load_robot
from r2s.physics.simulator import Simulator
from r2s.recordings.recording import Recording

ARMS = (2, 5.0), (3, 20.0), (6, 87.0), (3, 400.0), (8, 400.0)  # joints, Nm of the largest
RATES = 1000, 500, 250, 125  # Hz
LINK = 0.25  # m
LOAD = 0.25  # of tau_max, gravity torque of the stretched arm
# shares of tau_max: median Coulomb and viscous friction (per rad/s), scatter of offsets, noise of a torque sensor
# or of the drive in each ms
COULOMB_SHARE, VISCOUS_SHARE, OFFSET_SHARE, NOISE_SHARE = 0.04, 0.01, 0.003, 0.002
# scatter of the arms: of logarithms of friction, asymmetry, and log-Cholesky parameters of links. Links scatter as
# the prior of link-side torque states: 95 % intervals hold the truth of 95 % of the arms only if arms are like this
LEVEL, ASYMMETRY, LINKS = 0.3, 0.05, 0.15
MASS = 1.15, 0.9, 1.1  # true masses over nominal ones, in turn
DELAY = 2e-3  # s
FINE = 10  # steps of the simulated arm in 1 ms: a real one moves in continuous time
BANDWIDTH = 10.0  # 1/s, of the controller that follows the motion
ROTOR = 5e-3  # kg m^2 per Nm of tau_max
LATE = {  # s, time constant of the filter of dq; rows (ms) that torque comes late
    "on time": (0.0, 0),
    "dq behind a 10 ms filter": (0.01, 0),
    "torque 8 ms late": (0.0, 8),
    "both late": (0.01, 8),
}
RIPPLE, PITCH = 0.05, 25.0  # of Coulomb friction; 1/rad
SEEDS = 4  # motions of each ripple setting
PERIOD_S = 8.0  # of repeated motion
TRACKING = 0.015  # rad RMS
HEAVY, FAR = 3.0, 0.15  # kg, m
PAUSE_S = 600.0
COVERED = "95 % intervals that hold the truth"


def arm(n, largest, file=""):
    """Return a robot of n joints, the largest of `largest` Nm; `file`: attributes of its joints in the MJCF."""
    tau = largest * 0.5 ** (np.arange(n) // 2)
    mass = (2 * LOAD * tau / (9.81 * LINK * (n - np.arange(n)) ** 2)).min()
    bodies, size = "", mass * LINK**2
    for j in range(n):
        axis = "0 0 1" if j % 3 == 0 else "0 1 0"
        bodies += (
            f'<body pos="0 0 {LINK if j else 0.3}"><inertial pos="0.02 0 {LINK / 2}" mass="{mass}" '
            f'diaginertia="{0.1 * size} {0.1 * size} {0.02 * size}"/><joint axis="{axis}" range="-2 2" '
            f'actuatorfrcrange="-{tau[j]} {tau[j]}" {file}/>'
        )
    text = f'<mujoco><compiler angle="radian"/><worldbody>{bodies}<site name="tip" pos="0 0 {LINK}"/>'
    path = Path(tempfile.mkdtemp()) / "arm.xml"
    path.write_text(text + "</body>" * n + "</worldbody></mujoco>")
    return load_robot(str(path))


def truth_of(robot, friction=1.0, masses=None):
    """Return true dynamics, drawn for each arm; masses: factors of the nominal masses, None: drawn links."""
    tau, n = robot.tau_max, robot.n
    draw = np.random.default_rng([n, round(tau[0])]).normal
    coulomb, viscous = (
        share * tau * friction * np.exp(draw(0, LEVEL, n)) for share in (COULOMB_SHARE, VISCOUS_SHARE)
    )
    phi, theta = np.stack([coulomb, draw(0, ASYMMETRY, n), viscous], -1), draw(0, LINKS, (n, 10))
    mass, com, inertia = links(robot, theta)
    if masses is not None:
        mass, com = robot.mass * np.resize(masses, n), robot.com
        inertia = (mass / robot.mass)[:, None, None] * robot.inertia
    d = replace(Dynamics.of(robot, phi, COULOMB), mass=mass, com=com, inertia=inertia)
    return replace(d, offset=OFFSET_SHARE * tau * draw(size=n), delay=DELAY)


def motion(robot, t, seed, slower=1.0, period=None):
    """Return q, dq, ddq (T, n) of a sum of sines about home; with a period (s) they repeat."""
    rng, n = np.random.default_rng(seed), robot.n
    out = np.zeros((3, len(t), n))
    for f in (0.15, 0.37, 0.83, 2.3):
        f = round(f * period) / period if period else f / slower
        w, a = 2 * np.pi * f, 0.15 / (f * slower) ** 0.7 * rng.uniform(0.5, 1.0, n)
        phase = rng.uniform(0, 2 * np.pi, n)
        s, c = a * np.sin(w * t[:, None] + phase), a * np.cos(w * t[:, None] + phase)
        out += s, w * c, -(w**2) * s
    out[0] += robot.q_home + 0.3
    return out


def log(robot, truth, torque, hz=1000, seconds=16.0, seed=0, **how):
    """Return a recording at `hz`; commands are held from row to row."""
    t, rng, every = 1e-3 * np.arange(round(1e3 * seconds)), np.random.default_rng(seed), 1000 // hz
    q, dq, ddq = motion(robot, t, seed, **how)
    model = robot.model(gravity=torque != "commanded")
    set_links(model, truth.mass, truth.com, truth.inertia, truth.armature)
    data, tau = mujoco.MjData(model), np.empty_like(q)
    if torque != "commanded":
        for k in range(len(t)):
            data.qpos[:], data.qvel[:], data.qacc[:] = q[k], dq[k], ddq[k]
            mujoco.mj_inverse(model, data)
            tau[k] = data.qfrc_inverse
        tau += truth.friction(dq) - truth.offset + NOISE_SHARE * robot.tau_max * rng.normal(size=tau.shape)
    else:
        sim = Simulator(robot, truth, 1, 1, dt=1e-3 / FINE)
        early = 1e-3 * EARLY * (1 - 1 / FINE)  # s: `Motors` makes up for steps of 1 ms, which come half a step early
        motors = Motors(1, robot.n, truth.delay - early, truth.lag)
        sim.reset(q[:1], dq[:1])
        for k in range(len(t)):
            own, speed = sim.q[0].copy(), sim.dq[0].copy()
            if k % every == 0:
                data.qpos[:], data.qvel[:] = own, speed
                data.qacc[:] = ddq[k] + 2 * BANDWIDTH * (dq[k] - speed) + BANDWIDTH**2 * (q[k] - own)
                mujoco.mj_inverse(model, data)
                command = data.qfrc_inverse + truth.friction(dq[k]) - truth.offset
            q[k], dq[k], tau[k] = own, speed, command
            drive = motors(tau[None, k : k + 1]) + NOISE_SHARE * robot.tau_max * rng.normal(size=robot.n)
            sim.rollout(np.repeat(drive, FINE, axis=1))
    q, dq = q + 2e-5 * rng.normal(size=q.shape), dq + 3e-3 * rng.normal(size=q.shape)
    return Recording(*(x[::every] for x in (t, q, dq, tau)), torque)


def found_in(robot, recording, change=lambda settings: settings, **more):
    """Identify with the settings of stage=identify and Coulomb friction, without a scan for breakaway."""
    how = identify_settings(recording.torque, family="coulomb", breakaway=None, candidate_terms=[], **more)
    start = nominal_dynamics(robot, **conf("friction/uniform"))
    return identify(robot, start, recording, searches("staged")[:1], change(how))


def judge(found, truth):
    """Return the worst error of friction minus offset at 0.1 and 1 rad/s, %, and intervals right and in all."""
    d, tau = found.dynamics, found.space.robot.tau_max
    true = replace(found.space, nominal=truth).start
    inside = (true >= found.found.low - 1e-9) & (true <= found.found.high + 1e-9)
    speeds = np.array([-1.0, -0.1, 0.1, 1.0])[:, None] + 0 * tau
    had, has = (x.friction(speeds) - x.offset for x in (d, truth))
    worst = (np.abs(had - has) / np.abs(truth.friction(speeds))).max()
    seen = found.found.identifiable
    counts = {"inside": inside.sum(), "of": len(inside), "seen inside": (inside & seen).sum(), "seen": seen.sum()}
    return {"friction - offset, %": 100 * worst, **counts}


def summed(results):
    """Return the worst of the errors and the coverage over all arms."""
    inside, of, seen, known = (sum(r.pop(k) for r in results) for k in ("inside", "of", "seen inside", "seen"))
    worst = {f"worst {k}": f"{max(r[k] for r in results):.2f}" for k in results[0]}
    share = f"{inside}/{of} = {100 * inside / of:.0f} %"
    return worst | {COVERED: f"{share}; identifiable {seen}/{known} = {100 * seen / max(known, 1):.0f} %"}


def covered(lines, state):
    """Return the coverage of all rows together; lines: the page's table, state: its column."""
    shares = [line[state].split(" ")[0].split("/") for name, line in lines.items() if COVERED in name and line[state]]
    inside, of = (sum(int(share[k]) for share in shares) for k in (0, 1))
    return f"{inside}/{of} = {100 * inside / max(of, 1):.1f} %"


def priors():
    """Row 1: link-side torque of arms of any size."""
    return summed([judge(found_in(r := arm(*a), log(r, t := truth_of(r), "measured")), t) for a in ARMS])


def bounds():
    """Row 2: commanded torque; and how many values at a bound count as identifiable."""
    results, wrong = [], 0
    for a in ARMS:
        robot = arm(*a)
        found = found_in(robot, log(robot, truth := truth_of(robot, 1.5, (1.0,)), "commanded"))
        results.append(judge(found, truth))
        edge = np.minimum(*np.abs(found.space.to_unit(found.x) - [[0.0], [1.0]])) < 1e-6
        f = found.found
        wrong += int((edge & f.identifiable).sum() + (f.low > f.x).sum() + (f.high < f.x).sum())
    return summed(results) | {"values at a bound called identifiable, or outside their interval": str(wrong)}


def file_friction():
    """Row 3: damping and frictionloss of the file are five times and a third of the truth.

    A motor current does not separate masses from the motor's constant, so there they are nominal, as in row 4.
    """
    results = []
    for n, largest in (ARMS[1], ARMS[3]):
        file = f'damping="{5 * VISCOUS_SHARE * largest}" frictionloss="{COULOMB_SHARE * largest / 3}"'
        for torque in ("measured", "motor", "commanded"):
            bare = arm(n, largest)
            truth = truth_of(bare, masses=None if torque == "measured" else (1.0,))
            found = found_in(arm(n, largest, file), log(bare, truth, torque, seconds=10.0))
            results.append(judge(found, truth))
    return summed(results)


def wrong_masses():
    """Row 3 again: a motor current and masses 10 to 15 % off, which gains and a payload replace."""
    results = []
    for n, largest in (ARMS[1], ARMS[3]):
        robot = arm(n, largest)
        truth = truth_of(robot, masses=MASS)
        results.append(judge(found_in(robot, log(robot, truth, "motor", seconds=10.0)), truth))
    return summed(results)


def late_signals():
    """Row 4: inertia about each joint axis, of measured and motor torque."""
    out, results = {}, []
    for name, (dq_s, rows) in LATE.items():
        worst = 0.0
        for n, largest in (ARMS[1], ARMS[3]):
            for torque in ("measured", "motor"):
                robot = arm(n, largest, f'armature="{ROTOR * largest}"' if torque == "motor" else "")
                truth = truth_of(robot, masses=None if torque == "measured" else (1.0,))
                found = found_in(robot, delayed(log(robot, truth, torque, seconds=10.0), dq_s, rows))
                results.append(judge(found, with_delay(truth, rows)))
                had, has = (axis_inertia(robot, d) for d in (found.dynamics, truth))
                worst = max(worst, np.abs(had / has - 1).max())
        out[f"{name}: worst inertia about a joint's axis, %"] = f"{100 * worst:.1f}"
    return out | {COVERED: summed(results)[COVERED]}


def delayed(r, dq_s, rows):
    """Return the recording with dq behind a filter of first order (time constant, s) and torque some rows late."""
    keep = np.exp(-1e-3 / dq_s) if dq_s else 0.0
    dq = lfilter([1 - keep], [1, -keep], r.dq, axis=0, zi=keep * r.dq[:1])[0]
    return replace(r, dq=dq, tau=np.concatenate([np.repeat(r.tau[:1], rows, 0), r.tau[: len(r.tau) - rows]]))


def with_delay(truth, rows):
    """Return the truth with the delay of the torque signal; earlier states of r2s have no such parameter."""
    return replace(truth, signal_delay=1e-3 * rows) if hasattr(truth, "signal_delay") else truth


def axis_inertia(robot, d):
    """Return the inertia (n,) kg m^2 of each joint at home, the other joints at rest."""
    model = robot.model(gravity=False)
    set_links(model, d.mass, d.com, d.inertia, d.armature)
    data, out = mujoco.MjData(model), []
    for j in range(robot.n):
        data.qpos[:], data.qvel[:], data.qacc[:] = robot.q_home, 0.0, np.eye(robot.n)[j]
        mujoco.mj_inverse(model, data)
        out.append(data.qfrc_inverse[j])
    return np.array(out)


def ripple():
    """Row 6: link-side torque with a ripple over the angle, by how the motion was recorded."""
    ways = {
        "once": {"seconds": 16.0},
        "six times": {"seconds": 6 * PERIOD_S, "period": PERIOD_S},
        "four times slower": {"seconds": 64.0, "slower": 4.0},
        "30 trajectories of 2 s": {"seconds": 60.0},
    }
    out = {}
    for name, how in ways.items():
        results = []
        for n, largest in ARMS[:2]:
            for seed in range(SEEDS):
                robot = arm(n, largest)
                truth = truth_of(robot)
                r = log(robot, truth, "measured", seed=seed, **how)
                phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, n)
                r = replace(r, tau=r.tau + RIPPLE * COULOMB_SHARE * robot.tau_max * np.sin(PITCH * r.q + phase))
                if "trajectories" in name:
                    index = np.floor(r.t / 2.0 + 1e-9)
                    r = replace(r, t=r.t - 2.0 * index, trajectory=index)
                results.append(judge(found_in(robot, r.in_phase()), truth))
        out[f"motion {name}: {COVERED}"] = summed(results)[COVERED]
    return out


def repeats():
    """Row 7: how much of the validation motion the fit has seen, if repetitions differ by the tracking error."""
    robot = arm(*ARMS[1])
    t = 1e-3 * np.arange(round(1e3 * 6 * PERIOD_S))
    q, dq, _ = motion(robot, t, 0, period=PERIOD_S)
    off = motion(robot, t, 1)[0]
    r = Recording(t, q + TRACKING * (off - off.mean(0)) / off.std(0), dq, 0 * q, "measured").in_phase()
    train, held = (np.unique(np.round(part.t % PERIOD_S, 2)) for part in r.split(0.25))
    share = 100 * np.isin(held, train).mean()
    first, second = (r.select((r.t >= a) & (r.t < a + PERIOD_S)) for a in (0.0, PERIOD_S))
    return {
        "phases of held-out motion that were trained on, %": f"{share:.0f}",
        "a repetition as validation file: motion recognized, %": f"{100 * second.overlap(first):.0f}",
    }


def memory():
    """Row 8: largest resident memory of a process that identifies link-side torque of three joints."""
    pool, out = multiprocessing.get_context("spawn"), {}
    for seconds in (20, 80, 240):
        with pool.Pool(1) as one:
            out[f"{seconds} s at 1 kHz, MB"] = f"{one.apply(memory_of, (seconds,)):.0f}"
    return out


def memory_of(seconds):
    """Identify and return the largest resident memory in MB."""
    robot = arm(*ARMS[1])
    found_in(robot, log(robot, truth_of(robot), "measured", seconds=float(seconds)))
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) * 1024 / 1e6


def payload_limit():
    """Row 9: the part of a payload's moment that the online estimate compensates."""
    x, out, robot = np.zeros(BODY), np.zeros(BODY), arm(*ARMS[3])
    x[:2] = HEAVY, HEAVY * FAR
    robot = replace(robot, payload_max=(HEAVY, FAR)) if hasattr(robot, "payload_max") else robot
    plausible_payload(x, *([np.array(robot.payload_max)] if hasattr(robot, "payload_max") else []), out)
    return {f"{HEAVY:g} kg at {100 * FAR:g} cm, moment compensated, %": f"{100 * out[1] / x[1]:.0f}"}


def pause():
    """Row 10: width of an offset's interval after a pause, over the width before."""
    robot = arm(*ARMS[2])
    model = make_arm_model(robot, truth_of(robot))
    estimator, at = Estimator(model, default_noise(model)), BODY + robot.n
    estimator.internals[0].P[:] *= 1e-4  # as after long motion
    before = estimator.internals[0].P[at, at]
    knows = "pause_s" in inspect.signature(estimator.begin).parameters
    estimator.begin(*[PAUSE_S] * knows)
    ratio = np.sqrt(estimator.internals[0].P[at, at] / before)
    return {f"width of an offset after {PAUSE_S:g} s without rows, times": f"{ratio:.1f}"}


def command_hold():
    """Row 5: a delay of 2 ms, with a command in every row of the log."""
    out = {}
    for hz in RATES:
        errors = []
        for a in ARMS[1:2]:
            robot = arm(*a)
            found = found_in(robot, log(robot, truth_of(robot, masses=(1.0,)), "commanded", hz, 10.0))
            errors.append(1e3 * abs(float(found.dynamics.delay + found.dynamics.lag) - DELAY))
        out[f"error of delay + lag at {hz} Hz, ms"] = f"{max(errors):.3f}"
    return out


def wider(settings):
    """Return settings with three times wider bounds."""
    out = {}
    for name, (low, high) in settings.bounds.items():
        ratio = high / low if name in logarithmic() else 1.0
        out[name] = [low / ratio, high * ratio] if ratio > 1 else [3 * low, 3 * high]
    return replace(settings, bounds=out)


def identifiable():
    """Row 12: parameters whose `identifiable` changes with three times wider bounds."""
    changed, total = 0, 0
    for n, largest in ARMS[:2]:
        robot = arm(n, largest)
        for torque in ("measured", "motor"):
            recording = log(robot, truth_of(robot), torque, seconds=4.0)
            found = [found_in(robot, recording, change) for change in (lambda s: s, wider)]
            seen = [dict(zip(f.space.names, f.found.identifiable, strict=True)) for f in found]
            names = seen[0].keys() | seen[1].keys()  # a term that only one of them keeps has changed, too
            changed += sum(seen[0].get(name) != seen[1].get(name) for name in names)
            total += len(names)
    return {"changed by wider bounds": f"{changed} of {total}"}


ROWS = {"1 priors": priors, "2 bounds": bounds, "3 file": file_friction, "3 masses": wrong_masses}
ROWS |= {"4 late": late_signals, "5 hold": command_hold, "6 ripple": ripple, "7 repeats": repeats, "8 memory": memory}
ROWS |= {"9 payload": payload_limit, "10 pause": pause, "12 identifiable": identifiable}


def written() -> dict[str, str]:
    """Return the column `before` of the page: {row: cell}."""
    page = Path(__file__).parent / "results" / "scaling.md"
    rows = [line.strip("| ").split(" | ") for line in page.read_text().splitlines()]
    return {cells[0]: cells[1] for cells in rows if len(cells) == 3}


def main() -> None:
    """Compute the rows here and in another checkout, and write the page."""
    only = [a.removeprefix("only=") for a in sys.argv[1:] if a.startswith("only=")]
    before = written()
    runs = []
    for folder in (a for a in sys.argv[1:] if "=" not in a and a != "json"):
        copy = shutil.copy(__file__, Path(folder) / "benchmarks")
        command = [sys.executable, copy, "json", *(f"only={o}" for o in only)]
        env = os.environ | {"PYTHONPATH": folder}
        runs.append(subprocess.Popen(command, cwd=folder, env=env, stdout=subprocess.PIPE))
    rows = {name: row() for name, row in ROWS.items() if not only or name in only}
    if "json" in sys.argv:
        print(json.dumps(rows))
        return
    for run in runs:
        rest = json.loads(run.communicate()[0].splitlines()[-1])
        before = {f"{n}: {k}": v for n, r in rest.items() for k, v in r.items()}
    pairs = [(n, k, v) for n, r in rows.items() for k, v in r.items()]
    lines = {f"{n}: {k}": {"before": before.get(f"{n}: {k}", ""), "now": v} for n, k, v in pairs}
    text = (
        f"Arms of {', '.join(f'{n} joints and up to {t:g} Nm' for n, t in ARMS)}; friction, offsets and links are "
        "drawn and known; link-side torque: links as its prior states; motor torque in rows 3 and 4: nominal links, "
        "except in `3 masses`. `before`: commit 8bc76fa. Row 11, new arms of an independent simulator: "
        f"independent.md.\n\n{COVERED}, all rows: {covered(lines, 'now')}; before: {covered(lines, 'before')}."
    )
    table = markdown_rows(lines, "row")
    print(table)
    if not only:
        command = " ".join(["python benchmarks/scaling.py", *["FOLDER"] * bool(runs)])
        write_page("scaling", "Arms of any size", command, [text, table])


if __name__ == "__main__":
    main()
