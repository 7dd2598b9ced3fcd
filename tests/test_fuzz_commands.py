"""Mutated command lines end in one line or are accepted, and what is out of range is not; see also test_fuzz.py."""

import contextlib
import io
import math
import os
import sys
from importlib import import_module
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_fuzz import examples

from r2s import cli

COMMANDS = (
    ["+experiment=toy"],
    ["algo=sac", "dr=none", "seed=3"],
    ["stage=identify", "+experiment=toy"],
    ["stage=identify", "data=simulated", "+experiment=toy"],
    ["stage=compare", "runs='runs/train/*'"],
    ["-m", "+experiment=toy", "seed=0,1"],
    ["task=track", "+experiment=toy"],
    ["stage=estimate", "+experiment=toy"],
)
NUMBERS = {  # [low, high], and whether the option is a whole number: written down again, independent of r2s's checks
    "seed": (0, math.inf, True), "threads": (0, 4096, True), "budget.minutes": (1e-9, math.inf, False),
    "budget.env_steps": (1e-9, math.inf, False), "algo.lr": (1e-30, 1, False), "algo.gamma": (0, 1, False),
    "algo.tau": (1e-30, 1, False), "algo.batch_size": (1, 800_000, True), "algo.n_envs": (1, 100_000, True),
    "algo.learning_starts": (0, math.inf, True),
    "algo.demonstrations": (0, math.inf, True), "algo.replay_size": (32, 1e10, True),
    "evaluation.episodes": (1, 1e6, True), "evaluation.env_steps": (1, math.inf, True),
    "task.ctrl_hz": (1, 1000, True), "task.episode_s": (0.01, 1000, False), "task.preview": (1, 1e6, True),
    "dr.phi_relative": (0, 1, False), "dr.inertia_relative": (0, 1, False), "friction.phi1": (0, 1e6, False),
    "friction.dq_min": (0, 100, False), "inertia.scale": (1e-6, 1e6, False),
    "robot.torque_fraction": (1e-6, 1, False), "identify.window_s": (1e-3, 1000, False),
    "identify.stride": (1, 10_000, True), "identify.cutoff_hz": (1e-3, 500, False), "identify.folds": (2, 1000, True),
    "identify.validation_fraction": (1e-9, 1 - 1e-9, False), "data.seconds": (0.1, 1e5, False),
    "data.ramp_poses": (0, 1000, True),
}  # fmt: skip
VALUES = ["nan", "inf", "-inf", "-1", "0", "1e308", "1e400", "1e-320", "0.5", "1_000", "0x1F", "\uff13", "'", "''"]
VALUES += ["word", "[]", "{}", "null", "true", "[1,2]", "[nan]", "{a: 1}", "${seed}", "${nowhere}", "${oc.env:HOME}"]
NEVER_NUMBERS = ("word", "{}", "true", "''", "{a: 1}", "[nan]", "[]", "${oc.env:HOME}")
TEXTS = ["..", "a/b", "''", "null", "[]", "{}", "-1", "true", "x" * 300, "'\t'", "∅"]
PATHS = ["/", "/dev/null", "/dev/zero", ".", "'*'", "/proc/self/mem", "~", "'**'"]


def outside(key: str, value: str) -> bool:
    """Return whether `key` must refuse `value`; r2s alone judges lists, null and interpolations."""
    low, high, integral = NUMBERS[key]
    try:
        number = float(value)
    except ValueError:
        return value in NEVER_NUMBERS
    return not (math.isfinite(number) and low <= number <= high) or (integral and number != int(number))


def mutate_command(draw) -> tuple[list[str], bool]:
    """Return the words of a command with one mutation, and whether r2s must refuse it."""
    words = list(draw(st.sampled_from(COMMANDS)))
    kind = draw(st.sampled_from(["number", "number", "letter", "word", "text", "path"]))
    if kind == "number":
        key, value = draw(st.sampled_from(sorted(NUMBERS))), draw(st.sampled_from(VALUES))
        return [*words, f"{key}={value}"], outside(key, value)
    if kind == "letter":
        k = draw(st.integers(0, len(words) - 1))
        at = draw(st.integers(0, len(words[k]) - 1))
        words[k] = words[k][:at] + draw(st.sampled_from("abcxyzäß=+~[]{}$,'\"\\ \t0:;")) + words[k][at + 1 :]
    elif kind == "word":
        words.append(draw(st.text(max_size=12, alphabet=st.characters(codec="utf-8", exclude_characters="\0"))))
    else:
        keys = ["name", "root", "calibration", "device", "matmul", "friction.family", "stage"]
        keys = keys if kind == "text" else ["resume", "calibration", "runs", "robot.mjcf", "data.excitation"]
        words.append(f"{draw(st.sampled_from(keys))}={draw(st.sampled_from(TEXTS if kind == 'text' else PATHS))}")
    return words, False


class Reached(BaseException):
    """The command was accepted: it would open its run folder now."""

    def __call__(self, *_, **__):
        """Be opened."""
        raise self


@pytest.mark.long
@examples(8)
@given(data=st.data())
def test_a_mutated_command_is_one_line_and_makes_no_folder(tmp_path_factory, data):
    """Values out of range, replaced letters, foreign words and impossible paths: exit status 2, one `error:` line."""
    folder = tmp_path_factory.mktemp("typed")
    words, wrong = mutate_command(data.draw)
    words += [] if any(w.startswith("root=") for w in words) else [f"root={folder / 'runs'}"]
    out, reached, status = io.StringIO(), False, 0
    with contextlib.ExitStack() as stack:
        for name in ("compare", "estimate", "identify", "train"):
            stack.enter_context(mock.patch.object(import_module(f"r2s.stages.{name}"), "open_run", Reached()))
        stack.enter_context(mock.patch.dict(os.environ))
        stack.enter_context(mock.patch.object(sys, "argv", ["run.py", *words]))
        stack.enter_context(mock.patch.object(sys, "path", list(sys.path)))
        stack.enter_context(contextlib.chdir(folder))
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(out))
        try:
            cli.main()
        except Reached:
            reached = True
        except SystemExit as end:
            status = end.code
    text = out.getvalue()
    errors = [line for line in text.splitlines() if line.startswith("error: ")]
    assert "Traceback" not in text
    if status:
        assert status == 2, text
        assert len(errors) == 1 or ("-m" in words and errors), text  # one line per job of a sweep
    assert not (wrong and reached), f"{' '.join(words)} was accepted"
    assert not list(folder.rglob("meta.json"))
