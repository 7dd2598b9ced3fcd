"""A box on a table: friction in closed form, energy, step halving, both contact solutions, MuJoCo's own free box."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import conf

from r2s.physics.contact import contact_velocity, explicit_contact, near
from r2s.physics.contact_layout import (
    ARM,
    AXES,
    BRISTLE,
    DEPTH,
    FORCE,
    INERTIA,
    LOAD,
    MASS,
    NORMAL,
    POINT,
    REACH,
    ROWS,
    SPIN,
    TIP,
    VELOCITY,
    contact_columns,
)
from r2s.physics.robot import load_robot
from r2s.physics.stick_slip import JointForces
from r2s.physics.surface import Surface, Tool

G, HALF, MU = 9.81, np.array([0.06, 0.05, 0.04]), 0.3
RADIUS, BASE = 0.01, 1e6  # m
PANDA = replace(load_robot(**conf("robot/panda")), tool=Tool(np.zeros(3), RADIUS))


def box(mass=0.8, table=MU, friction=0.0, stiffness=2e4, damping=1.0):
    """Return the contact of a box at the origin; its tip is at the origin of its link."""
    up = np.array([0.0, 0.0, 1.0])
    law = {"stiffness": stiffness, "exponent": 1.0, "damping": damping, "friction": friction}
    surface = Surface(np.zeros(3), up, **law, half=HALF, axes=np.eye(3), mass=mass, table=table)
    contact = contact_columns(PANDA, surface)
    contact[TIP : TIP + 3] = 0.0
    return contact


class Pusher:
    """A sphere of `mass` kg at `place` (2,) m that moves along x and y, on levers of 1000 km."""

    def __init__(self, place, velocity, mass, height=0.0):
        self.place, self.velocity, self.mass = np.array([*place, height]), np.array(velocity, dtype=float), mass

    def step(self, contact, force, h=1e-3, explicit=False):
        """Advance tip and box by a step under a force (2,) N on the tip."""
        anchor = self.place + BASE * np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        axis, jacobian = np.array([[0, 0, 1 / BASE]] * 2), np.zeros((ROWS, 2))
        frame, coming = (self.place, np.eye(3).ravel()), self.velocity + h * np.array(force) / self.mass
        touches = near(contact, frame, anchor, axis, self.velocity, h, jacobian)
        if touches and explicit:
            explicit_contact(contact, jacobian, self.velocity, h)
            coming += h * contact[FORCE : FORCE + 2] / self.mass
        elif touches:
            none = np.zeros((2, 2))
            loads = JointForces(self.velocity, np.array(force, dtype=float), none[0], none, none)
            mass, work = np.array([self.mass, 0.0, self.mass]), np.zeros((10, 2))
            contact_velocity((contact, jacobian), mass, np.zeros(2), h, loads, 1e-9, work, coming)
        self.velocity = coming.copy()
        self.place[:2] += h * coming


def pushed(contact, place=(-0.075, 0.0), velocity=(0.05, 0.0), seconds=1.0, h=1e-3, **how):
    """Push with a tip of 100 t, which does not slow down; return the box's path (T, 3), x, y m and yaw rad."""
    tip, path = Pusher(place, velocity, 1e5), []
    for _ in range(round(seconds / h)):
        tip.step(contact, (0.0, 0.0), h, **how)
        path.append([*contact[POINT : POINT + 2], np.arctan2(contact[AXES + 3], contact[AXES])])
    return np.array(path)


def energy(contact, tip):
    """Return kinetic energy of box and tip, and elastic energy of their contact, J."""
    v, w, depth = contact[VELOCITY : VELOCITY + 3], contact[SPIN], max(contact[DEPTH], 0.0)
    moving = contact[MASS] * v @ v + contact[INERTIA] * w * w + tip.mass * tip.velocity @ tip.velocity
    return 0.5 * (moving + contact[0] * depth**2)


FAR = ((1.0, 0.0), (0.0, 0.0), 1.0)


