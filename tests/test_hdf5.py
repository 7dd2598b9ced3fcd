"""HDF5 and npz files are read by the names of their datasets; damaged ones give one line."""

import h5py
import numpy as np
import pytest
from test_readers import assert_motion, message, motion

from r2s.recordings.readers import read


@pytest.mark.parametrize("suffix", [".h5", ".hdf5"])
@pytest.mark.parametrize("group", ["", "robot/arm/"])
def test_hdf5_datasets_by_name(tmp_path, suffix, group):
    ns, q, dq, tau, _ = motion()
    path = tmp_path / f"log{suffix}"
    with h5py.File(path, "w") as h5:
        h5.create_dataset(f"{group}t", data=ns[:, None] * 1e-9)
        h5.create_dataset(f"{group}q", data=q, compression="gzip", chunks=(50, 7))
        for j in range(7):
            h5[f"{group}dq_{j}"] = dq[:, j]
        h5[f"{group}tau_J"] = tau
        h5["camera"] = np.zeros((3, 4, 4, 3), np.uint8)
        h5["operator"] = "someone"
        h5["empty"] = h5py.Empty("f8")
    columns = {field: group + name for field, name in (("t", "t"), ("q", "q"), ("dq", "dq"), ("tau", "tau_J"))}
    assert_motion(read(path, torque="measured", columns=columns, n_joints=7), motion())
    if not group:
        assert_motion(read(path, torque="measured"), motion())
    else:
        text = message(read, path, torque="measured")
        assert "no column 't' for t" in text
        assert "did you mean 'robot/arm/t'? (set data.columns.t)" in text
        wrong = message(read, path, torque="commanded", columns=columns | {"tau": None})
        assert "no column 'tau_J_d' for tau (commanded torque)" in wrong
        assert wrong.endswith("; tau_J is measured torque (set data.columns.tau)")
        assert "did you mean 'robot/arm/q'?" in message(
            read, path, torque="measured", columns=columns | {"q": "/robot/arm/q"}
        )


def test_hdf5_declares_its_torque_and_text_is_no_column(tmp_path):
    ns, q, dq, tau, _ = motion()
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as h5:
        for name, x in (("t", ns * 1e-9), ("q", q), ("dq", dq), ("tau", tau)):
            h5[name] = x
        h5["note"] = ["a"] * 300
        h5["torque"] = "commanded"
    assert_motion(read(path, torque=None), motion(), "commanded")
    assert "expected torque=commanded, as the file declares" in message(read, path, torque="measured")
    text = message(read, path, torque="commanded", columns={"t": "note"})
    assert text == f"{path}: column 'note': expected numbers, got 'a' at row 0"


def test_a_damaged_hdf5_file_is_refused(tmp_path):
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as h5:
        h5["t"] = np.arange(9999.0)
    whole = path.read_bytes()
    for content in (b"", b"\x00\x01" * 99, whole[: len(whole) // 2]):
        path.write_bytes(content)
        assert message(read, path, torque="measured").startswith(f"{path} cannot be read as h5: ")


HEADERS = [(b"(99999,), }", b"(99999,,(}"), (b"'shape'", b"  shape'"), (b"{'descr'", b"{{'descr'")]


@pytest.mark.parametrize("change", HEADERS)
def test_a_damaged_header_in_an_npz_is_refused(tmp_path, change):
    """NumPy parses the header as a Python literal and raises Python's parser errors."""
    path = tmp_path / "log.npz"
    np.savez(path, t=np.arange(99999.0))  # large: a small one has its checksum looked at first
    content = path.read_bytes()
    assert change[0] in content
    path.write_bytes(content.replace(change[0], change[1].ljust(len(change[0]))[: len(change[0])]))
    assert message(read, path, torque="measured").startswith(f"{path} cannot be read as npz: ")


@pytest.mark.parametrize("key", ["topic", "joints"])
def test_what_belongs_to_bags_is_not_silently_ignored(tmp_path, key):
    path = tmp_path / "log.csv"
    path.write_text("t,q1\n")
    text = message(read, path, torque="measured", **{key: "x"})
    assert text == f"{path}: data.{key}: expected null for .csv, got x: it is for .bag, .db3, .mcap"
