"""What a client refuses when it connects, and `r2s check`, against the emulator with each mismatch injected."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from conftest import conf
from served_arms import Bare
from test_emulator import CLIENTS, client  # noqa: F401  (a fixture)

from r2s.arm.clients import computer_check
from r2s.arm.clients.collision_thresholds import thresholds_of
from r2s.arm.clients.computer_check import computer_findings, network_findings
from r2s.arm.clients.connection_check import FR3, PANDA, Connection, gravity_torque
from r2s.arm.clients.fr3 import FR3 as FR3_CLIENT
from r2s.arm.clients.fr3 import within_fr3
from r2s.arm.clients.panda import Panda
from r2s.arm.emulator.control import Control
from r2s.arm.emulator.process import Emulator
from r2s.arm.interface import ArmStopped
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.cli import main
from r2s.errors import UserError
from r2s.physics.payload import mass_and_moment, payload_of
from r2s.physics.push_limit import PushLimit
from r2s.physics.robot import load_robot

HAND = {"m_ee": 0.73, "F_x_Cee": [-0.01, 0.0, 0.03]}  # Franka's Hand
HALF = np.sqrt(0.5)
TURNED = np.array([[HALF, HALF, 0, 0], [-HALF, HALF, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # 45 deg about z
LONGER = np.eye(4) + np.array([[0] * 4, [0] * 4, [0, 0, 0, 0.1034], [0] * 4])


@pytest.fixture(scope="module")
def robot():
    return load_robot(**conf("robot/panda"))


def at_rest(robot, version, desk=None, arm=Bare):
    """Return what a client reads of an emulated arm at rest; panda-python does not pass O_ddP_O on."""
    state = Control(arm(robot), version, desk=desk).state
    read = {k: np.squeeze(state[k].astype(float)) for k in state.dtype.names if k != "O_ddP_O" or version == 10}
    total = read["m_ee"] + read["m_load"]
    moment = read["m_ee"] * read["F_x_Cee"] + read["m_load"] * read["F_x_Cload"]
    return SimpleNamespace(**read, m_total=total, F_x_Ctotal=moment / max(total, 1e-9))


def refused(kind, model, state, version=None, declared=None):
    """Return the findings that do not agree, as the error shows them."""
    found = Connection(kind, payload_of(declared, (3.0, 0.15))).findings(model, version or kind.version, state)
    return [str(f) for f in found if f.refused]


@pytest.mark.parametrize("kind", [PANDA, FR3], ids=lambda kind: kind.name)
@pytest.mark.parametrize(
    ("desk", "line"),
    [
        (HAND, "load: expected 0.000 kg (arm.declared_payload), got 0.730 kg in the arm (m_ee 0.730, m_load 0.000)"),
        ({"m_load": 0.5}, "load: expected 0.000 kg (arm.declared_payload), got 0.500 kg in the arm"),
        ({"F_T_EE": LONGER.T.ravel()}, "with F_T_EE at [0.0000, 0.0000, 0.1034] m): 0.1034 m and 0.00 deg apart"),
        ({"F_T_EE": TURNED.ravel()}, "0.0000 m and 45.00 deg apart, allowed 0.001 m and 0.2 deg"),
        ({"O_ddP_O": [0.0, 9.81 * np.sin(0.3), -9.81 * np.cos(0.3)]}, "gravity"),
    ],
    ids=["hand", "load", "longer", "turned", "tilted"],
)
def test_other_settings_are_refused(desk, line, kind, robot):
    """One line with both values; with the right settings none."""
    found = refused(kind, robot, at_rest(robot, kind.version, desk))
    assert len(found) == 1
    assert line in found[0]
    assert refused(kind, robot, at_rest(robot, kind.version)) == []


@pytest.mark.parametrize("kind", [PANDA, FR3], ids=lambda kind: kind.name)
def test_another_arm_is_refused(kind, robot):
    """A KUKA of seven joints and 320 Nm on a Franka, a model with faster torque, another version, another posture."""
    kuka = kind.within(load_robot(**{**conf("robot/other"), **conf("robot/iiwa14")}))
    state = at_rest(robot, kind.version)
    found = " ".join(refused(kind, kuka, state))
    assert "torque limit, joint 5: expected 110 Nm, got 12 Nm" in found  # 9 times as much; in joint 1 320 and 87 Nm
    assert "end effector: expected" in found
    faster = replace(robot, dtau_max=np.full(7, 2e3))
    assert refused(kind, faster, state) == ["torque rate, joint 1: expected 2000 Nm/s, got 1000 Nm/s"]
    other = refused(kind, robot, state, version=7)
    assert other == [f"FCI version: expected {kind.version} ({kind.name}), got 7"]
    state.q = state.q + 2.3 * np.eye(7)[5]  # 3.87 rad: an FR3's joint 6 can be there
    posture = "posture, joint 6: expected -0.0175 to 3.7525 rad (Panda), got 3.8708 rad"
    assert (posture in refused(kind, robot, state)) == (kind is PANDA)


@pytest.mark.parametrize("kind", [PANDA, FR3], ids=lambda kind: kind.name)
def test_a_declared_load_is_expected_in_the_arm(kind, robot):
    """End effector and load together; a twin's own links and its undeclared payload are no mismatch."""
    declared = {"mass": 0.73, "centre": HAND["F_x_Cee"]}
    assert refused(kind, robot, at_rest(robot, kind.version, HAND), declared=declared) == []
    assert "expected 0.730 kg" in refused(kind, robot, at_rest(robot, kind.version), declared=declared)[0]
    for seed in range(3):
        twin = partial(RigidTwin, seed=seed, payload=1.5)
        assert refused(kind, robot, at_rest(robot, kind.version, arm=twin)) == []


