"""A made recording of a UR10e, and how loggers write it: names, orders, separators, topics, held and swapped rows."""

import io
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from conftest import conf

from r2s.physics.rigid_body import mujoco_inverse_dynamics
from r2s.physics.robot import load_robot
from r2s.recordings.recording import Recording

UR = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
JOINTS = [f"{name}_joint" for name in UR]
ALPHABET = np.argsort(JOINTS)


@pytest.fixture(scope="module")
def ur():
    return load_robot(**conf("robot/ur10e"))


def moved(robot, torque="measured", gravity=None, rate=250.0, seconds=6.0):
    """Return a recording of sines about home: inverse dynamics, Coulomb and viscous friction, offsets, noise."""
    t, n, rng = np.arange(0, seconds, 1 / rate), robot.n, np.random.default_rng(0)
    w, a = np.array([1.2, 1.3, 1.0, 1.6, 1.7, 1.4, 1.9])[:n], np.array([0.5, 0.4, 0.5, 0.4, 0.5, 0.5, 0.6])[:n]
    phase = np.outer(t, w) + np.arange(n)
    q, dq, ddq = robot.q_home + a * np.sin(phase), a * w * np.cos(phase), -a * w**2 * np.sin(phase)
    model = robot.model(gravity=torque != "commanded")
    if gravity is not None:
        model.opt.gravity[:] = gravity
    tau = mujoco_inverse_dynamics(model, q, dq, ddq)
    tau += 0.02 * robot.tau_max * (np.tanh(dq / 0.02) + 0.3 * dq + 0.3)
    q, dq, tau = (x + s * rng.standard_normal(x.shape) for x, s in ((q, 1e-5), (dq, 3e-3), (tau, 0.05)))
    return Recording(t, q, dq, tau, torque)


def columns(r, names=None, order=range(6), form="{field}{joint}"):
    """Return the columns of a log by name."""
    named = names or [str(j + 1) for j in range(6)]
    out = {"t": r.t}
    for field in ("q", "dq", "tau"):
        for j, name in zip(order, [named[k] for k in order] if names else named, strict=True):
            out[form.format(field=field, joint=name)] = getattr(r, field)[:, j]
    return out


def text(table, **how):
    """Return a table as CSV."""
    out = io.StringIO()
    pd.DataFrame(table).to_csv(out, index=False, **{"float_format": "%.9g", **how})
    return out.getvalue()


def with_row(r, row, **values):
    """Return the columns of a log with other values in one row."""
    changed = {}
    for field, value in values.items():
        changed[field] = getattr(r, field).copy()
        changed[field][row] = value
    return columns(replace(r, **changed))


def rows(table, index):
    return {k: v[index] for k, v in table.items()}


def swapped(count, at):
    index = np.arange(count)
    index[[at, at + 1]] = at + 1, at
    return index


def rostopic(r, order, period=4):
    """Return `rostopic echo -p` of a JointState topic."""
    stamp = 1_700_000_000_000_000_000 + np.round(1e9 * r.t).astype(np.int64)
    out = {"%time": stamp + 1000, "field.header.seq": np.arange(len(r.t)), "field.header.stamp": stamp}
    out |= {f"field.name{k}": np.full(len(r.t), JOINTS[j]) for k, j in enumerate(order)}
    for field, name in (("q", "position"), ("dq", "velocity"), ("tau", "effort")):
        out |= {f"field.{name}{k}": getattr(r, field)[:, j] for k, j in enumerate(order)}
    return text(out, float_format="%.12g")


def held(r, every):
    """Return the columns of a log in which values are repeated `every` rows."""
    at = (np.arange(len(r.t)) // every) * every
    return columns(replace(r, **{k: getattr(r, k)[at] for k in ("q", "dq", "tau")}))


def decimal_comma(r):
    lines = text(columns(r), sep=";").replace(".", ",").splitlines()
    return "\n".join([lines[0], *lines[1:]])


def savetxt(r, **how):
    out, table = io.StringIO(), columns(r)
    np.savetxt(out, np.column_stack(list(table.values())), fmt="%.9g", **how)
    return out.getvalue()
