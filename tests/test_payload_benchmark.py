"""What benchmarks/payload.py measures, and on which twins."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))


def heard(late: float, half: float = 0.01):
    """Return the arguments of `followed` for two joints whose friction is told as it was `late` s ago."""
    from payload_parts import COLD, FALL, SECONDS, TAU_S, WARMS

    rng, begins = np.random.default_rng(0), COLD * SECONDS
    t = 0.1 * np.arange(1, round((COLD + WARMS) * SECONDS / 0.1) + 1)

    def scale(t):
        return 1.0 + FALL * np.expm1(-np.maximum(t - begins, 0.0) / TAU_S)

    share = np.array([0.9, 1.1])
    rub = rng.normal(size=(len(t), 2))
    says = share * scale(t - late)[:, None]
    told = [
        SimpleNamespace(t=at, friction=says[k], friction_half=np.full(2, half), rests=False) for k, at in enumerate(t)
    ]
    return share * rub + 0.3, rub, rng.uniform(size=rub.shape) > 0.3, scale(t), told, begins


def test_friction_that_is_told_as_it_is_has_no_error():
    from payload_parts import FALL, followed

    for row, share in zip(followed(*heard(0.0)), (0.9, 1.1), strict=True):
        assert row["cold"] == pytest.approx(share)
        assert row["change"] == pytest.approx(-FALL * share, rel=0.03)  # exp(-228 / 60) of it is to come
        assert max(row["error"], row["rms"], row["absolute"], row["behind_s"], row["near_after_s"]) < 1e-9
        assert row["covered"] == 1.0
        assert not row["never"]


def test_friction_that_is_told_late_is_behind():
    """L s late it lacks exp(-t / tau) (exp(L / tau) - 1) of the fall, so it is near from tau log((.) / 0.1) on."""
    from payload_parts import NEAR, SECONDS, TAU_S, followed

    late = 10.0
    near = TAU_S * np.log(np.expm1(late / TAU_S) / NEAR)
    for row in followed(*heard(late)):
        assert row["behind_s"] == late
        assert near - SECONDS < row["near_after_s"] < near + SECONDS
        assert row["covered"] < 1.0


def test_a_judging_seed_is_of_its_own_make():
    from payload import wanted

    assert wanted({}, [0]) == [(1, 0), (2, 0)]
    assert wanted({"make": "2"}, [3, 1]) == [(2, 1), (2, 3)]
    assert wanted({}, [100, 209]) == [(1, 100), (2, 209)]
    with pytest.raises(SystemExit, match="twin 100 is of make 1; make=2 is not allowed with it"):
        wanted({"make": "2"}, [100])
    with pytest.raises(SystemExit, match="twin 12 is not allowed; 0 to 9"):
        wanted({}, [12])


def test_an_identification_is_found_by_either_name_and_is_of_that_twin(tmp_path):
    from payload_parts import folder

    def identified(name, make, seed):
        at = tmp_path / "identify" / name
        at.mkdir(parents=True)
        (at / "posterior.npz").touch()
        (at / "config.yaml").write_text(yaml.safe_dump({"arm": {"make": make, "seed": seed}}))
        return at

    judge = identified("judge_200", 2, 200)
    assert folder(tmp_path, 2, 200) == judge
    own = identified("m2_200", 2, 200)
    assert folder(tmp_path, 2, 200) == own
    assert folder(tmp_path, 1, 0) == tmp_path / "identify" / "m1_0"  # where it will be
    identified("judge_101", 1, 102)
    with pytest.raises(SystemExit, match="judge_101 is of make 1, seed 102; make 1, seed 101 is wanted"):
        folder(tmp_path, 1, 101)


def test_what_is_kept_is_made_once(tmp_path):
    from payload_parts import Known

    of, made = Known(2, 3, None, None, None, tmp_path / "kept"), []

    def record():
        made.append(1)
        return [np.arange(3.0)]

    for _ in range(2):
        (heard,) = of.kept("events_0", record)
        assert heard.tolist() == [0.0, 1.0, 2.0]
    assert len(made) == 1
    of._replace(keep=None).kept("events_0", record)
    assert len(made) == 2


def test_a_constant_is_set_wherever_it_is(monkeypatch):
    from payload import tuned

    from r2s.adaptation import estimator, kalman

    for module in (kalman, estimator):
        monkeypatch.setattr(module, "THRESHOLD", kalman.THRESHOLD)  # as it was, when the test is over
    monkeypatch.setenv("R2S_TUNED", "1")
    tuned({"THRESHOLD": "12.5"})
    assert kalman.THRESHOLD == estimator.THRESHOLD == 12.5
    with pytest.raises(SystemExit, match="no number TAMEE in r2s/adaptation; did you mean TAME"):
        tuned({"TAMEE": "2"})
