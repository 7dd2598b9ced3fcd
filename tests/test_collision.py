"""Collision checks agree with MuJoCo's collision detection for every shape and every arm of the package."""

import mujoco
import numpy as np
import pytest
from conftest import conf

from r2s.errors import UserError
from r2s.physics.collision import CollisionCheck, collision_pairs
from r2s.physics.robot import load_robot

BAND_M = 1e-4  # about the boundary, where two iterations may disagree
MESH = " ".join(f"{x * s} {y * s} {z}" for x in (-1, 1) for y in (-1, 1) for z, s in ((0, 0.06), (0.1, 0.02)))
GEOMS = {
    "sphere": 'type="sphere" size="0.06"',
    "capsule": 'type="capsule" size="0.04 0.08"',
    "cylinder": 'type="cylinder" size="0.05 0.07"',
    "box": 'type="box" size="0.05 0.03 0.08"',
    "ellipsoid": 'type="ellipsoid" size="0.03 0.05 0.09"',
    "mesh": 'type="mesh" mesh="hull"',
}
SHAPES = """
<mujoco model="shapes">
  <compiler angle="radian"/>
  <asset><mesh name="hull" vertex="{mesh}"/></asset>
  <worldbody>
    <body name="a" pos="0 0 0.5"><inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
      <joint axis="1 0 0.2" range="-3 3" actuatorfrcrange="-9 9"/>
      <geom {one} pos="0 0.03 0.02" euler="0.3 0.5 0.1"/>
      <body name="b" pos="0 0 0.16"><inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
        <joint axis="0 1 0" range="-3 3" actuatorfrcrange="-9 9" pos="0.02 0 0"/>
        <body name="c" pos="0.04 0 0.15"><inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
          <joint axis="1 0.5 0" range="-3 3" actuatorfrcrange="-9 9"/>
          <geom {other} pos="0.02 0 0.16" euler="0.2 -0.4 0.7"/>
          <site name="tip" pos="0 0 0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def compare(robot, count, seed=0):
    """Compare with MuJoCo's contacts at random postures; return how many touched."""
    model = robot.model(gravity=False)
    pairs = collision_pairs(robot, model).pairs
    geoms = sorted({g for pair in pairs for g in pair})
    model.geom_contype[:] = model.geom_conaffinity[:] = 0
    model.geom_contype[geoms] = model.geom_conaffinity[geoms] = 1
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data, seen = mujoco.MjData(model), 0
    touches = CollisionCheck(robot, table=-np.inf)
    q = np.random.default_rng(seed).uniform(*robot.q_range, (count, robot.n))
    first, itself = touches.first_contact(q), touches(q)
    assert np.array_equal(itself, first >= 0)
    for posture, which in zip(q, first, strict=True):
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        found = {tuple(sorted(pair)): d for pair, d in zip(data.contact.geom, data.contact.dist, strict=True)}
        deep = {pair: d for pair, d in found.items() if pair in pairs}
        if any(d < -BAND_M for d in deep.values()):
            assert which >= 0
        if which >= 0:
            assert mujoco.mj_geomDistance(model, data, *pairs[which], 1.0, None) < BAND_M
        seen += which >= 0
    return seen


@pytest.mark.parametrize("name", ["panda", "ur10e", "xarm7", "kinova_gen3", "iiwa14"])
def test_self_collision_agrees_with_mujoco(name):
    assert compare(load_robot(**conf(f"robot/{name}")), 300) > 0


@pytest.mark.parametrize("one", GEOMS)
@pytest.mark.parametrize("other", GEOMS)
def test_every_pair_of_shapes(one, other, tmp_path):
    path = tmp_path / "shapes.xml"
    path.write_text(SHAPES.format(mesh=MESH, one=GEOMS[one], other=GEOMS[other]))
    assert compare(load_robot(str(path), q_home=[0, 0, 0]), 200) > 0


def test_the_table():
    """A link below the table touches it; a table that touches the arm at home is refused."""
    robot = load_robot(**conf("robot/panda"))
    touches = CollisionCheck(robot)
    down = np.array([0.0, 1.7, 0, -1.9, 0, 2.2, 0.8])
    k = int(touches.first_contact(down[None])[0])
    assert "and the table" in touches.names[k]
    assert not CollisionCheck(robot, table=-np.inf)(down[None])[0]
    with pytest.raises(UserError, match=r"panda: link 'link\d' and the table at 0.6 m touch at robot.q_home"):
        CollisionCheck(robot, table=0.6)


def test_pairs_that_may_touch_are_not_checked():
    """`may_touch` removes a body and the table, or two bodies, from the check."""
    robot = load_robot(**conf("robot/panda"))
    links, table = ("link5", "link1"), ("link7", "table")
    check = CollisionCheck(robot)
    less = CollisionCheck(robot, may_touch=[links, table])
    removed = set(check.names) - set(less.names)
    assert removed == {"link 'link1' and link 'link5'", "link 'link7' and the table"}