@pytest.mark.long
def test_a_refused_client_is_closed_and_a_check_does_not_move(client, robot):  # noqa: F811
    """With the real packages: one line; the arm's only connection is free again; a check begins no motion."""
    name, make, version = client
    with Emulator(partial(Bare, robot), version=version, desk=HAND) as address:
        with pytest.raises(UserError, match=rf"^arm={name}: load: expected 0.000 kg .*, got 0.730 kg[^\n]*$"):
            make(robot, address)
        arm = make(robot, address, moves=False)
        assert [f.name for f in arm.findings if f.refused] == ["load"]
        with pytest.raises(ArmStopped, match="only for a check"):
            arm.move_to(robot.q_home)
        arm.close()
        arm = make(robot, address, declared_payload={"mass": 0.73, "centre": HAND["F_x_Cee"]})
        assert float(arm.read().m_ee) == pytest.approx(0.73)
        arm.close()


def test_a_robot_of_six_joints_is_one_line_before_any_connection():
    """No client connects, and no threshold is computed, for an arm that is no Franka arm."""
    ur = load_robot(**{**conf("robot/other"), **conf("robot/ur10e")})
    plane = PushLimit(40.0, 0.03, np.zeros(3), np.array([0.0, 0, 1]))
    for make in (lambda: Panda(ur, "nowhere"), lambda: FR3_CLIENT(ur, "nowhere"), lambda: thresholds_of(ur, plane)):
        with pytest.raises(UserError, match=r"^expected 7 joints for a Franka arm, got 6 \(ur10e\)$"):
            make()


def test_limits_lie_inside_the_arms_own(robot):
    """A model with wider limits is clipped; one with narrower ones keeps them."""
    wide = replace(robot, q_min=robot.q_min - 1, q_max=robot.q_max + 1, dq_max=2 * robot.dq_max)
    for used, arm in ((PANDA.within(wide), PANDA), (within_fr3(wide), FR3)):
        assert (used.q_min >= arm.q_min).all()
        assert (used.q_max <= arm.q_max).all()
        assert (used.dq_max <= arm.dq_max).all()
    narrow = replace(robot, q_max=robot.q_max - 0.5)
    np.testing.assert_array_equal(PANDA.within(narrow).q_max, narrow.q_max)
    np.testing.assert_array_equal(PANDA.within(robot).q_max, robot.q_max)


def test_gravity_torque_counts_the_load(robot):
    """The torque is the derivative of the potential energy by the joint angles."""
    load = payload_of({"mass": 1.2, "centre": [0.02, -0.03, 0.05]}, (3.0, 0.15))
    q, model = robot.q_home + 0.3, robot.model(gravity=True)
    data, site = mujoco.MjData(model), model.site(robot.ee_site).id

    def energy(q):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        place = data.site_xpos[site] + data.site_xmat[site].reshape(3, 3) @ load.centre
        return data.energy[0] - load.mass * place @ robot.gravity

    h = 1e-5
    slope = [(energy(q + h * e) - energy(q - h * e)) / (2 * h) for e in np.eye(7)]
    torque = gravity_torque(robot, q, mass_and_moment(robot, load))
    np.testing.assert_allclose(torque, slope, atol=1e-6)  # h^2, and round-off of 50 J over h


