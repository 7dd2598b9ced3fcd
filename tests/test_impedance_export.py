"""Impedance control in C++ and in a bundle is the law of r2s, to round-off."""

import subprocess

import numpy as np
import pytest
from made_bundles import COMPILER, LAW_NM, LIBFRANKA, ROUNDINGS, compare, drawn, hostile, loaded
from test_impedance import FRICTIONLESS, PANDA, REACH, N, Pose
from test_impedance_feedforward import bristle_model, random_model

from r2s import commands
from r2s.control.impedance import cartesian_impedance, joint_impedance
from r2s.errors import UserError
from r2s.export.bundle import law_source
from r2s.export.contract import check_exportable
from r2s.physics import impedance as law
from r2s.tasks.track import TrackTask
from r2s.tasks.wipe import WipeTask

CONTROLS = {
    "cartesian": lambda model: cartesian_impedance(PANDA, REACH, model),
    "pose": lambda model: cartesian_impedance(PANDA, Pose(), model, action="both", rotational_stiffness=5.0),
    "hybrid": lambda model: cartesian_impedance(
        PANDA, Pose(), model, action="both", hybrid=True, normal=[0, 0, 1], force=5.0
    ),
    "sliding": lambda model: cartesian_impedance(PANDA, WipeTask(), model, hybrid=True, integral_rate=8.0),
    "joint": lambda model: joint_impedance(PANDA, REACH, model, action="both"),
    "joint path": lambda model: joint_impedance(PANDA, TrackTask(pool=2), model, action="stiffness"),
    "bristles": lambda model: cartesian_impedance(PANDA, WipeTask(), bristle_model(mass=model.mass), hybrid=True),
}


def stream(control, cycles=1000):
    """Return q, dq, command (cycles, ...), new commands each 20 cycles, and where motions begin."""
    rng, rows = np.random.default_rng(3), cycles // 20
    action = control.action_offset + control.action_scale * rng.uniform(-1.2, 1.2, (rows, control.action_dim))
    given = rng.normal(0, 0.4, (rows, control.setpoint_size))
    if control.hybrid:
        contact = slice(control.target_size, control.target_size + 6)
        given[:, contact] = [0.0, 0.6, 0.8, 5.0, 3.0, 1.0] + np.array([0, 0, 0, 1, 3, 0]) * rng.normal(size=(rows, 1))
    command = np.repeat(np.concatenate([action, given], axis=1), 20, axis=0)
    q = PANDA.q_home + rng.uniform(-0.1, 0.1, (cycles, N)) + np.repeat(rng.uniform(-0.5, 0.5, (rows, N)), 20, axis=0)
    return q, 0.3 * rng.normal(size=(cycles, N)), command, np.arange(cycles) % 400 == 0


def by_law(run, control, motion):
    """Return torque and level of the tank (cycles, n + 1) of a law over a stream."""
    memory, rows = np.zeros(control.memory_size), np.empty((len(motion[0]), N + 1))
    for k, (q, dq, command, begin) in enumerate(zip(*motion, strict=True)):
        memory[:] = 0.0 if begin else memory
        run(q, dq, command, control.parameters, memory, rows[k, :N])
        rows[k, N] = memory[law.LEVEL]
    return rows


MAIN = """
}} }}
int main() {{
  double x[2 * contract::n + {c} + 1], memory[{k}] = {{}}, out[contract::n];
  while (std::fread(x, sizeof *x, 2 * contract::n + {c} + 1, stdin) == 2 * contract::n + {c} + 1) {{
    if (x[2 * contract::n + {c}] > 0) for (double& m : memory) m = 0.0;
    contract::control_law(x, x + contract::n, x + 2 * contract::n, memory, out);
    std::fwrite(out, sizeof *out, contract::n, stdout);
    std::fwrite(memory + {level}, sizeof *out, 1, stdout);
  }}
}}
"""


@pytest.mark.long
@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here")
@pytest.mark.parametrize("name", CONTROLS)
def test_the_law_in_cpp_is_that_of_python(name, tmp_path):
    """Torque and tank over a random stream, to round-off."""
    control = CONTROLS[name](random_model())
    motion = stream(control)
    parameters = ", ".join(repr(float(x)) for x in control.parameters)
    head = f"#include <cmath>\n#include <cstdio>\nnamespace contract {{\nconstexpr int n = {N};\n"
    head += f"constexpr double parameters[] = {{{parameters}}};\ninline void control_law("
    head += "const double* q, const double* dq, const double* command, double* memory, double* out) {\n"
    end = MAIN.format(c=control.command_size, k=control.memory_size, level=law.LEVEL)
    (tmp_path / "check.cpp").write_text(head + control.cpp + end)
    words = [
        str(COMPILER),
        "-std=c++17",
        "-O1",
        "-Wall",
        "-Wextra",
        "-Wpedantic",
        "-Werror",
        "check.cpp",
        "-o",
        "check",
    ]
    subprocess.run(words, cwd=tmp_path, check=True)
    rows = np.ascontiguousarray(np.column_stack(motion), dtype=float)
    done = subprocess.run([tmp_path / "check"], input=rows.tobytes(), capture_output=True, check=True)
    got, wanted = np.frombuffer(done.stdout).reshape(len(rows), -1), by_law(control.law, control, motion)
    assert np.ptp(wanted[:, N]) > 0.1 or control.action == "target"
    assert np.abs(got - wanted).max() < LAW_NM


@pytest.mark.parametrize("name", CONTROLS)
def test_the_law_of_a_bundle_is_that_of_r2s(name):
    """Its source needs NumPy alone."""
    control = CONTROLS[name](random_model())
    motion, names = stream(control, 60), {"np": np}
    call, source = law_source(control.law)
    exec(source, names)
    assert np.abs(by_law(eval(call, names), control, motion) - by_law(control.law, control, motion)).max() < LAW_NM


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The bundle of a policy that sets target and stiffness of reaching."""
    run = tmp_path_factory.mktemp("runs") / "train" / "impedance"
    made = drawn(run, "control=cartesian_impedance", "control.action=both")
    commands.run_command(["export", str(run)])
    return made


def test_a_bundle_does_what_r2s_does(exported):
    assert compare(exported, loaded(exported.folder), hostile(exported.robot, exported.task, 300)) < ROUNDINGS


@pytest.mark.slow
def test_it_does_so_for_ten_thousand_cycles(exported):
    assert compare(exported, loaded(exported.folder), hostile(exported.robot, exported.task, 10_000)) < ROUNDINGS


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here")
def test_the_header_of_a_bundle_compiles(exported, tmp_path):
    (tmp_path / "check.cpp").write_text(
        '#include "law.hpp"\nstatic_assert(contract::setpoints == 3);\nint main() { law::Driver driver; }\n'
    )
    words = [str(COMPILER), "-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run([*words, "-I", str(LIBFRANKA), "-I", str(exported.folder), "check.cpp"], cwd=tmp_path, check=True)


def test_hybrid_control_is_not_exported():
    task = REACH.controlled_by(
        cartesian_impedance(PANDA, REACH, FRICTIONLESS, hybrid=True, normal=[0, 0, 1], force=5.0)
    )
    with pytest.raises(UserError, match="export: control=hybrid takes setpoints"):
        check_exportable(PANDA, task)
