"""What works under a policy on an arm: the adapter of conf/adapt, with what was identified of that arm."""

import filecmp
import time
from dataclasses import replace
from pathlib import Path

from r2s.errors import UserError
from r2s.stages.build import called, loaded, make_robot, make_task, open_run, part, plain, set_threads

RECORDINGS = ("train.npz", "validation.npz")  # of an identification
PARAMETERS = "parameters.yaml"
COMPARES = "commanded"  # torque: what adapters compare motion with
BESIDE = ("calibration", "training")  # of conf/adapt, what is no argument of the adapter


def calibrated(calibration, robot):
    """Return what an identification says of the arm: its dynamics, draws of them, and motion without a payload.

    The last two are None where they are not known.
    """
    from r2s.identification.parameter_file import load_parameters, load_posterior
    from r2s.recordings.readers import read

    space, x = load_parameters(calibration, robot)
    folder = Path(calibration)
    folder = folder if folder.is_dir() else folder.parent
    posterior = (space, load_posterior(folder, space)) if (folder / "posterior.npz").is_file() else None
    unloaded = None
    if all((folder / name).is_file() for name in RECORDINGS):
        unloaded = tuple(read(folder / name, torque="commanded") for name in RECORDINGS)
    return space.dynamics(x), posterior, unloaded


def make_adapter(cfg, robot, source):
    """Return the adapter of conf/adapt under the policy of the run folder `source`, or None.

    It has the identified model that the policy learnt on, unless adapt.calibration= names another.

    Raises:
        UserError: there is no arm to act on, no identified model, or one of another torque than the commanded.
    """
    from r2s.adaptation.adapters import Known
    from r2s.physics.payload import moment, payload_of

    if "_target_" not in cfg.adapt:
        return None
    name = f"adapt={cfg.adapt.name}"
    if cfg.arm.name == "none":
        raise UserError(f"{name}: an adapter acts on an arm, and arm=none is none; another arm=, or adapt=none")
    folder = calibration_of(cfg, source)
    torque = (loaded(folder / PARAMETERS).get("source") or {}).get("torque", COMPARES)
    if torque != COMPARES:
        raise UserError(
            f"{name}: {folder} was identified from {torque} torque, and the arm is commanded: a model from "
            f"data.torque={COMPARES} is allowed"
        )
    dynamics, posterior, unloaded = calibrated(folder, robot)
    if unloaded is None:
        print(f"{name}: {folder} has no recordings; how wrong its model is comes from priors")
    if cfg.arm.get("load"):  # what the arm was told of is no surprise
        told = moment(robot, payload_of(plain(cfg.arm)["load"], "arm.load"))
        dynamics = replace(dynamics, told=told)
    return part(cfg.adapt, "adapt", Known(robot, dynamics, posterior, unloaded), beside=BESIDE)


def calibration_of(cfg, source):
    """Return the run folder whose model an adapter has: adapt.calibration, or the policy's own.

    A training keeps the model, not the recordings: these are in the identification's folder, while it is there.
    """
    if cfg.adapt.get("calibration"):
        folder = Path(cfg.adapt.calibration)
        folder = folder if folder.is_dir() else folder.parent
        if not (folder / PARAMETERS).is_file():
            raise UserError(f"adapt.calibration: '{cfg.adapt.calibration}' is no run folder of stage=identify")
        return folder
    first = loaded(source / "config.yaml").calibration
    if not first:
        raise UserError(
            f"adapt={cfg.adapt.name}: the policy of {source} has no identified model; give "
            "adapt.calibration=RUN_FOLDER of stage=identify"
        )
    first = Path(first)
    same = (first / PARAMETERS).is_file() and filecmp.cmp(first / PARAMETERS, source / PARAMETERS, shallow=False)
    return first if same else source


def is_taught(cfg):
    """Return whether conf/adapt is learnt."""
    return "training" in cfg.adapt


def make_lessons(cfg):
    """Return robot, task, identified dynamics and lessons of a network of conf/adapt that is to be taught.

    Raises:
        UserError: it cannot be taught with this config.
    """
    from r2s.learning.history import Lessons
    from r2s.tasks.track import TrackTask

    if not cfg.calibration:
        raise UserError(f"adapt={cfg.adapt.name}: it is taught for one arm; give calibration=RUN_FOLDER")
    robot = make_robot(cfg)
    center, _, _ = calibrated(cfg.calibration, robot)
    task = make_task(cfg, robot, center)
    if not isinstance(task, TrackTask) or task.base != "model":
        raise UserError(f"task: adapt={cfg.adapt.name} is taught on task=track with task.base=model")
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in plain(cfg.adapt.training).items()}
    return robot, task, center, called(Lessons, "adapt.training", settings)


def teach(cfg, overrides, keep):
    """Train the network of conf/adapt for the arm of `calibration=`; keep(cfg, folder) copies what was identified."""
    from r2s.adaptation.adapters import NETWORK, save_network
    from r2s.adaptation.believed import believed
    from r2s.learning import history
    from r2s.learning.randomization import identified
    from r2s.progress import Progress

    set_threads(cfg)
    robot, task, center, lessons = make_lessons(cfg)
    draw = identified(robot, center, cfg.calibration)
    with open_run(cfg, overrides, parents=[str(cfg.calibration)]) as run:
        keep(cfg, run.folder)
        began, progress = time.process_time(), Progress("listen to arms that carry something")

        def shown(k, n):
            progress(k / n, f"{k * lessons.arms} episodes")

        network, explained = history.teach(robot, task, center, draw, lessons, cfg.seed, shown)
        progress.close()
        save_network(run.folder / NETWORK, believed(robot, center), network)
        seconds = time.process_time() - began
        run.summary({"adapter": cfg.adapt.name, "explained": explained, "processor_s": seconds})
        print(f"of what arms lacked that it had not seen it tells {100 * explained:.1f} %; {seconds:.0f} s of a core")
    print(f"written: {run.folder}")
