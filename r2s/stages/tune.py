"""stage=tune: search for the best training settings with Optuna; each trial has a run folder of stage=train."""

import csv
import math
import re
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from glob import glob
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

from r2s.errors import UserError, check_number, instead_of, optional_import
from r2s.stages import train
from r2s.stages.build import all_threads, console, open_run, unread
from r2s.stages.parts import called, plain
from r2s.stages.pipeline import command_prefix, compose_step, overrides_for

MOST_STARTS = 3  # largest number of starts of a training that the system kills, for example when memory is short
POLL_S = 0.2
STOP_S = 20.0  # s, wait for a training to end after each signal; a training step or an evaluation is shorter
EDGE = 0.05  # width of the edge at each end of a range, as a fraction of the range
WHY = {"calibration": "give the trained arm by friction= and inertia=", "policy": "it trains its policies itself"}


def reads(cfg):
    """Return the config keys that stage=tune and its trainings read."""
    return {"tune", *train.reads(cfg)}


@dataclass(frozen=True)
class Tune:
    """Settings of the config group `tune`.

    Attributes:
        trials: number of trials. workers: number of parallel trainings with one thread each; if None, `threads`.
        startup: number of random trials before the TPE sampler and the pruner start.
        measure: key of the task's measure whose value in the last evaluation of a training is optimized.
        space: {option: list of values, or text of a range; see `parse_range`}.
        against: glob pattern of training folders to compare with the trials, such as a grid; None: no comparison.

    Raises:
        UserError: a number is outside its range, the space is invalid, or the pattern matches nothing.
    """

    trials: int
    workers: int | None
    startup: int
    measure: str
    space: dict[str, Any]
    against: str | None

    def __post_init__(self):
        check_number("tune.trials", self.trials, "[1, inf)", whole=True)
        check_number("tune.startup", self.startup, "[1, inf)", whole=True)
        if self.workers is not None:
            check_number("tune.workers", self.workers, "[1, inf)", whole=True)
        if self.against is not None and not (isinstance(self.against, str) and glob(self.against)):
            raise UserError(f"tune.against: {self.against!r} matches no folder; example: 'runs/train/grid_*'")
        if not isinstance(self.space, Mapping) or not self.space:
            raise UserError(f"tune.space: expected {{option: [values] or log(low, high)}}, got {self.space!r}")
        for key, axis in self.space.items():
            if not isinstance(axis, list):
                parse_range(key, axis)
            elif not axis or any(isinstance(value, list | dict) for value in axis):
                raise UserError(f"tune.space.{key}: expected a list of values such as [128, 256], got {axis}")


def parse_range(key: str, axis: Any) -> tuple[float, float, bool]:
    """Return (low, high, whether logarithmic) of a range such as "log(2e-4, 1e-3)" or "interval(0.95, 0.98)".

    Raises:
        UserError: the text `axis` does not describe a range.
    """
    found = re.fullmatch(r"(log|interval)\(([^,]+),([^,]+)\)", str(axis).replace(" ", ""))
    try:
        if found is None:
            raise ValueError
        low, high, log = float(found[2]), float(found[3]), found[1] == "log"
    except ValueError:
        allowed = "[values], log(low, high) or interval(low, high)"
        raise UserError(f"tune.space.{key}: expected {allowed}, got {axis!r}") from None
    check_number(f"tune.space.{key}", low, "(0, inf)" if log else "(-inf, inf)")
    check_number(f"tune.space.{key}", high, f"({low}, inf)")
    return low, high, log


