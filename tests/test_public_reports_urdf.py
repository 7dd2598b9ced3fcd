"""Robot files with the faults of public reports: each is read as it was meant, or one line names the fault.

Each row names the report, on GitHub, that describes the fault; the files here are made.
"""

# ruff: noqa: F811 (the arguments are fixtures of made_logs.py)

import numpy as np
import pytest
from made_logs import ur  # noqa: F401 (a fixture)

from r2s.errors import UserError
from r2s.physics.description import write_urdf
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.rigid_body import mujoco_inverse_dynamics
from r2s.physics.robot import load_robot

FRICTIONLESS = {"phi1": 0.0, "phi2": 10.0, "phi3": 0.0}
URDF = {  # name: (report, change of the text of a URDF, arguments, words of the error, or None: nothing changes)
    "no torque": ("dexsuite/dex-urdf#29", ('effort="150.0"', 'effort="0"'), {}, "robot.tau_max: no torque limit of"),
    "one torque for all": (
        "ros-industrial/universal_robot#32",
        ("", ""),
        {"tau_max": [10.0] * 6},
        "joint 2 would need",
    ),
    "42.9 kg for 7.2": (
        "JAKARobotics/jaka_ros2#15",
        ("MASS2", "77.6"),
        {},
        "has 77.6 kg, all other links together have",
    ),
    "46 kg of a first link": (
        "lbr-stack/lbr_fri_ros2_stack#18",
        ("MASS1", "46.0"),
        {},
        "has 46 kg, all other links together have 20.9 kg",
    ),
    "a placeholder": ("Genesis-Embodied-AI/genesis-world#3185", ("MASS3", "0.001"), {}, "a placeholder?"),
    "moments of 1": ("turtlebot/turtlebot_arm#20", ("MOMENT", "100.0"), {}, "as if it were longer than the arm"),
    "no mass": ("userguide-galaxea/URDF#5", ("MASS3", "0.0"), {}, "expected an <inertial> with a mass"),
    "no body has such moments": (
        "Gepetto/example-robot-data#130",
        ("MOMENT", "0.2"),
        {},
        "none above the sum of the others",
    ),
    "decimal commas": ("ros/urdfdom#98", ('xyz="0.0 0.0 ', 'xyz="0,0 0,0 '), {}, "expected 3 numbers in xyz"),
    "limits of 0 to 0": (
        "gkjohnson/urdf-loaders#9",
        ("LIMIT", 'lower="0" upper="0"'),
        {},
        "to 0 to 0 rad: set robot.q",
    ),
    "limits in degrees": ("dfki-ric/phobos#37", ("LIMIT", 'lower="-90" upper="90"'), {}, "are they in degrees?"),
    "soft limits of 0": (
        "ros-industrial/motoman#29",
        ("<axis", '<safety_controller soft_lower_limit="0" soft_upper_limit="0" k_velocity="0"/><axis'),
        {},
        None,
    ),
    "a space before a number": ("openrr/urdf-rs#105", ('effort="', 'effort=" '), {}, None),
    "nine moments": ("fetchrobotics/fetch_ros#14", ("<inertia ", '<inertia iyx="1" '), {}, None),
    "a velocity of -1": ("osrf/drcsim#287", ("VELOCITY", 'velocity="-1"'), {}, None),
    "a mimic joint": (
        "google-deepmind/mujoco#3527",
        ("<axis", '<mimic joint="elbow_joint"/><axis'),
        {},
        "robot.lock={",
    ),
}


@pytest.fixture(scope="module")
def urdf(ur, tmp_path_factory):
    """Return the text of a UR10e's URDF."""
    path = tmp_path_factory.mktemp("urdf") / "arm.urdf"
    write_urdf(path, ur, nominal_dynamics(ur, **FRICTIONLESS))
    return path.read_text()


def marked(urdf, old, new, ur):
    """Replace a part of a URDF; some are marked by what they are."""
    if old.startswith("MASS"):
        old = f'<mass value="{float(ur.mass[int(old[4:]) - 1])!r}"'
        new = f'<mass value="{new}"'
    elif old == "MOMENT":
        old, new = f'ixx="{float(ur.inertia[2, 0, 0])!r}"', f'ixx="{new}"'
        if float(new[5:-1]) > 50:
            tensor = [float(ur.inertia[2, i, i]) for i in (1, 2)]
            old += f' iyy="{tensor[0]!r}" izz="{tensor[1]!r}"'
            new += ' iyy="100" izz="100"'
    elif old == "LIMIT":
        old = f'lower="{float(ur.q_min[2])!r}" upper="{float(ur.q_max[2])!r}"'
    elif old == "VELOCITY":
        old = f'velocity="{float(ur.dq_max[0])!r}"'
    assert old in urdf
    return urdf.replace(old, new)


@pytest.mark.parametrize("name", URDF)
def test_a_urdf_of_a_public_report(tmp_path, ur, urdf, name):
    _, (old, new), arguments, expected = URDF[name]
    path = tmp_path / "arm.urdf"
    path.write_text(marked(urdf, old, new, ur))
    how = {"q_home": ur.q_home.tolist(), **arguments}
    if expected is not None:
        with pytest.raises(UserError) as caught:
            load_robot(str(path), **how)
        assert expected in str(caught.value)
        assert "\n" not in str(caught.value)
        return
    rng = np.random.default_rng(0)
    at = rng.uniform(*ur.q_range, (20, 6)), *rng.normal(size=(2, 20, 6))
    ours, theirs = (
        mujoco_inverse_dynamics(robot.model(gravity=True), *at) for robot in (load_robot(str(path), **how), ur)
    )
    np.testing.assert_allclose(ours, theirs, atol=1e-9 * np.abs(theirs).max())