@pytest.mark.parametrize(("v", "w"), [((0.4, 0.0), 0.0), ((0.3, -0.2), 0.0), ((0.0, 0.0), 5.0)])
def test_a_free_box_slows_down_by_its_friction(v, w):
    """By mu g along a line, by mu m g r / I about its centre, and then it rests for good."""
    contact, tip = box(), Pusher(*FAR)
    contact[VELOCITY : VELOCITY + 2], contact[SPIN] = v, w
    speed, slowing = np.hypot(*v), MU * G
    spinning = MU * contact[MASS] * G * contact[REACH] / contact[INERTIA]
    for k in range(1, 400):
        tip.step(contact, (0, 0))
        assert np.hypot(*contact[VELOCITY : VELOCITY + 2]) == pytest.approx(
            max(speed - k * 1e-3 * slowing, 0), abs=6e-3
        )
        assert contact[SPIN] == pytest.approx(max(w - k * 1e-3 * spinning, 0), abs=6e-3 * spinning / slowing)
    before = contact.copy()
    tip.step(contact, (0, 0))
    np.testing.assert_array_equal(contact, before)
    way = contact[POINT : POINT + 2]
    assert np.hypot(*way) == pytest.approx(speed**2 / (2 * slowing), abs=speed * 1e-3 + 1e-5)  # half a step's speed


def test_translation_and_spin_share_the_friction():
    """Both stop at the same moment if u = (v, r w) is far from an axis: the friction lies on one ellipsoid."""
    contact, tip = box(), Pusher(*FAR)
    contact[VELOCITY], contact[SPIN] = 0.3, 0.3 / contact[REACH]
    tip.step(contact, (0, 0))  # the elastic deflection grows
    before = contact[[VELOCITY, SPIN]].copy()
    tip.step(contact, (0, 0))
    force = contact[MASS] * (before[0] - contact[VELOCITY]) / 1e-3
    moment = contact[INERTIA] * (before[1] - contact[SPIN]) / 1e-3
    load = MU * contact[MASS] * G
    assert force == pytest.approx(load / np.sqrt(2), rel=1e-2)
    assert np.hypot(force, moment / contact[REACH]) == pytest.approx(load, rel=1e-3)


def test_a_push_below_friction_moves_nothing_and_above_it_does():
    """A force that rises to 90 % of mu m g leaves the box at rest, one of 110 % accelerates it by the rest."""
    for share in (0.9, 1.1):
        contact, tip = box(damping=3.0), Pusher((-HALF[0] - RADIUS, 0.0), (0.0, 0.0), 1.0)
        load = MU * contact[MASS] * G
        for k in range(3000):
            tip.step(contact, (min(1.0, k / 2000) * share * load, 0.0))
        if share < 1:
            assert abs(contact[POINT]) < 5e-6
            assert -contact[FORCE] == pytest.approx(share * load, rel=1e-2)
    since = (
        (2000 * (1 - 1 / share) / 2 + 1000) * 1e-3 * 0.1
    )  # s, by which 1 and the mean of the rest act, in load / m
    assert contact[VELOCITY] == pytest.approx(since * load / (1.0 + contact[MASS]), rel=0.02)


@pytest.mark.parametrize("explicit", [False, True])
def test_a_push_through_the_centre_translates(explicit):
    """It is an unstable rest of the rotation: round-off grows to 1e-4 rad."""
    h = 5e-5 if explicit else 1e-3
    path = pushed(box(friction=0.4), seconds=0.8, h=h, explicit=explicit)
    np.testing.assert_allclose(path[:, 1:], 0.0, atol=1e-3)
    assert path[-1, 0] == pytest.approx(0.8 * 0.05 - 0.005, abs=3e-4)  # a gap of 5 mm before; the contact's depth


@pytest.mark.parametrize("offset", [0.01, 0.03, -0.02])
def test_a_push_off_centre_turns_about_the_centre_of_the_limit_surface(offset):
    """Slow, without friction at the tip: velocity is along the force, and w = moment / force / r^2 v in the mean.

    The box oscillates on the spring of the contact.
    """
    contact, tip = box(), Pusher((-HALF[0] - RADIUS, offset), (0.01, 0.0), 1e3)
    turned = expected = 0.0
    for _ in range(400):
        tip.step(contact, (0.0, 0.0))
        n, v = -contact[NORMAL : NORMAL + 2], contact[VELOCITY : VELOCITY + 2]
        lever = contact[ARM] * n[1] - contact[ARM + 1] * n[0]
        turned, expected = turned + contact[SPIN], expected + lever / contact[REACH] ** 2 * (v @ n)
    assert turned == pytest.approx(expected, rel=0.01)
    assert abs(turned) > 10 * abs(offset)