def suggest(trial: Any, space: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings {option: value} that Optuna suggests for a trial."""
    out = {}
    for key, axis in space.items():
        if isinstance(axis, list):
            out[key] = trial.suggest_categorical(key, axis)
        else:
            low, high, log = parse_range(key, axis)
            out[key] = float(f"{trial.suggest_float(key, low, high, log=log):.4g}")
    return out


def corners(space: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a list of settings in which every listed value and both ends of every range occur at least once."""
    values = {key: axis if isinstance(axis, list) else [*parse_range(key, axis)[:2]] for key, axis in space.items()}
    first = {key: own[0] for key, own in values.items()}
    return [first, *({**first, key: value} for key, own in values.items() for value in own[1:])]


def at_edges(best: Mapping[str, Any], space: Mapping[str, Any]) -> list[str]:
    """Return a line for each setting of the best trial that is at an edge of its range or of its list of numbers."""
    from r2s.reporting.comparison.scores import edge, is_number

    lines = []
    for key, axis in space.items():
        if isinstance(axis, list) and (len(axis) < 3 or not all(map(is_number, axis))):
            continue
        low, high, log = (min(axis), max(axis), False) if isinstance(axis, list) else parse_range(key, axis)
        scale = math.log if log else float
        share = (scale(best[key]) - scale(low)) / (scale(high) - scale(low))
        if not EDGE <= share <= 1 - EDGE:
            lines.append(edge("best trial", key, best[key], share > 0.5))
    return lines


def training_words(cfg, overrides, settings):
    """Return a training's overrides: `settings` {option: value}, and the user's overrides that stage=train reads."""
    step = cfg.copy()
    step.stage = "train"
    typed = [o for o in overrides_for(overrides, step) if not o.startswith(("resume=", "skip_completed="))]
    return [*typed, *words_of(settings), "stage=train", "threads=1"]


def words_of(settings):
    """Return the overrides of the settings {option: value}; None becomes null."""
    return [f"{key}={'null' if value is None else value}" for key, value in settings.items()]


def check_trainings(cfg, overrides, space):
    """Return the `Parts` of one training; raise UserError if any training would refuse an override or a value."""
    typed = {o.lstrip("+~").split("=")[0] for o in overrides}
    if both := sorted(typed & set(space)):
        raise UserError(f"{both[0]}: tune.space searches it; leave it out, or give tune.space={{{both[0]}: [VALUE]}}")
    for settings in corners(space):
        step = compose_step(training_words(cfg, overrides, settings), "tune.space")
        for key in space:
            if why := unread(key, step):
                raise UserError(f"tune.space: {why}")
        parts = train.make_parts(step)
    return parts


def logged_measures(parts):
    """Return {key: Measure} of the measures that a training logs; a short evaluation reveals the keys."""
    import torch

    from r2s.learning.evaluate import make_evaluation

    actions = parts.task.control(parts.robot).action_dim
    still: Any = SimpleNamespace(action=lambda observation: torch.zeros(len(observation), actions))
    row = parts.task.measures(make_evaluation(parts.robot, parts.task, parts.draw, episodes=1, nthread=1)(still))
    return {key: measure for key, measure in parts.task.measure_table.known.items() if key in row}


class TrialRun:
    """The training of an Optuna trial: a run folder of stage=train, and the process that writes in this folder.

    A training may outlive a killed stage=tune. While a training writes in the folder, no second training starts.

    Args:
        trial: Optuna's trial. folder: run folder. words: command that starts the training. log: file for stderr.
    """

    def __init__(self, trial: Any, folder: Path, words: Sequence[str], log: Path):
        self.trial, self.folder, self.log = trial, folder, log
        self._words, self.starts = list(words), 0
        self._process: subprocess.Popen | None = None
        self._reported = len(trial.study.trials[trial.number].intermediate_values)

    def start(self) -> None:
        """Start the training, or resume the training if the run folder exists."""
        self.starts += 1
        self.log.parent.mkdir(exist_ok=True)
        with open(self.log, "a") as log:
            self._process = subprocess.Popen(self._words, stdout=subprocess.DEVNULL, stderr=log)

    def stop(self) -> None:
        """End the training as Ctrl-C does, so that the status in its run folder becomes stopped.

        Background processes of a shell ignore SIGINT; a training that does not end receives SIGTERM, then SIGKILL.
        """
        if self._process is None:
            return
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            self._process.send_signal(number)
            try:
                self._process.wait(STOP_S)
                return
            except subprocess.TimeoutExpired:
                continue

    def status(self) -> str:
        """Return the state of the training.

        "started": the training runs and was started by this process. "left": it runs, started by an earlier process.
        "none": no run folder. Otherwise: the status in meta.json.
        """
        from r2s.runs import is_locked, read_meta

        if self._process is not None and self._process.poll() is None:
            return "started"
        if not (self.folder / "meta.json").is_file():
            return "none"
        return "left" if is_locked(self.folder) else read_meta(self.folder)["status"]

    def report(self, measure: str) -> list[float]:
        """Report new evaluations to Optuna; return the measure's values in all evaluations so far."""
        path = self.folder / "evaluations.csv"
        text = path.read_text() if path.is_file() else ""
        complete = text[: text.rfind("\n") + 1]  # the training may still be writing the last row
        values = [float(row[measure]) for row in csv.DictReader(complete.splitlines())]
        for k in range(self._reported, len(values)):
            self.trial.report(values[k], k)
        self._reported = max(self._reported, len(values))
        return values


def follow(study: Any, one: TrialRun, measure: str) -> bool:
    """Report a trial's evaluations; start or prune the training if necessary; return whether the trial is finished.

    Raises:
        UserError: the training failed before its first evaluation, or ended early MOST_STARTS times.
    """
    import optuna

    from r2s.runs import read_meta

    status, values = one.status(), one.report(measure)
    if status == "left" or (status == "started" and not one.trial.should_prune()):
        return False
    if status == "started":
        one.stop()
        study.tell(one.trial, state=optuna.trial.TrialState.PRUNED)
    elif status == "done":
        study.tell(one.trial, values[-1])
    elif status == "failed":  # for example a loss that is not finite
        study.tell(one.trial, state=optuna.trial.TrialState.FAIL)
        if not values:
            raise UserError(f"tune: training {one.folder.name} failed: {read_meta(one.folder).get('error')}")
    elif one.starts < MOST_STARTS:
        one.start()
        return False
    else:
        study.tell(one.trial, state=optuna.trial.TrialState.FAIL)
        raise UserError(f"tune: training {one.folder.name} ended {one.starts} times before its end; see {one.log}")
    return True


def search(study: Any, how: Tune, make: Callable[[Any], TrialRun], workers: int) -> None:
    """Run trials in parallel until `how.trials` exist; first continue the unfinished trials of a stopped search."""
    import optuna

    from r2s.progress import Progress

    states, progress = optuna.trial.TrialState, Progress("tune")
    unfinished = [optuna.trial.Trial(study, t._trial_id) for t in study.get_trials(states=[states.RUNNING])]
    running: list[TrialRun] = []
    try:
        while True:
            while len(running) < workers and (unfinished or len(study.trials) < how.trials):
                running.append(make(unfinished.pop(0) if unfinished else study.ask()))
            if not running:
                break
            for one in list(running):
                if follow(study, one, how.measure):
                    running.remove(one)
            finished = sum(t.state.is_finished() for t in study.get_trials(deepcopy=False))
            complete = study.get_trials(deepcopy=False, states=[states.COMPLETE])
            best = f", best {how.measure} {study.best_value:.4g}" if complete else ""
            progress(finished / how.trials, f"{finished} of {how.trials} trials{best}")
            time.sleep(POLL_S)
    finally:
        for one in running:
            one.stop()
    progress.close()


def open_study(run: Any, seed: int, startup: int, direction: Literal["minimize", "maximize"]) -> Any:
    """Return the Optuna study from study.db in a run folder; a resumed search samples with a new random seed."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    storage = f"sqlite:///{run.folder / 'study.db'}"
    study = optuna.create_study(study_name="tune", storage=storage, direction=direction, load_if_exists=True)
    # study.db stores the sampled settings, but not the state of the random generator
    study.sampler = optuna.samplers.TPESampler(
        seed=(seed + 1000 * len(study.trials)) % 2**32, n_startup_trials=startup
    )
    study.pruner = optuna.pruners.MedianPruner(n_startup_trials=startup, n_warmup_steps=1)
    return study


def tune(cfg, overrides):
    """Tune settings with Optuna, one training per trial; write trials.csv and the report page."""
    optional_import("optuna", "stage=tune", "sweeps")
    from r2s.reporting.tuning import against_table, read_grid, trials_table, tuning_page
    from r2s.runs import read_summary

    given = {k: v for k, v in plain(cfg.tune).items() if k in {f.name for f in fields(Tune)}}
    how = called(Tune, "tune", given)
    known = logged_measures(check_trainings(cfg, overrides, how.space))
    if how.measure not in known:
        raise UserError(f"tune.measure: a training logs no measure '{how.measure}'; {instead_of(how.measure, known)}")
    if how.against:
        read_grid(how.against, how.measure)
    measure = known[how.measure]
    workers = how.workers or all_threads(cfg)
    with open_run(cfg, overrides) as run:
        study = open_study(run, cfg.seed, how.startup, "minimize" if measure.lower_is_better else "maximize")
        search(study, how, partial(make_trial, cfg, overrides, run, how.space), workers)
        trials = trials_table(study, run.folder)
        trials.to_csv(run.folder / "trials.csv", index=False)
        against = against_table(trials, how.measure, how.against, not measure.lower_is_better)
        done = trials[trials["state"] == "complete"]
        if done.empty:
            raise UserError(f"tune: no trial of {len(trials)} is complete")
        best = done.sort_values("value", key=lambda values: measure.sign * values).iloc[-1]
        # the best value is biased, because its goals selected the trial; `last` was measured on other goals
        last = read_summary(Path(cfg.root) / "train" / f"{run.folder.name}_{int(best['trial'])}", "tune")["last"]
        counts = trials["state"].value_counts().to_dict()
        run.summary({"best": best.to_dict() | {"unseen": last[how.measure]}, "trials": counts})
        tuning_page(run, trials, against, how.measure)
    chosen = study.trials[int(best["trial"])].params  # the table contains nan instead of None
    settings = " ".join(words_of({k: chosen[k] for k in how.space if k in chosen}))
    unseen = f"{last[how.measure]:.4g} on goals that chose nothing"
    line = f"best of {len(trials)} trials: {how.measure} {best['value']:.4g}, {unseen}, with {settings}"
    seeds = ",".join(str(cfg.seed + k) for k in range(1, 4))
    lines = [
        line,
        *at_edges(chosen, how.space),
        f"its seed chose it: confirm with python run.py -m {settings} seed={seeds}",
    ]
    for line in lines:
        console().print(line, highlight=False, markup=False, soft_wrap=True)
    print(f"written: {run.folder} (report: {run.folder / 'report.md'})")


def make_trial(cfg, overrides, run, space, trial):
    """Return the `TrialRun` of an Optuna trial with the settings that Optuna suggests."""
    name = f"{run.folder.name}_{trial.number}"
    words = training_words(cfg, overrides, suggest(trial, space))
    words += [f"root={cfg.root}", f"name={name}", "skip_completed=true"]
    folder = Path(cfg.root) / "train" / name
    return TrialRun(trial, folder, [*command_prefix(), *words], run.folder / "logs" / f"{name}.txt")
