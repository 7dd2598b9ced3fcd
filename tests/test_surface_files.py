"""A surface beside the arm in MJCF and SDF: MuJoCo presses as deep as the surface, DART finds it where it is."""

import dartpy
import mujoco
import numpy as np
import pytest
from test_press import FRICTIONLESS, PANDA, N

from r2s.identification.contact.exchange import linearized, write_surface
from r2s.physics.description import write_description
from r2s.physics.surface import Surface
from r2s.physics.tip import Tip, nominal_plane

POINT = nominal_plane(PANDA)[0]
NORMAL = np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
ACROSS = np.cross(NORMAL, [0.0, 1.0, 0.0]) / np.linalg.norm(np.cross(NORMAL, [0.0, 1.0, 0.0]))
HALF = np.array([0.2, 0.3, 0.05])
LOAD = 10.0  # N, at which the files are exact
SURFACES = {
    "plane": Surface(POINT, NORMAL, 8e3, 1.5, 2.0, 0.3),
    "box": Surface(
        POINT - HALF[2] * NORMAL, NORMAL, 2e4, 1.0, 2.0, 0.3, half=HALF,
        axes=np.stack([ACROSS, np.cross(NORMAL, ACROSS), NORMAL], -1),
    ),
}  # fmt: skip


@pytest.fixture(params=SURFACES)
def files(request, tmp_path):
    """Return the folder of the files, and the surface in them."""
    assert write_description(tmp_path / "model", PANDA, FRICTIONLESS) == []
    write_surface(tmp_path / "model", PANDA, SURFACES[request.param])
    return tmp_path / "model", SURFACES[request.param]


def test_mujoco_presses_as_deep_as_the_surface(files):
    """The written arm, pushed with 10 N against the normal and held across it."""
    folder, surface = files
    model = mujoco.MjModel.from_xml_path(str(folder / "arm.xml"))
    model.opt.gravity[:], model.dof_damping[:] = 0.0, 3.0
    data, tip, jacobian = mujoco.MjData(model), model.geom("tip").id, np.zeros((3, N))
    q = Tip(PANDA).posture(POINT + (PANDA.tool.radius + 1e-4) * NORMAL)
    data.qpos[:] = q
    for _ in range(8000):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[tip], model.geom_bodyid[tip])
        row = NORMAL @ jacobian
        data.qfrc_applied[:] = 20.0 * (np.eye(N) - np.outer(row, row) / (row @ row)) @ (q - data.qpos) - LOAD * row
        mujoco.mj_step(model, data)
    depth = PANDA.tool.radius - (data.geom_xpos[tip] - POINT) @ NORMAL
    assert data.ncon == 1
    # it creeps across the normal at 1e-5 rad/s against 3 Nms/rad: 1e-4 of the load
    assert depth == pytest.approx((LOAD / surface.coefficient) ** (1 / surface.exponent), rel=3e-3)


def test_dart_finds_tip_and_surface(files, tmp_path):
    """The tip at its place on the arm, and the solid `deeper` below the surface, with the surface's axes."""
    folder, surface = files
    read = {}
    for name in ("arm", "surface"):
        text = (folder / f"{name}.sdf").read_text().replace('version="1.9"', 'version="1.6"')  # what dartpy reads
        (tmp_path / f"{name}.sdf").write_text(text)
        read[name] = dartpy.utils.SdfParser.readSkeleton(str(tmp_path / f"{name}.sdf"))
    solid = read["surface"].getBodyNode(0).getWorldTransform()
    np.testing.assert_allclose(solid.rotation()[:, 2], NORMAL, atol=1e-9)
    np.testing.assert_allclose(solid.translation(), surface.point - linearized(surface)[2] * NORMAL, atol=1e-9)
    assert not read["surface"].isMobile()
    if surface.half is not None:
        (shape,) = read["surface"].getBodyNode(0).getShapeNodes()
        np.testing.assert_allclose(shape.getShape().getSize(), 2 * HALF)
    q = PANDA.q_home + 0.1
    read["arm"].setPositions(q)
    (sphere,) = read["arm"].getBodyNode(N - 1).getShapeNodes()
    np.testing.assert_allclose(sphere.getWorldTransform().translation(), Tip(PANDA)(q)[0], atol=1e-9)
    assert sphere.getShape().getRadius() == PANDA.tool.radius
    slope, damping, _ = linearized(surface)
    assert f"<kp>{slope:.6g}</kp><kd>{damping:.6g}</kd>" in (folder / "surface.sdf").read_text().replace(
        "\n", ""
    ).replace(" ", "")
