"""stage=tune: look for settings of a training; each trial is a run of stage=train in a folder of its own."""

import os
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from glob import glob
from pathlib import Path
from typing import Any

from r2s.errors import UserError, check_number, choices, nearest
from r2s.stages import train
from r2s.stages.build import called, console, open_run, plain, unread
from r2s.stages.pipeline import composed, front_door, handed_on

MEASURES = {"return_paper": "maximize", "success_1cm": "maximize", "success_5mm": "maximize"}
MEASURES |= {"distance_median_m": "minimize", "path_rmse_mm": "minimize", "within_5mm": "maximize"}
PATIENCE = 3  # times that a training is begun which the system ended
WHY = {"calibration": "give the trained arm by friction= and inertia=", "policy": "it trains its policies itself"}


def reads(cfg):
    """Return the keys of the config that this stage or its trainings read."""
    return {"tune", *train.reads(cfg)}


@dataclass(frozen=True)
class Tune:
    """`tune` of the config.

    Attributes:
        trials: in all. workers: trainings at once, of one thread each; None: as many as threads=.
        startup: trials drawn at random before any is modelled or pruned.
        measure: of the last evaluation, what is looked for.
        space: {option: [values], or the text that `span` reads}.
        against: glob of trainings to be compared with, such as those of a grid.

    Raises:
        UserError: a number outside its range, a space that is none, or a glob that finds nothing.
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
        if self.measure not in MEASURES:
            raise UserError(
                f"tune.measure: '{self.measure}' is not allowed; {choices(MEASURES)} are"
                f"{nearest(str(self.measure), MEASURES)}"
            )
        if self.against is not None and not (isinstance(self.against, str) and glob(self.against)):
            raise UserError(
                f"tune.against: {self.against!r} finds nothing; run folders of stage=train are allowed, such as "
                "'runs/train/grid_*'"
            )
        if not isinstance(self.space, Mapping) or not self.space:
            raise UserError(f"tune.space: {self.space!r} is no space; {{option: [values] or log(low, high)}} is")
        for key, axis in self.space.items():
            if not isinstance(axis, list):
                span(key, axis)
            elif not axis or any(isinstance(value, list | dict) for value in axis):
                raise UserError(f"tune.space.{key}: {axis} is not allowed; [values] are, as in [128, 256]")


def span(key: str, axis: Any) -> tuple[float, float, bool]:
    """Return (low, high, logarithmic) of an axis as it is typed: "log(2e-4, 1e-3)" or "interval(0.95, 0.98)".

    Raises:
        UserError: it is no such text.
    """
    found = re.fullmatch(r"(log|interval)\(([^,]+),([^,]+)\)", str(axis).replace(" ", ""))
    try:
        if found is None:
            raise ValueError
        low, high, log = float(found[2]), float(found[3]), found[1] == "log"
    except ValueError:
        allowed = "[values], log(low, high) and interval(low, high) are"
        raise UserError(f"tune.space.{key}: {axis!r} is not allowed; {allowed}") from None
    check_number(f"tune.space.{key}", low, "(0, inf)" if log else "(-inf, inf)")
    check_number(f"tune.space.{key}", high, f"({low}, inf)")
    return low, high, log


def suggested(trial: Any, space: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a trial: {option: value}."""
    out = {}
    for key, axis in space.items():
        if isinstance(axis, list):
            out[key] = trial.suggest_categorical(key, axis)
        else:
            low, high, log = span(key, axis)
            out[key] = float(f"{trial.suggest_float(key, low, high, log=log):.4g}")
    return out


