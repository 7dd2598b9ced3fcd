"""stage=pipeline: identify, train and transfer on one computer, by separate commands with a run folder each.

For a task on a surface, the arm presses on the surface before the trainings, and r2s identifies the surface.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Thread
from typing import Any

from r2s.arm.stop_request import PARENT
from r2s.compiled import RELAYED
from r2s.errors import Stopped, UserError, check_number
from r2s.stages import identify, train, transfer
from r2s.stages.build import GROUP, console, is_simulated, make_robot, open_run, unread
from r2s.stages.parts import target
from r2s.stages.run_config import CONF, PACKAGE, PROGRAM, replayed

STEPS = {  # {first label of the step's commands: description}
    "identify": "record the arm and identify it",
    "surface": "press on the surface and identify it",
    "identified": "train on both models, in parallel",
    "transfer": "run the policies on the arm",
}
STOPPED = 3  # exit status of a command that ended because the arm stopped, see r2s/cli.py
MODELS = ("identified", "nominal")
# labels: computed torque and policy "identified" with adapter (both only with adapt=); identification of the surface
COMPUTED, ADAPTED, SURFACE = "computed", "adapted", "surface"
REFERENCE = "reference"  # for a task with contact: a controller with the identified model, without learning
ROWS = {
    COMPUTED: "computed torque",
    ADAPTED: "identified model + adapter",
    REFERENCE: "controller without learning, identified model",
}
PATHS = 6  # number of contact motions on the surface, 8 s each; the last motion is for validation
CHANGES = ("arm.payload", "arm.declared_payload", "arm.friction_scale", "arm.extra_delay_s")  # see `commands`
# keys that only learners read
UNLEARNED = ("algo", "budget", "reward", "costs", "evaluation.env_steps", "compile", "matmul", "device")
WHY = {
    "calibration": "it identifies the arm itself",
    "policy": "it trains its policies itself",
    "budget": "pipeline.train_minutes= sets the time; with null, budget= does",
    "skip_completed": "its steps have their own run folders",
}


def reads(cfg):
    """Return the config keys that the steps of stage=pipeline read, except keys that stage=pipeline sets."""
    keys = {"pipeline", *identify.reads(cfg), *train.reads(cfg), *transfer.reads(cfg)} - {"calibration", "policy"}
    return keys if cfg.pipeline.train_minutes is None else keys - {"budget"}


def overrides_for(overrides: Sequence[str], step: Any) -> list[str]:
    """Return the user's overrides that the stage in the config `step` reads."""
    own = ("stage=", "name=", "root=", "threads=", "pipeline.")
    return [o for o in overrides if not o.startswith(own) and not unread(o.lstrip("+~").split("=")[0], step)]


def run_step(words: dict[str, list[str]]) -> None:
    """Run the commands {label: words} in parallel; print each command's progress and finally its tables.

    If a command ends with an error or because the arm stopped, r2s terminates the commands that still run.

    Raises:
        UserError: a command failed. Stopped: the arm stopped during a command.
    """
    running: dict[str, subprocess.Popen] = {}
    last: dict[str, str] = {}

    def relay(label: str, process: subprocess.Popen) -> None:
        assert process.stderr is not None
        for line in process.stderr:
            if line.strip():
                last[label] = line.strip()
            print(f"  {label:<10} | {line.rstrip()}", file=sys.stderr, flush=True)

    def show(label: str, process: subprocess.Popen) -> None:
        assert process.stdout is not None
        if tables := process.stdout.read().strip("\n"):
            print(f"  {label}:\n{tables}\n", file=sys.stderr, flush=True)

    threads: dict[str, list[Thread]] = {}
    try:
        for label, typed in words.items():
            print(f"  {label:<10} $ {PROGRAM} {' '.join(typed)}", file=sys.stderr, flush=True)
            relayed = {"PYTHONUNBUFFERED": "1", RELAYED: "1", PARENT: str(os.getpid())}
            env, piped = os.environ | relayed, subprocess.PIPE
            process = subprocess.Popen([*command_prefix(), *typed], stdout=piped, stderr=piped, text=True, env=env)
            running[label] = process
            threads[label] = [Thread(target=do, args=(label, process), daemon=True) for do in (relay, show)]
            for thread in threads[label]:
                thread.start()
        for label, process in running.items():
            if process.wait() != 0:
                threads[label][0].join()
                if process.returncode == STOPPED:
                    raise Stopped(f"{label}: {last.get(label, 'no output').removeprefix('stopped: ')}")
                raise UserError(
                    f"{label} failed with exit status {process.returncode}: {last.get(label, 'no output')}"
                )
    finally:
        for process in running.values():
            if process.poll() is None:
                process.terminate()
        for thread in (t for both in threads.values() for t in both):
            thread.join(timeout=5)


