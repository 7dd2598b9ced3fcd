"""What works under a policy on an arm: the adapter of conf/adapt, with what was identified of that arm."""

import filecmp
import inspect
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from r2s.errors import UserError, check_number
from r2s.stages.build import called, loaded, make_robot, make_task, open_run, part, plain, set_threads, target

RECORDINGS = ("train.npz", "validation.npz")  # of an identification
PARAMETERS = "parameters.yaml"
COMPARES = "commanded"  # torque: what adapters compare motion with
BESIDE = ("calibration", "training", "told", "latent")  # of conf/adapt, what is no argument of the adapter


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
    if is_told(cfg) and (own := trained_with(source)) != cfg.adapt.name:
        raise UserError(
            f"{name}: the policy of {source} was trained with adapt={own}, and is told nothing of this kind; "
            f"give one of stage=train {name}"
        )
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
    return part(cfg.adapt, "adapt", Known(robot, dynamics, posterior, unloaded, source), beside=BESIDE)


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
    """Return whether conf/adapt is learnt by itself, under any policy."""
    return "training" in cfg.adapt and not is_told(cfg)


def is_told(cfg):
    """Return whether a policy has to be trained with conf/adapt: it is told something."""
    return bool(cfg.adapt.get("told"))


def trained_with(source):
    """Return the adapter that the policy of a run folder is told by; none, where it is told nothing."""
    config = loaded(source / "config.yaml")
    return config.adapt.name if "adapt" in config and is_told(config) else "none"


def trained_minutes(cfg, source):
    """Return the minutes that a training took which conf/adapt alone needs; None where its folder does not say.

    It is that of the policy in `source` where it is told something, that of the network where one is taught.
    """
    from r2s.runs import read_meta

    if not is_told(cfg) and not is_taught(cfg):
        return 0.0
    try:
        return read_meta(source if is_told(cfg) else Path(cfg.adapt.network))["wall_clock_s"] / 60
    except (UserError, KeyError):  # a policy or a network may come without its meta.json
        return None


def told_of(cfg, robot):
    """Return what a policy is told with conf/adapt, `Told`; None: nothing."""
    from r2s.adaptation.telling import said_count
    from r2s.learning.networks import Told

    if not is_told(cfg):
        return None
    if "latent" in cfg.adapt:
        check_number("adapt.latent", cfg.adapt.latent, "[1, 64]", whole=True)
    return Told(said_count(robot.n), cfg.adapt.get("latent", 0))


def lessons_of(cfg):
    """Return adapt.training as `Lessons`."""
    from r2s.learning.history import Lessons

    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in plain(cfg.adapt.training).items()}
    return called(Lessons, "adapt.training", settings)


def told_draw(cfg, robot, center, draw):
    """Return arms as `draw` has them, changed, of which a policy is told: with adapt.training.

    Raises:
        UserError: conf/dr changes arms in ways that it is not told of, or policies of conf/algo are told nothing.
    """
    from r2s.learning.altered import Altered
    from r2s.learning.randomization import Pushes

    if isinstance(draw, Pushes):
        raise UserError(
            f"dr: a policy of adapt={cfg.adapt.name} is not told of random forces; another dr= is allowed"
        )
    if cfg.dr.get("payload") is not None:
        raise UserError(f"dr.payload: with adapt={cfg.adapt.name} it is adapt.training.payload=; leave it out")
    if "told" not in inspect.signature(target(cfg.algo, "algo")).parameters:
        raise UserError(
            f"algo={cfg.algo.name}: its policies are told nothing; with adapt={cfg.adapt.name} tqc is allowed"
        )
    lessons = lessons_of(cfg)
    return Altered(robot, center, draw, lessons.payload, lessons.friction, lessons.late)


def make_lessons(cfg):
    """Return robot, task, identified dynamics and lessons of a network of conf/adapt that is to be taught.

    Raises:
        UserError: it cannot be taught with this config.
    """
    from r2s.tasks.track import TrackTask

    if not cfg.calibration:
        raise UserError(f"adapt={cfg.adapt.name}: it is taught for one arm; give calibration=RUN_FOLDER")
    robot = make_robot(cfg)
    center, _, _ = calibrated(cfg.calibration, robot)
    task = make_task(cfg, robot, center)
    if not isinstance(task, TrackTask) or task.base != "model":
        raise UserError(f"task: adapt={cfg.adapt.name} is taught on task=track with task.base=model")
    return robot, task, center, lessons_of(cfg)


def teach(cfg, overrides, keep):
    """Train the network of conf/adapt for the arm of `calibration=`; keep(cfg, folder) copies what was identified."""
    from r2s.adaptation.believed import believed
    from r2s.adaptation.network_file import NETWORK, save_network
    from r2s.learning import history
    from r2s.learning.randomization import identified

    set_threads(cfg)
    robot, task, center, lessons = make_lessons(cfg)
    draw = identified(robot, center, cfg.calibration)
    with open_run(cfg, overrides, parents=[str(cfg.calibration)]) as run:
        keep(cfg, run.folder)
        began = time.process_time()
        with listening(lessons) as shown:
            network, explained = history.teach(robot, task, center, draw, lessons, cfg.seed, shown)
        save_network(run.folder / NETWORK, believed(robot, center), network)
        seconds = time.process_time() - began
        run.summary({"adapter": cfg.adapt.name, "explained": explained, "processor_s": seconds})
        print(f"of what arms lacked that it had not seen it tells {100 * explained:.1f} %; {seconds:.0f} s of a core")
    print(f"written: {run.folder}")


@contextmanager
def listening(lessons):
    """Give what shows how far a network's lessons are."""
    from r2s.progress import Progress

    progress = Progress("listen to arms that carry something")
    yield lambda k, n: progress(k / n, f"{k * lessons.arms} episodes")
    progress.close()


def teach_latent(cfg, folder, robot, task, center, draw, policy):
    """Train what says the latent of a policy, into its run folder; return a row of the summary."""
    from r2s.adaptation.believed import believed
    from r2s.adaptation.network_file import NETWORK, save_network
    from r2s.learning import student

    began, lessons = time.process_time(), lessons_of(cfg)
    with listening(lessons) as shown:
        network, explained = student.teach_latent(robot, task, center, draw, policy, lessons, cfg.seed, shown)
    save_network(folder / NETWORK, believed(robot, center), network, folder)
    seconds = time.process_time() - began
    print(f"of the latent of arms that it had not seen it tells {100 * explained:.1f} %; {seconds:.0f} s of a core")
    return {"explained": explained, "processor_s": seconds}
