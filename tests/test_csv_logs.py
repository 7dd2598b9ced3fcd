"""CSV logs of libfranka and of others are read as they are."""

import numpy as np
import pandas as pd
import pytest
from test_readers import assert_motion, message, motion

from r2s.recordings.readers import read


def libfranka_log(path, sep=", ", rows=300):
    """Write what `franka::logToCSV` writes: time in ms, a state beside the command of the cycle before it."""
    _, q, dq, tau_J, command = motion(rows + 1, jitter=0)
    columns = {"state.q": q[1:], "state.q_d": q[1:] + 1, "state.dq": dq[1:], "state.dq_d": dq[1:] + 1}
    columns |= {"state.tau_J": tau_J[1:], "state.tau_ext_hat_filtered": 0 * q[1:], "cmd.q_d": 0 * q[1:]}
    columns |= {"cmd.dq_d": 0 * q[1:], "cmd.O_T_EE_d": np.zeros((rows, 16)), "cmd.O_dP_EE_d": np.zeros((rows, 6))}
    columns |= {"cmd.tau_J_d": command[:-1]}
    header = ",".join(sep.join(f"{name}[{i}]" for i in range(x.shape[1])) for name, x in columns.items())
    times = 81234 + np.arange(rows)
    lines = [f"time{sep}success_rate{sep}{header}"]
    for k, row in enumerate(np.concatenate(list(columns.values()), axis=1)):
        lines.append(f"{times[k]},1," + ",".join(repr(float(x)) for x in row))
    path.write_text("\n".join(lines) + "\n")
    return q[1:], dq[1:], tau_J[1:], command[1:]


@pytest.mark.parametrize("sep", [", ", ","])  # older and newer versions
def test_libfranka_logs(tmp_path, sep):
    """Milliseconds become seconds; `torque` picks tau_J, or the command that was sent from the state of a row."""
    path = tmp_path / "log.csv"
    q, dq, tau_J, command = libfranka_log(path, sep)
    columns = {"t": "t", "q": "q", "dq": "dq", "tau": None, "trajectory": None}  # as conf/data/recording.yaml has it
    measured = read(path, torque="measured", columns=columns, n_joints=7)
    np.testing.assert_allclose(measured.t, 81.234 + 1e-3 * np.arange(300), rtol=0, atol=1e-9)
    for field, x in (("q", q), ("dq", dq), ("tau", tau_J)):
        np.testing.assert_array_equal(getattr(measured, field), x)
    commanded = read(path, torque="commanded", columns=columns)
    np.testing.assert_allclose(commanded.tau[:-1], command[:-1], rtol=0, atol=1e-6)
    desired = read(path, torque="measured", columns={"q": "state.q_d"})  # any other column by its own name
    np.testing.assert_array_equal(desired.q, q + 1)


def test_a_libfranka_log_of_position_control_holds_no_command(tmp_path):
    path = tmp_path / "log.csv"
    libfranka_log(path)
    frame = pd.read_csv(path, skipinitialspace=True)
    frame[[f"cmd.tau_J_d[{i}]" for i in range(7)]] = 0.0
    frame.to_csv(path, index=False)
    assert message(read, path, torque="commanded") == (
        f"{path}: tau (tau_J_d) is 0 in every row: this log holds no commanded torque"
    )
    read(path, torque="measured")
    with open(path, "a") as file:
        file.write("cut off,here\n")
    assert "column 't': expected numbers, got 'cut off' at row 300" in message(read, path, torque="measured")


@pytest.mark.parametrize("joint", ["{}{}", "{}_{}", "{}[{}]"])
def test_wide_csv_from_zero(tmp_path, joint):
    ns, q, dq, tau, _ = motion()
    table = {"t": ns * 1e-9}
    for name, x in (("q", q), ("dq", dq), ("tau", tau)):
        table |= {joint.format(name, i): x[:, i] for i in range(7)}
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    assert_motion(read(tmp_path / "log.csv", torque="measured", n_joints=7), motion())