def at_once(step: dict[str, list[str]], *, moves: bool) -> list[dict[str, list[str]]]:
    """Split a step into groups of parallel commands; if a physical arm `moves`, each group is a single command."""
    return [{label: words} for label, words in step.items()] if moves else [step]


def command_prefix() -> list[str]:
    """Return the command that starts r2s again, from this job's checkout or package, with this job's --config-dir."""
    from hydra.core.hydra_config import HydraConfig

    program = [str(PACKAGE.parent / "run.py")] if CONF.parent != PACKAGE else ["-m", "r2s"]
    own = [s.path for s in HydraConfig.get().runtime.config_sources if s.provider == "command-line"]
    return [sys.executable, *program, *(word for path in own for word in ("--config-dir", path))]


def compose_step(words: Sequence[str], option: str) -> Any:
    """Return the config of a command with the overrides `words`; error messages begin with `option`.

    Raises:
        UserError: Hydra rejects the overrides.
    """
    from hydra import compose
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        return replayed(compose("config", list(words)))  # Hydra already has the --config-dir of this job
    except (HydraException, OmegaConfBaseException) as error:
        reason = " ".join(str(error).split()).removeprefix("In 'config': ")
        reason = reason.split(" Config search path")[0].split(" To append")[0]
        raise UserError(f"{option}: {reason}") from None


def touches(cfg: Any) -> bool:
    """Return whether the task presses a tool on a surface, which r2s then identifies."""
    return bool(getattr(target(cfg.task, "task"), "touches", False)) and not moves_box(cfg)


def moves_box(cfg: Any) -> bool:
    """Return whether the task pushes a box; r2s does not identify the box's mass and friction."""
    return bool(getattr(target(cfg.task, "task"), "moves_box", False))


