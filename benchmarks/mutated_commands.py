"""Command lines that are nonsense, each typed in a process of its own, up to where its run folder would be made."""

import math
import os
from pathlib import Path

from faulty import command, ended, forked
from hypothesis import strategies as st
from mutated import COUNTS, drawn

BASES = (
    ["+experiment=toy"],
    ["algo=sac", "dr=none", "seed=3"],
    ["stage=identify", "+experiment=toy"],
    ["stage=identify", "data=simulated", "+experiment=toy"],
    ["stage=identify", "data=kinova_gen3"],
    ["stage=compare", "runs='runs/train/*'"],
    ["-m", "+experiment=toy", "seed=0,1"],
    ["algo=oracle"],
    ["task=track", "+experiment=toy"],
    ["stage=watch", "+experiment=toy"],
    ["+experiment=[tune,toy]"],
)
# options that are numbers, with what is allowed, written down again here: the judge is not the accused
NUMBERS: dict[str, tuple[float, float, bool, str]] = {
    "seed": (0, math.inf, True, ""),
    "threads": (0, 4096, True, ""),
    "budget.minutes": (1e-9, math.inf, False, "train"),
    "budget.env_steps": (1e-9, math.inf, False, "train"),
    "algo.lr": (1e-30, 1, False, "train"),
    "algo.gamma": (0, 1, False, "train"),
    "algo.tau": (1e-30, 1, False, "train"),
    "algo.batch_size": (1, 800000, True, "train"),
    "algo.n_envs": (1, 100000, True, "train"),
    "algo.learning_starts": (0, math.inf, True, "train"),
    "algo.updates_per_step": (1, math.inf, True, "train"),
    "algo.replay_size": (32, 1e10, True, "train"),
    "evaluation.episodes": (1, 1e6, True, "train"),
    "evaluation.env_steps": (1, math.inf, True, "train"),
    "task.ctrl_hz": (1, 1000, True, "train"),
    "task.episode_s": (0.01, 1000, False, "train"),
    "task.residual": (1e-30, 1, False, "train"),
    "task.preview": (1, 1e6, True, "train"),
    "watch.every_s": (1e-30, math.inf, False, "watch"),
    "tune.trials": (1, 1e9, True, "tune"),
    "tune.workers": (1, 4096, True, "tune"),
    "dr.phi_relative": (0, 1, False, "train"),
    "dr.inertia_relative": (0, 1, False, "train"),
    "friction.phi1": (0, 1e6, False, "both"),
    "friction.phi2": (0, 1e6, False, "both"),
    "friction.dq_min": (0, 100, False, "both"),
    "inertia.scale": (1e-6, 1e6, False, "both"),
    "robot.torque_fraction": (1e-6, 1, False, "train"),
    "identify.window_s": (1e-3, 1000, False, "identify"),
    "identify.stride": (1, 10000, True, "identify"),
    "identify.cutoff_hz": (1e-3, 500, False, "identify"),
    "identify.folds": (2, 1000, True, "identify"),
    "identify.breakaway": (0, 1e6, False, "identify"),
    "identify.validation_fraction": (1e-9, 1 - 1e-9, False, "identify"),
    "data.seconds": (0.1, 1e5, False, "arm"),
    "data.ramp_poses": (0, 1000, True, "arm"),
    "data.excitation_seed": (0, math.inf, True, "arm"),
}
VALUES = ["nan", "inf", "-inf", "-1", "0", "1e308", "-1e9", "1e400", "word", "[]", "{}", "null", "true", "''", "0.5"]
VALUES += [
    "[1,2]",
    "1e-320",
    "${seed}",
    "${nowhere}",
    "${oc.env:HOME}",
    "'",
    "{a: 1}",
    "[nan]",
    "\uff13",
    "1_000",
    "0x1F",
]


def mutate_commands(at: Path, err: Path) -> list[dict]:
    """Type commands that are nonsense; what is accepted stops where its run folder would be made."""
    rows: list[dict] = []
    root = at / "typed"

    def stop_at_the_folder() -> None:
        from r2s.stages import compare, identify, train, tune, watch

        class Reached:
            def __enter__(self):
                print("reached", flush=True)
                os._exit(0)

            def __exit__(self, *_):
                return False

        for stage in (compare, identify, train, tune, watch):
            stage.open_run = lambda *_, **__: Reached()

    def one(draw):
        words = list(draw(st.sampled_from(BASES)))
        kind = draw(st.sampled_from(["number", "number", "number", "letters", "word", "text", "path"]))
        key, value, wrong = "", "", None
        if kind == "number":
            key, value = draw(st.sampled_from(sorted(NUMBERS))), draw(st.sampled_from(VALUES))
            words.append(f"{key}={value}")
            wrong = outside(key, value)
        elif kind == "letters":
            k = draw(st.integers(0, len(words) - 1))
            letters = list(words[k])
            place = draw(st.integers(0, len(letters) - 1))
            letters[place] = draw(st.sampled_from(list("abcxyzäß=+~[]{}$,'\"\\ \t0:;")))
            words[k] = "".join(letters)
        elif kind == "word":
            words.append(
                draw(st.text(min_size=0, max_size=12, alphabet=st.characters(codec="utf-8", exclude_characters="\0")))
            )
        elif kind == "text":
            key = draw(
                st.sampled_from(["name", "root", "calibration", "device", "matmul", "friction.family", "stage"])
            )
            value = draw(
                st.sampled_from(["..", "a/b", "''", "null", "[]", "{}", "-1", "true", "x" * 300, "'\t'", "∅"])
            )
            words.append(f"{key}={value}")
        else:
            key = draw(st.sampled_from(["resume", "calibration", "runs", "robot.mjcf", "data.excitation"]))
            value = draw(st.sampled_from(["/", "/dev/null", "/dev/zero", ".", "'*'", "/proc/self/mem", "~", "'**'"]))
            words.append(f"{key}={value}")
        if not any(w.startswith("root=") for w in words):
            words.append(f"root={root}")
        status = ended(forked(command(words, at), err, before=stop_at_the_folder), 120.0)
        text = err.read_text(errors="replace")
        errors = [line for line in text.splitlines() if line.startswith("error: ")]
        if status == 2 and errors and "Traceback" not in text and (len(errors) == 1 or "-m" in words):
            end, said = "refused", errors[0]  # of a sweep a line for each job
        elif status == 0 and "Traceback" not in text:
            end, said = ("nonsense", f"{key}={value} was taken") if wrong and "reached" in text else ("stands", "")
        else:
            end, said = "traceback", text[-1500:] or f"exit status {status}"
        made = [str(p) for p in at.rglob("*") if p.name == "meta.json" and "typed" in p.parts]
        rows.append({"kind": "commands", "what": " ".join(words), "end": end, "said": said, "left": made})

    drawn("commands", one, COUNTS["commands"])
    return rows


def outside(key: str, value: str) -> bool:
    """Return whether a value typed for an option is nonsense; lists and null are judged by the code alone."""
    low, high, whole, _ = NUMBERS[key]
    try:
        number = float(value)
    except ValueError:
        return value in ("word", "{}", "true", "''", "{a: 1}", "[nan]", "[]", "${oc.env:HOME}")
    return not (low <= number <= high) or (whole and number != int(number)) if math.isfinite(number) else True
