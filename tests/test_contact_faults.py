"""Faults of the safety campaign while an arm presses: a signal, an action that is not finite, a failing adapter."""

import subprocess
import sys

import pytest
from conftest import ROOT

pytest.importorskip("panda_py.libfranka")
pytest.importorskip("pylibfranka")
WORK = "import sys, safety_campaign as s; s.work(2, [0, 26, 45], s.Path(sys.argv[1]), False, True)"


@pytest.mark.slow
def test_faults_in_contact_end_as_decided(tmp_path):
    """As held, released and retreated; nothing over the bound of the force, no command after the stop."""
    done = subprocess.run([sys.executable, "-c", WORK, tmp_path / "rows"], cwd=ROOT / "benchmarks", check=False)
    assert done.returncode == 0
    sys.path.insert(0, str(ROOT / "benchmarks"))
    import safety_campaign

    rows = safety_campaign.read_results(tmp_path / "rows").values()
    assert [(row["kind"], row["stop"]) for row in rows] == [
        ("signal", "hold"), ("action not finite", "release"), ("adapter raises", "retreat"),
    ]  # fmt: skip
    for row in rows:
        assert (row["wrong"], row["over"], row["after"], row["hung"]) == ("", 0, 0, False)
        assert row["force_N"] > 2.0
        assert row["share"] < 1.0
