"""Scores, twin selection and run folders of benchmarks/payload.py."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))


def warming(lag: float, half: float = 0.01):
    """Return the arguments of `score_warming` for two joints whose friction estimate lags by `lag` s."""
    from payload_parts import COLD, FALL, SECONDS, TAU_S, WARMS

    rng, begins = np.random.default_rng(0), COLD * SECONDS
    t = 0.1 * np.arange(1, round((COLD + WARMS) * SECONDS / 0.1) + 1)

    def scale(t):
        return 1.0 + FALL * np.expm1(-np.maximum(t - begins, 0.0) / TAU_S)

    share = np.array([0.9, 1.1])
    model = rng.normal(size=(len(t), 2))
    friction = share * scale(t - lag)[:, None]
    estimates = [
        SimpleNamespace(t=at, friction=friction[k], friction_half=np.full(2, half), rests=False)
        for k, at in enumerate(t)
    ]
    return share * model + 0.3, model, rng.uniform(size=model.shape) > 0.3, scale(t), estimates, begins


def test_a_perfect_friction_estimate_has_no_error():
    from payload_parts import FALL, score_warming

    for row, share in zip(score_warming(*warming(0.0)), (0.9, 1.1), strict=True):
        assert row["cold"] == pytest.approx(share)
        assert row["change"] == pytest.approx(-FALL * share, rel=0.03)  # exp(-228 / 60) of it comes later
        assert max(row["error"], row["rms"], row["absolute"], row["behind_s"], row["near_after_s"]) < 1e-9
        assert row["covered"] == 1.0
        assert not row["never"]


def test_a_lagging_friction_estimate_is_behind():
    """A lag L leaves exp(-t / tau) (exp(L / tau) - 1) of the fall, which is small after tau log((.) / 0.1)."""
    from payload_parts import NEAR, SECONDS, TAU_S, score_warming

    lag = 10.0
    near = TAU_S * np.log(np.expm1(lag / TAU_S) / NEAR)
    for row in score_warming(*warming(lag)):
        assert row["behind_s"] == lag
        assert near - SECONDS < row["near_after_s"] < near + SECONDS
        assert row["covered"] < 1.0


def test_a_judging_seed_belongs_to_one_variant():
    from payload import requested_twins

    assert requested_twins({}, [0]) == [("rigid", 0), ("elastic", 0)]
    assert requested_twins({"variant": "elastic"}, [3, 1]) == [("elastic", 1), ("elastic", 3)]
    assert requested_twins({}, [100, 209]) == [("rigid", 100), ("elastic", 209)]
    with pytest.raises(SystemExit, match="twin 100 is rigid, got variant=elastic"):
        requested_twins({"variant": "elastic"}, [100])
    with pytest.raises(SystemExit, match="twin 12; allowed: 0 to 9"):
        requested_twins({}, [12])
    with pytest.raises(SystemExit, match="variant=soft; allowed: rigid, elastic"):
        requested_twins({"variant": "soft"}, [0])


def test_either_name_of_an_identification_is_found_and_checked(tmp_path):
    from payload_parts import folder

    def identify(name, variant, seed):
        at = tmp_path / "identify" / name
        at.mkdir(parents=True)
        (at / "posterior.npz").touch()
        (at / "config.yaml").write_text(yaml.safe_dump({"arm": {"variant": variant, "seed": seed}}))
        return at

    judge = identify("judge_200", "elastic", 200)
    assert folder(tmp_path, "elastic", 200) == judge
    own = identify("elastic_200", "elastic", 200)
    assert folder(tmp_path, "elastic", 200) == own
    assert folder(tmp_path, "rigid", 0) == tmp_path / "identify" / "rigid_0"  # the folder of a new identification
    identify("judge_101", "rigid", 102)
    with pytest.raises(SystemExit, match="expected rigid twin 101, got rigid twin 102"):
        folder(tmp_path, "rigid", 101)


def test_kept_recordings_are_made_once(tmp_path):
    from payload_parts import IdentifiedTwin

    of, calls = IdentifiedTwin("elastic", 3, None, None, None, tmp_path / "kept"), []

    def record():
        calls.append(1)
        return [np.arange(3.0)]

    for _ in range(2):
        (recording,) = of.kept("events_0", record)
        assert recording.tolist() == [0.0, 1.0, 2.0]
    assert len(calls) == 1
    of._replace(keep=None).kept("events_0", record)
    assert len(calls) == 2


def test_a_constant_changes_in_every_module(monkeypatch):
    from common import set_constants

    from r2s.adaptation import estimator, tuning

    for module in (tuning, estimator):
        monkeypatch.setattr(module, "THRESHOLD", tuning.THRESHOLD)  # restored after the test
    monkeypatch.setenv("R2S_TUNED", "1")
    set_constants({"THRESHOLD": "12.5"})
    assert tuning.THRESHOLD == estimator.THRESHOLD == 12.5
    with pytest.raises(SystemExit, match="no number OUTLEIR in r2s/adaptation; did you mean OUTLIER"):
        set_constants({"OUTLEIR": "2"})