def labels(cfg: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the labels of the trainings and the labels of the transfers."""
    adapts = cfg.adapt.name != "none"
    unlearned = [REFERENCE] if touches(cfg) or moves_box(cfg) else [COMPUTED] if adapts else []
    trained = *MODELS, *unlearned
    return trained, (*trained, ADAPTED) if adapts else trained


def check_free(root: Path, name: str, cfg: Any) -> None:
    """Raise UserError if a run folder that the pipeline `name` would make exists already."""
    steps = [root / "identify" / name, *([root / "identify" / f"{name}_{SURFACE}"] if touches(cfg) else [])]
    for stage, each in zip(("train", "transfer"), labels(cfg), strict=True):
        steps += [root / stage / f"{name}_{m}" for m in each]
    if taken := [str(folder) for folder in steps if folder.exists()]:
        raise UserError(f"name: {name} is taken, {taken[0]} exists; give another name=")


def commands(cfg: Any, name: str, overrides: Sequence[str]) -> list[dict[str, list[str]]]:
    """Return the commands {label: words} of each step: identify the arm, identify a surface, train, transfer.

    The trainings on the identified and the nominal model differ only in the model: settings, time and computer are
    the same. With an adapter, the options CHANGES, which change a simulated arm, apply only to transfers. On a
    physical arm, arm.declared_payload applies to every command, because the arm's control box stores the payload.

    Args:
        cfg: config of the pipeline. name: name of the pipeline's run folder, with which all other folder names begin.
        overrides: overrides that the user typed; each command receives only the overrides that its stage reads.
    """
    root, choice = Path(cfg.root), chosen(overrides, cfg)
    both, adapts = cfg.threads or os.cpu_count() or 2, cfg.adapt.name != "none"

    def without(*heads: str) -> list[str]:
        return [o for o in overrides if not o.lstrip("+~").startswith(tuple(f"{h}{c}" for h in heads for c in "=."))]

    def step(
        stage: str, label: str, *words: str, calibration: str | None = None, typed: Sequence[str] = overrides
    ) -> list[str]:
        config = cfg.copy()
        config.stage, config.calibration = stage, calibration
        if typed is not overrides:  # `typed` is given only for commands without adapter
            config.adapt = {"name": "none"}
        full = f"{name}_{label}" if label != "identify" else name
        threads = cfg.threads if stage == "identify" else max(1, both // 2)
        head = [f"root={root}", f"stage={stage}", f"name={full}", f"threads={threads}"]
        return [*overrides_for(typed, config), *head, *words]

    minutes = cfg.pipeline.train_minutes
    budget = [] if minutes is None else [f"budget.minutes={minutes}"]
    known = f"calibration={root / 'identify' / name}"
    bare, touched = without("adapt"), touches(cfg)
    drawn = [f"dr.surface={root / 'identify' / f'{name}_{SURFACE}'}"] if touched and "surface" in cfg.dr else []
    trained = {
        "identified": step("train", "identified", *budget, known, *drawn, calibration=known, typed=bare),
        "nominal": step("train", "nominal", *budget, *choice, typed=bare),
    }
    unlearned = without("adapt", *UNLEARNED)
    if REFERENCE in labels(cfg)[0]:
        reference = "algo=pusher" if moves_box(cfg) else "algo=hybrid_force"
        words, typed = [reference, known, *drawn], [o for o in unlearned if not o.startswith("control")]
        trained[REFERENCE] = step("train", REFERENCE, *words, calibration=known, typed=typed)
    elif adapts:
        words, typed = ["algo=computed_torque", "dr=none", known], [o for o in unlearned if not o.startswith("dr")]
        trained[COMPUTED] = step("train", COMPUTED, *words, calibration=known, typed=typed)
    table = surface_words(cfg) if touched or moves_box(cfg) else []
    transferred = {}
    for label in labels(cfg)[1]:
        policy = f"policy={root / 'train' / f'{name}_{MODELS[0] if label == ADAPTED else label}'}"
        transferred[label] = step("transfer", label, policy, *table, typed=overrides if label == ADAPTED else bare)
    changes = CHANGES if adapts and is_simulated(cfg) else ()
    unchanged = without(*changes, *(["arm.surface"] if touched or moves_box(cfg) else []))
    steps = [{"identify": step("identify", "identify", typed=unchanged)}, trained, transferred]
    if touched:
        limits = [o for o in overrides if o.lstrip("+~").startswith("safety")]  # data.presses needs these
        words = [known, f"data.presses={PATHS}", *tool_words(cfg), *table, *limits]
        pressed = step("identify", SURFACE, *words, calibration=known, typed=without("adapt", "data", *changes))
        steps.insert(1, {SURFACE: pressed})
    return steps


def surface_words(cfg: Any) -> list[str]:
    """Return overrides that add the task's plane or box to a simulated arm without a surface."""
    if not is_simulated(cfg) or cfg.arm.get("surface"):
        return []
    plane = {k: cfg.task[k] for k in ("point", "normal")}
    if moves_box(cfg):
        plane = {"box": cfg.task.size} | ({} if None in plane.values() else plane)
    elif None in plane.values():
        return ["arm.surface=true"]
    return ["arm.surface={" + ",".join(f"{k}:{list(v)}" for k, v in plane.items()) + "}"]


def tool_words(cfg: Any) -> list[str]:
    """Return overrides that set the task's tool and plane for the identification of the surface."""
    tool = [f"robot.tool={cfg.task.tool}"] if cfg.robot.get("tool") is None else []
    given = {k: cfg.task[k] for k in ("point", "normal") if cfg.task[k] is not None}
    return tool + [f"data.press_{k}={list(v)}" for k, v in given.items()]


def add_friction(cfg: Any, surface: Path, trained: dict[str, list[str]], overrides: Sequence[str]) -> None:
    """Set task.friction to the identified value in trainings on the identified model, if the task has this key."""
    from r2s.identification.contact.contact_file import load_contact

    if "friction" not in cfg.task or any(o.startswith("task.friction=") for o in overrides):
        return
    for label in trained.keys() - {"nominal"}:
        trained[label].append(f"task.friction={load_contact(surface).simulated.surface.friction:.4g}")


def check_steps(cfg: Any, overrides: Sequence[str]) -> None:
    """Before the arm moves, raise UserError if identification or training would refuse an override."""
    first, *_, trained, _ = commands(cfg, cfg.name or "pipeline", overrides)
    step = compose_step(first["identify"], "stage=identify")
    if step.data.get("gears"):
        raise UserError("data.gears: stage=pipeline identifies the arm from free motion; use stage=identify")
    identify.make_parts(step)
    for label, words in trained.items():
        step = compose_step(words, f"the training '{label}'")
        for word in words:
            if why := unread(word.lstrip("+~").split("=")[0], step):
                raise UserError(f"the training '{label}': {why}")
    if COMPUTED in trained:  # algo=computed_torque refuses some control=; REFERENCE ignores control=
        bare = [word for word in trained[COMPUTED] if not word.startswith("calibration=")]
        bare += [word for word in overrides if word.lstrip("+~").startswith(("friction", "inertia"))]
        train.make_parts(compose_step([*bare, *chosen(overrides, cfg)], f"the training '{COMPUTED}'"))
    train.make_parts(compose_step(trained["nominal"], "stage=train"))  # other trainings need the identified model


def chosen(overrides: Sequence[str], cfg: Any) -> list[str]:
    """Return overrides (friction=, inertia=) that give a training the nominal model of the identification."""
    from hydra.core.hydra_config import HydraConfig

    choices = HydraConfig.get().runtime.choices
    typed = {o.split("=")[0] for o in overrides}
    return [f"{group}={choices[group]}" for group in ("friction", "inertia") if group not in typed]


def pipeline(cfg, overrides):
    """Run every command in a separate process; write a table, a viewer recording and a report of all commands."""
    from r2s.reporting import pages
    from r2s.reporting.tables import print_measures
    from r2s.runs import read_summary

    if cfg.pipeline.train_minutes is not None:
        check_number("pipeline.train_minutes", cfg.pipeline.train_minutes, "(0, inf)")
    robot, root = make_robot(cfg), Path(cfg.root)
    if "calibration" in cfg.dr:
        raise UserError(
            "dr: the nominal training of stage=pipeline has no calibration, which this dr= needs; give another dr="
        )
    if cfg.name and not (root / "pipeline" / cfg.name).exists():
        check_free(root, cfg.name, cfg)
    check_steps(cfg, overrides)
    with open_run(cfg, overrides) as run:
        name = run.folder.name
        check_free(root, name, cfg)
        os.environ.setdefault(GROUP, name)  # group of the steps in trackers
        identified, surface = root / "identify" / name, root / "identify" / f"{name}_{SURFACE}"
        steps = commands(cfg, name, overrides)
        for k, step in enumerate(steps, 1):
            what = STEPS.get(next(iter(step)), "") if step is not steps[-1] else STEPS["transfer"]
            print(f"{k}/{len(steps)} {what}", file=sys.stderr)
            if touches(cfg) and step is steps[-2]:
                add_friction(cfg, surface, step, overrides)
            for words in at_once(step, moves=step is steps[-1] and not is_simulated(cfg)):
                run_step(words)
        trained = {m: root / "train" / f"{name}_{m}" for m in MODELS}
        transferred = {ROWS.get(m, f"{m} model"): root / "transfer" / f"{name}_{m}" for m in labels(cfg)[1]}
        rows = {}
        for label, folder in transferred.items():
            for where, row in read_summary(folder, "transfer").items():
                rows[f"{label}, {where}"] = row
        found = {"contact": read_summary(surface, "identify")["contact"]} if touches(cfg) else {}
        run.summary({"identify": read_summary(identified, "identify"), **found, "reach": rows})
        measures = pages.pipeline(run, robot, identified, trained, transferred, rows)
        print_measures(console(), measures, rows, "policies trained on the identified and on the nominal model")
    print(f"written: {run.folder} (look: rerun {run.folder / 'recording.rrd'})")
