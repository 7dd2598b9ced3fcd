"""gz-sim's Python bindings over DART: the names and the semantics that r2s/engines/gazebo.py relies on, and no more.

A force lasts one step. Positions and velocities are None until their check was enabled and a step has run. A reset is
applied inside the update and integrated through it. Velocity limits are not in the file, so there are none.
"""

from pathlib import Path

import dartpy
import numpy as np


class _Manager:
    """What callbacks get as `ecm`: the world's joints and what was asked of them in this update."""

    def __init__(self, skeleton):
        self.skeleton = skeleton
        self.force, self.reset = {}, {}
        self.checked, self.seen = set(), {}


def world_entity(ecm):
    """Return the entity of the only world."""
    return 1


class World:
    """gz.sim.World."""

    def __init__(self, entity):
        assert entity == 1

    def model_by_name(self, ecm, name):
        """Return the model's entity, 0 where there is none."""
        return 2 if ecm.skeleton.getName() == name else 0


class Model:
    """gz.sim.Model."""

    def __init__(self, entity):
        assert entity == 2

    def joint_by_name(self, ecm, name):
        """Return the joint's entity."""
        return 10 + [j.getName() for j in ecm.skeleton.getJoints()].index(name)


class Joint:
    """gz.sim.Joint."""

    def __init__(self, entity):
        self._dof = entity - 10

    def enable_position_check(self, ecm, on):
        """Have the position read after each step."""
        ecm.checked.add(("q", self._dof))

    def enable_velocity_check(self, ecm, on):
        """Have the velocity read after each step."""
        ecm.checked.add(("dq", self._dof))

    def position(self, ecm):
        """Return [q] rad, or None."""
        return ecm.seen.get(("q", self._dof))

    def velocity(self, ecm):
        """Return [dq] rad/s, or None."""
        return ecm.seen.get(("dq", self._dof))

    def reset_position(self, ecm, q):
        """Put the joint at [q] in this update."""
        assert isinstance(q, list)
        ecm.reset["q", self._dof] = q[0]

    def reset_velocity(self, ecm, dq):
        """Give the joint [dq] in this update."""
        assert isinstance(dq, list)
        ecm.reset["dq", self._dof] = dq[0]

    def set_force(self, ecm, tau):
        """Apply [tau] Nm for this step."""
        assert isinstance(tau, list)
        ecm.force[self._dof] = tau[0]


class _Server:
    def __init__(self, fixture):
        self._fixture = fixture

    def run(self, blocking, iterations, paused):
        """Run so many steps."""
        assert blocking
        assert not paused
        f = self._fixture
        for _ in range(iterations):
            f.ecm.force, f.ecm.reset = {}, {}
            f.before(None, f.ecm)
            skeleton = f.ecm.skeleton
            for (what, dof), value in f.ecm.reset.items():
                (skeleton.setPosition if what == "q" else skeleton.setVelocity)(dof, value)
            skeleton.setCommands(np.array([f.ecm.force.get(i, 0.0) for i in range(skeleton.getNumDofs())]))
            f.world.step()
            now = {"q": skeleton.getPositions(), "dq": skeleton.getVelocities()}
            f.ecm.seen = {key: [now[key[0]][key[1]]] for key in f.ecm.checked}
            f.after(None, f.ecm)


class TestFixture:
    """gz.sim.TestFixture: a server with callbacks, from a world file."""

    __test__ = False  # not one of pytest's

    def __init__(self, path):
        self.world = dartpy.simulation.World()
        old = Path(path).with_name("standin.sdf")  # dartpy reads SDF up to 1.6; only the frame is newer
        old.write_text(Path(path).read_text().replace('version="1.9"', 'version="1.6"'))
        inner = dartpy.utils.SdfParser.readWorld(str(old))
        skeleton = inner.getSkeleton(0)
        dartpy.constraint.JointConstraint.setMaxErrorReductionVelocity(0.0)
        options = dartpy.simulation.DeactivationOptions()
        options.mEnabled = False
        self.world.setDeactivationOptions(options)
        self.world.setTimeStep(1e-3)
        self.world.setGravity([0.0, 0.0, 0.0])
        self.world.addSkeleton(skeleton)
        for joint in skeleton.getJoints():
            joint.setLimitEnforcement(True)
            joint.setActuatorType(dartpy.dynamics.ActuatorType.FORCE)
        self.ecm = _Manager(skeleton)

    def on_pre_update(self, call):
        """Call it before each step."""
        self.before = call
        return self

    def on_post_update(self, call):
        """Call it after each step."""
        self.after = call
        return self

    def finalize(self):
        """Start the server."""

    def server(self):
        """Return the server."""
        return _Server(self)