def corners(space: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return settings that hold every value of each axis, and both ends of an interval, at least once."""
    values = {key: axis if isinstance(axis, list) else [*span(key, axis)[:2]] for key, axis in space.items()}
    first = {key: own[0] for key, own in values.items()}
    return [first, *({**first, key: value} for key, own in values.items() for value in own[1:])]


def check_trainings(cfg, overrides, space):
    """Raise UserError where a training would refuse what was typed, or an axis of the space."""
    typed = {o.lstrip("+~").split("=")[0] for o in overrides}
    if both := sorted(typed & set(space)):
        raise UserError(
            f"{both[0]}: tune.space looks for it; leave it out, or give tune.space={{{both[0]}: [VALUE]}}"
        )
    for settings in corners(space):
        step = composed(handed(cfg, overrides, settings), "tune.space")
        for key in space:
            if why := unread(key, step):
                raise UserError(f"tune.space: {why}")
        train.check(step)


class Training:
    """One trial: a training that runs beside this process, and what its evaluations said."""

    def __init__(self, trial: Any, folder: Path, words: Sequence[str]):
        self.trial, self.folder, self.words = trial, folder, list(words)
        self.begun, self.told = 0, set(trial.study.trials[trial.number].intermediate_values)
        self.begin()

    def begin(self) -> None:
        """Start it, or let it go on; a process of an earlier, killed tune may still be at it."""
        from r2s.runs import is_done

        while (self.folder / "meta.json").is_file():
            try:
                is_done(self.folder)
                break
            except UserError:
                time.sleep(1.0)
        self.begun += 1
        # a file without a name: into one that has it, a training that a killed tune left running would write too
        self.log = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed in `ended`)
        self.process = subprocess.Popen(self.words, stdout=subprocess.DEVNULL, stderr=self.log)

    def rows(self) -> list[dict[str, float]]:
        """Return its evaluations so far."""
        import pandas as pd

        path = self.folder / "evaluations.csv"
        try:
            text = path.read_text()
        except OSError:
            return []
        from io import StringIO

        whole = text[: text.rfind("\n") + 1]  # the last row may be on its way
        return [] if not whole else pd.read_csv(StringIO(whole)).to_dict("records")  # type: ignore[return-value]

    def ended(self) -> str:
        """Return the last line that it said."""
        self.log.seek(0)
        lines = [line.strip() for line in self.log if line.strip()]
        self.log.close()
        return lines[-1] if lines else "no output"

    def stop(self) -> None:
        """End it as Ctrl-C does: its folder says that it was stopped."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait()
        self.ended()


def tune(cfg, overrides):
    """Ask for settings, train with them, tell what came of it; prune by evaluations; report the best."""
    try:
        import optuna
    except ImportError:
        raise UserError("stage=tune needs optuna, which is not installed: pip install 'r2s[tune]'") from None
    from r2s.progress import Progress
    from r2s.reporting.tuning import against_table, trials_table, tuning_page

    given = {k: v for k, v in plain(cfg.tune).items() if k in {f.name for f in fields(Tune)}}
    how = called(Tune, "tune", given)
    check_trainings(cfg, overrides, how.space)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with open_run(cfg, overrides) as run:
        study = optuna.create_study(
            study_name="tune",
            storage=f"sqlite:///{run.folder / 'study.db'}",
            sampler=None,
            direction=MEASURES[how.measure],  # type: ignore[arg-type]
            load_if_exists=True,
        )
        # what was drawn is in the storage; the stream of a tune that goes on is another one
        seed = cfg.seed + 1000 * len(study.trials)
        study.sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=how.startup)
        study.pruner = optuna.pruners.MedianPruner(n_startup_trials=how.startup, n_warmup_steps=1)
        search(study, how, lambda trial: training(cfg, overrides, run, trial, how.space), Progress("tune"), cfg)
        trials = trials_table(study, run.folder)
        trials.to_csv(run.folder / "trials.csv", index=False)
        against = against_table(trials, how.measure, how.against, MEASURES[how.measure] == "maximize")
        done = trials[trials["state"] == "complete"]
        if done.empty:
            raise UserError(f"tune: none of {len(trials)} trials came to its end")
        order = done["value"] if MEASURES[how.measure] == "maximize" else -done["value"]
        best = done.sort_values("value", key=lambda _: order).iloc[-1]
        run.summary({"best": best.to_dict(), "trials": trials["state"].value_counts().to_dict()})
        tuning_page(run, trials, against, how.measure)
    out = console()
    words = " ".join(f"{k}={best[k]}" for k in how.space if k in best.index)
    out.print(f"best of {len(trials)} trials: {how.measure} {best['value']:.4g} with {words}", highlight=False)
    print(f"written: {run.folder} (look: {run.folder / 'report.md'})")


def handed(cfg, overrides, settings):
    """Return the words of a training: what was typed and it reads, and the settings {option: value}."""
    step = cfg.copy()
    step.stage = "train"
    typed = [o for o in handed_on(overrides, step) if not o.startswith(("resume=", "only_missing="))]
    return [*typed, *(f"{k}={v}" for k, v in settings.items()), "stage=train", "threads=1"]


def training(cfg, overrides, run, trial, space):
    """Return the started training of a trial."""
    name = f"{run.folder.name}_{trial.number}"
    words = handed(cfg, overrides, suggested(trial, space))
    folder = Path(cfg.root) / "train" / name
    folder.parent.mkdir(parents=True, exist_ok=True)
    return Training(trial, folder, [*front_door(), *words, f"root={cfg.root}", f"name={name}", "only_missing=true"])


def search(study, how, start, progress, cfg):
    """Run trials side by side until there are `how.trials`; those that were running before go on first."""
    import optuna

    states = optuna.trial.TrialState
    left = [optuna.trial.Trial(study, t._trial_id) for t in study.get_trials(states=[states.RUNNING])]
    running: list[Training] = []
    workers = how.workers or cfg.threads or os.cpu_count() or 1
    try:
        while True:
            while len(running) < workers and (left or len(study.trials) < how.trials):
                running.append(start(left.pop(0) if left else study.ask()))
            if not running:
                break
            time.sleep(0.2)
            for one in list(running):
                if followed(study, one, how.measure):
                    running.remove(one)
            finished = sum(t.state.is_finished() for t in study.get_trials(deepcopy=False))
            ended = study.get_trials(deepcopy=False, states=[states.COMPLETE])
            best = f", best {how.measure} {study.best_value:.4g}" if ended else ""
            progress(finished / how.trials, f"{finished} of {how.trials} trials{best}")
    finally:
        for one in running:
            one.stop()
    progress.close()


def followed(study, one, measure):
    """Report a training's evaluations; return whether it has ended, by itself or pruned."""
    import optuna

    status = one.process.poll()
    rows = one.rows()
    for k, row in enumerate(rows):
        if k not in one.told:
            one.trial.report(row[measure], k)
            one.told.add(k)
    if status is None:
        if not one.trial.should_prune():
            return False
        one.stop()
        study.tell(one.trial, state=optuna.trial.TrialState.PRUNED)
        return True
    said = one.ended()
    if "is still at it" in said or "is taken" in said:  # a training that a killed tune left running was faster
        one.begin()
        return False
    if status == 0:
        study.tell(one.trial, rows[-1][measure])
    elif status < 0 and one.begun < PATIENCE:  # the system ended it, as where memory is short
        one.begin()
        return False
    elif not rows:
        study.tell(one.trial, state=optuna.trial.TrialState.FAIL)
        raise UserError(f"tune: {one.folder.name} ended with exit status {status}: {said.removeprefix('error: ')}")
    else:  # a number that is not finite: so these settings do
        study.tell(one.trial, state=optuna.trial.TrialState.FAIL)
    return True