@pytest.mark.parametrize("stiffness", [2e3, 2e4, 1e6])
def test_energy_is_never_created(stiffness):
    """Free tips of 0.3 to 3 kg strike the box anywhere, with and without frictions; what left has less energy."""
    rng = np.random.default_rng(1)
    for table, friction in ((MU, 0.5), (0.0, 0.0), (0.0, 0.5)):
        contact = box(table=table, stiffness=stiffness, friction=friction, damping=0.0)
        velocity = rng.uniform(0.2, 1.0), rng.uniform(-0.3, 0.3)
        tip = Pusher((-0.08, rng.uniform(-0.04, 0.04)), velocity, rng.uniform(0.3, 3))
        first = energy(contact, tip)
        for _ in range(300):
            tip.step(contact, (0, 0))
        assert contact[DEPTH] < 0
        left = energy(contact, tip)
        assert contact[VELOCITY] != 0.0 or table
        assert left < first * (1.0 + 2e-3)  # round-off and the guesses' tolerance
        if table == friction == 0.0:
            assert left > 0.99 * first


def oblique(stiffness, h, explicit=False):
    """Return where an oblique push with friction brings a box."""
    contact = box(friction=0.3, stiffness=stiffness)
    contact[BRISTLE] = 2e-4
    return pushed(contact, (-0.072, 0.02), (0.1, 0.0), 0.5, h, explicit=explicit)[-1]


@pytest.mark.long
@pytest.mark.parametrize("stiffness", [5e3, 1e5])
def test_halving_the_step_converges(stiffness):
    """A push by a point amplifies each error of the yaw. At 1 ms it is within 4 %."""
    exact = oblique(stiffness, 5e-5, explicit=True)
    errors = [np.abs(oblique(stiffness, h) - exact) for h in (1e-3, 2.5e-4, 5e-5)]
    assert errors[0][:2].max() < 5e-4
    assert errors[0][2] < 0.04 * abs(exact[2])
    assert errors[2].max() < 2e-3
    assert errors[2][2] < 0.5 * errors[0][2]


FREE_BOX = """
<mujoco>
  <option timestep="1e-3" cone="elliptic" impratio="100"><flag warmstart="enable"/></option>
  <worldbody>
    <geom type="plane" size="2 2 1" friction="0.3 0 0" condim="3"/>
    <body name="box" pos="0 0 0.04"><freejoint/><geom type="box" size="0.06 0.05 0.04" mass="0.8" friction="0.3 0 0"
      condim="3"/></body>
    <body name="tip" pos="-0.07 0 0.04"><joint type="slide" axis="1 0 0"/><geom type="sphere" size="0.01" mass="1000"
      friction="0 0 0" condim="1" priority="1" solref="-20000 -100"/></body>
  </worldbody>
</mujoco>
"""


def test_a_straight_push_is_that_of_a_free_box_in_mujoco():
    """A tip speeds up to 0.5 m/s in 0.3 s and stops: the box's path, its slide of 42 mm included, within 2 mm."""
    model = mujoco.MjModel.from_xml_string(FREE_BOX)
    model.opt.gravity[:] = 0, 0, -G
    data = mujoco.MjData(model)
    contact, tip = box(), Pusher((-HALF[0] - RADIUS, 0.0), (0.0, 0.0), 1e3)
    other = []
    ours = []
    for k in range(700):
        speed = min(0.5, 0.5 * k / 300) if k < 400 else 0.0
        data.qvel[6] = tip.velocity[0] = speed
        mujoco.mj_step(model, data)
        tip.step(contact, (0.0, 0.0))
        other.append(data.qpos[0])
        ours.append(contact[POINT])
    left = (ours[402] - ours[401]) / 1e-3  # m/s, with which the tip, as a spring, releases the box
    assert ours[-1] - ours[402] == pytest.approx(left**2 / (2 * MU * G), rel=0.01)
    np.testing.assert_allclose(ours, other, atol=2e-3)


def test_a_tip_on_top_loads_the_base():
    """The friction of the table rises with the force on the box's top, and a fixed box is as before."""
    contact, tip = box(friction=0.0), Pusher((0.0, 0.0), (0.0, 0.0), 1.0, height=HALF[2] + RADIUS - 1e-4)
    for _ in range(2):
        tip.step(contact, (0.0, 0.0))
    assert contact[LOAD] == pytest.approx(MU * (contact[MASS] * G + 2e4 * 1e-4), rel=0.01)