def test_lost_states_and_gaps_are_counted():
    """One state in a hundred may be lost; 20 ms without one would stop a motion."""
    t = 1e-3 * np.arange(1000)
    found = {f.name: f for f in network_findings(t, t + 1.0)}
    assert found["lost states"].found == "0 of 999"
    assert not any(f.refused for f in found.values())
    some = np.delete(t, np.arange(10, 900, 50))
    found = {f.name: f for f in network_findings(some, some)}
    assert found["lost states"].found == "18 of 999"
    assert found["lost states"].refused
    late = t + np.where(t > 0.5, 0.025, 0)
    found = {f.name: f for f in network_findings(t, late)}
    assert (found["longest gap"].found, found["longest gap"].refused) == ("26.0 ms", True)
    assert not found["lost states"].refused
    assert network_findings(t[:1], t[:1])[0].refused


def test_only_real_time_needs_a_real_time_kernel(tmp_path, monkeypatch):
    """Without one, arm.realtime=true is refused; arm.realtime=false is not."""
    monkeypatch.setattr(computer_check, "REALTIME", tmp_path / "realtime")
    assert computer_findings(True)[0].refused
    assert not any(f.refused for f in computer_findings(False))
    (tmp_path / "realtime").write_text("1\n")
    assert not computer_findings(True)[0].refused
    assert computer_findings(True)[0].found.startswith("real-time")


def checked(words, monkeypatch, capsys):
    """Return exit status, page and error line of `r2s check` with these words."""
    monkeypatch.setattr("sys.argv", ["r2s", "check", *words])
    status = 0
    try:
        main()
    except SystemExit as end:
        status = end.code
    printed = capsys.readouterr()
    return status, printed.out, printed.err


@pytest.mark.long
def test_r2s_check_prints_a_page_and_moves_nothing(client, robot, monkeypatch, capsys):  # noqa: F811
    """Exit status 0 with the right settings; 2 and the reason with wrong ones, after the same page."""
    name, _, version = client
    for desk, status in ({}, 0), ({"m_ee": 0.73}, 2):
        with Emulator(partial(Bare, robot), version=version, desk=desk) as address:
            words = [f"arm={name}", f"arm.address={address}", "arm.realtime=false", "--seconds", "0"]
            found, page, error = checked(words, monkeypatch, capsys)
        assert found == status, error
        for row in ("FCI version", "mode", "torque limit", "end effector", "load", "gravity", "kernel", "scheduler"):
            assert row in page
        assert ("REFUSED" in page) == bool(status)
        assert error.startswith(f"error: arm={name} is refused: load: expected 0.000 kg" if status else "")
        assert error.count("\n") == bool(status)


@pytest.mark.long
@pytest.mark.parametrize("name", ["panda", pytest.param("fr3", marks=pytest.mark.slow)])
def test_r2s_check_reads_states(name, robot, monkeypatch, capsys):
    """In real time it counts the states of an idle arm; a loaded machine may lose some."""
    package, _, version = CLIENTS[name]
    pytest.importorskip(package)
    with Emulator(partial(Bare, robot), version=version, realtime=True) as address:
        words = [f"arm={name}", f"arm.address={address}", "arm.realtime=false", "--seconds", "1"]
        _, page, _ = checked(words, monkeypatch, capsys)
    assert "period of the states" in page
    assert "longest gap" in page
    assert "lost states" in page


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["arm=twin"], "error: check: arm=twin has no connection; allowed: panda"),
        (["arm=panda", "seed=3"], "error: check: expected arm=, robot= and their keys, got 'seed=3'"),
        (["arm=panda", "arm.adress=1"], "error: unknown option 'arm.adress'; did you mean 'arm.address'?"),
        (["arm=panda"], "error: arm.address must be given: arm.address=..."),
    ],
)
def test_a_wrong_check_is_one_line(words, line, monkeypatch, capsys):
    status, _, error = checked(words, monkeypatch, capsys)
    assert status == 2
    assert error.startswith(line)
    assert error.count("\n") == 1
