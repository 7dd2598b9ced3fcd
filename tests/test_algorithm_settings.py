"""Settings of an algorithm: a bad one gets one line; constructors, files of conf/algo and the page have the same."""

import re
from dataclasses import fields

import pytest
import torch
import yaml
from conftest import ROOT, conf
from test_algorithms import ALL, make
from test_tqc import D, N

from r2s.errors import UserError
from r2s.learning.ddpg import DDPG
from r2s.learning.sac import SAC
from r2s.learning.td3 import TD3
from r2s.learning.tqc import TQC
from r2s.learning.train import Loop
from r2s.stages.parts import arguments

PAGE = ROOT / "docs" / "reference" / "algorithms.md"

SHARED = {
    "hidden": ([], [0], [128, -1], [64.5], 128, "128", None, ["64"]),
    "gamma": (1.0, -0.1, 1.5, float("nan"), "0.9", None, True),
    "tau": (0.0, -0.1, 1.01, float("inf"), "x"),
    "lr": (0.0, -5e-4, 2.0, float("nan"), None, "fast", False),
    "action_l2": (-0.1, float("inf"), None),
    "explore_correlation": (-0.1, 1.0, None),
}
OWN = {
    DDPG: {"explore_std": (-0.1, None, float("nan"))},
    TD3: {
        "n_critics": (0, -1, 1.5, True),
        "explore_std": (-0.1,),
        "smoothing_std": (-0.1, "0.2"),
        "smoothing_clip": (-0.1,),
        "policy_delay": (0, -2, 1.5),
    },
    SAC: {
        "n_critics": (0, 2.5),
        "alpha_init": (0.0, -0.01, None),
        "target_entropy": (float("nan"), "auto", float("-inf")),
    },
    TQC: {
        "n_critics": (0,),
        "n_quantiles": (0, -25, 2.5, None, "25"),
        "drop_per_critic": (-1, 25, 30, 0.5),
        "alpha_init": (0.0, -0.01),
        "target_entropy": ("auto",),
    },
}


@pytest.mark.parametrize("kind", ALL)
def test_a_bad_hyper_parameter_gets_one_line(kind):
    """The line names the setting, the value and what is allowed."""
    for name, values in (SHARED | OWN[kind]).items():
        for value in values:
            with pytest.raises(UserError) as raised:
                make(kind, **{name: value})
            line = str(raised.value)
            seen = value[-1] if name == "hidden" and isinstance(value, list) and value else value
            assert line.startswith(f"{name}: "), line
            assert repr(seen) in line
            assert "\n" not in line


@pytest.mark.parametrize(("value", "allowed"), [(-1e-3, "(0, 1]"), (float("nan"), "(0, 1]")])
def test_the_line_says_what_is_allowed(value, allowed):
    with pytest.raises(UserError) as raised:
        make(DDPG, lr=value)
    assert str(raised.value) == f"lr: expected a number in {allowed}, got {value!r}"


def test_edges_of_what_is_allowed():
    """A gamma of 0, tau 1, no action_l2, one quantile kept and a list of one layer are all fine."""
    make(DDPG, gamma=0, tau=1, lr=1, action_l2=0, explore_std=0)
    assert make(TQC, drop_per_critic=24, hidden=[8]).keep == 2


@pytest.mark.parametrize("kind", ALL)
def test_the_committed_settings_are_the_constructors(kind):
    """conf/algo/<name>.yaml and its base hold every setting of the class, and no other than those of the loop."""
    settings = conf(f"algo/{kind.__name__.lower()}")
    assert settings.pop("name") == kind.__name__.lower()
    settings.pop("n_envs"), settings.pop("demonstrations"), settings.pop("residual_l2")
    loop = {f.name for f in fields(Loop)}
    own = {k: v for k, v in settings.items() if k not in loop}
    positional = {"self", "scale", "action_scale", "critics"}
    assert set(own) == arguments(kind).keys() - positional
    kind((torch.zeros(D), torch.ones(D)), torch.ones(N), **own)


def test_what_algorithms_share_lives_in_one_file():
    """No learner's yaml has a value of conf/algo/base.yaml, and the loop has the same defaults."""
    base = yaml.safe_load((ROOT / "conf" / "algo" / "base.yaml").read_text())
    for path in (ROOT / "conf" / "algo").glob("*.yaml"):
        own = yaml.safe_load(path.read_text())
        if "base" in own.get("defaults", []):
            assert not own.keys() & base.keys(), path.name
    defaults = {f.name: f.default for f in fields(Loop)}
    assert {k: defaults[k] for k in base if k in defaults} == {k: base[k] for k in base if k in defaults}


def test_the_page_of_algorithms_has_the_settings_of_their_files():
    """docs/reference/algorithms.md: a cell begins with the value of conf/algo, for each key of the row."""
    rows = [line[1:-1].split("|") for line in PAGE.read_text().splitlines() if line.startswith("|`")]
    _, *names = (cell.strip().lower() for cell in rows[0])
    seen = set()
    for first, *cells in rows[1:]:
        keys = re.findall(r"`(\w+)`", first)
        for algo, cell in zip(names, cells, strict=True):
            settings = conf(f"algo/{algo}")
            if keys[0] not in settings or not cell:
                assert not cell or (algo, cell) == ("ddpg", "1 (1)")
                continue
            expected = [v for k in keys for v in (settings[k] if isinstance(settings[k], list) else [settings[k]])]
            assert [float(v) for v in cell.split(" (")[0].split(", ")] == expected, f"{algo}: {first}"
            seen |= {(algo, k) for k in keys}
    assert {(a, k) for a in names for k in ("gamma", "tau", "lr", "hidden", "batch_size", "n_envs")} <= seen
