"""Make the adapter of conf/adapt from the identified model of an arm."""

import filecmp
from dataclasses import replace
from pathlib import Path

from r2s.errors import UserError
from r2s.stages.build import part, plain
from r2s.stages.run_config import checked, loaded, modules

RECORDINGS = ("train.npz", "validation.npz")  # files that stage=identify writes when it records an arm
PARAMETERS = "parameters.yaml"
TORQUE = "commanded"  # adapters compare the commanded torque with the motion
BESIDE = ("calibration",)  # keys of conf/adapt that are not arguments of the adapter's class


def calibrated(calibration, robot, trust=()):
    """Return the identified dynamics, (parameter space, posterior draws) and (training, validation recording).

    The first pair is None without posterior.npz. The second pair is None if a recording is missing.
    """
    from r2s.identification.parameter_file import load_parameters, load_posterior
    from r2s.recordings.readers import read

    space, x = load_parameters(calibration, robot, trust)
    folder = run_folder(calibration)
    posterior = (space, load_posterior(folder, space)) if (folder / "posterior.npz").is_file() else None
    unloaded = None
    if all((folder / name).is_file() for name in RECORDINGS):
        unloaded = tuple(read(folder / name, torque=TORQUE) for name in RECORDINGS)
    return space.dynamics(x), posterior, unloaded


def free_recordings(calibration):
    """Return the contact-free recordings from which the arm was identified, if their files still exist.

    If the recordings do not suffice to compute a contact threshold, print the reason and return [].
    """
    from r2s.adaptation.wrench import unfit_for_threshold
    from r2s.recordings.readers import read

    folder = run_folder(calibration)
    paths = [folder / name for name in RECORDINGS]
    try:
        if all(path.is_file() for path in paths):
            free = [read(path, torque=TORQUE) for path in paths]
        else:
            free = _given_recordings(folder)
        why = unfit_for_threshold(free) if free else None
    except UserError as error:
        free, why = [], str(error)
    if why:
        print(f"contact threshold: {why} (of {folder}); the default counts, for an arm without recordings")
    return [] if why else free


def _given_recordings(folder):
    """Return the recordings with commanded torque and without payload that a stage=identify run read from files.

    Raises:
        UserError: a file cannot be read with the settings of the run's config.
    """
    from omegaconf import OmegaConf

    from r2s.stages.build import make_robot
    from r2s.stages.data import read_file
    from r2s.stages.recordings import recording_files

    path = folder / "config.yaml"
    cfg = loaded(path) if path.is_file() else OmegaConf.create()
    if OmegaConf.select(cfg, "data.kind") != "recording" or not OmegaConf.select(cfg, "data.path"):
        return []
    cfg = checked(OmegaConf.masked_copy(cfg, ["robot", "data"]), path)
    files = [file for key in ("path", "validation") for file in recording_files(cfg, key)]
    files = [f for f in files if f.torque in (None, TORQUE) and f.payload is None and Path(f.path).exists()]
    robot = make_robot(cfg) if files else None
    return [r for r in (read_file(robot, file, file.path) for file in files) if r.torque == TORQUE]


def with_declared_payload(cfg, robot, dynamics, calibration):
    """Return the dynamics of an arm whose gravity compensation includes arm.declared_payload.

    If a payload was declared while the arm was recorded for `calibration`, the arm compensated this payload, and the
    identified model lacks it. The returned dynamics therefore declare only the change of payload since then.
    """
    from omegaconf import OmegaConf

    from r2s.physics.payload import mass_and_moment, payload_of

    path = run_folder(calibration) / "config.yaml" if calibration else None
    then = loaded(path) if path is not None and path.is_file() else OmegaConf.create()
    moved = OmegaConf.select(then, "stage") == "identify" and OmegaConf.select(then, "data.kind") == "arm"
    before = plain(then.arm).get("declared_payload") if moved else None
    now = plain(cfg.arm).get("declared_payload")
    if not now and not before:
        return dynamics
    payloads = (payload_of(value, robot.payload_max, "arm.declared_payload") for value in (now, before))
    declared, earlier = (mass_and_moment(robot, payload) for payload in payloads)
    return replace(dynamics, declared_payload=declared - earlier)


def make_adapter(cfg, robot, source):
    """Return the adapter of conf/adapt for the policy of the run folder `source`, or None for adapt=none.

    The adapter uses the identified model of adapt.calibration=, by default the model of the policy's training.

    Raises:
        UserError: there is no arm or no identified model, or the model was not identified from commanded torque.
    """
    from r2s.adaptation.adapters import AdapterContext

    if "_target_" not in cfg.adapt:
        return None
    name = f"adapt={cfg.adapt.name}"
    if cfg.arm.name == "none":
        raise UserError(f"{name}: an adapter needs an arm, got arm=none; give another arm=, or adapt=none")
    folder = calibration_of(cfg, source)
    torque = (loaded(folder / PARAMETERS).get("source") or {}).get("torque", TORQUE)
    if torque != TORQUE:
        raise UserError(f"{name}: expected a model identified with data.torque={TORQUE}, got {torque} ({folder})")
    dynamics, posterior, unloaded = calibrated(folder, robot, modules(cfg.get("trust")))
    if unloaded is None:
        print(f"{name}: {folder} has no recordings; the uncertainty of its model comes from priors")
    dynamics = with_declared_payload(cfg, robot, dynamics, folder)
    return part(cfg.adapt, "adapt", AdapterContext(robot, dynamics, posterior, unloaded), beside=BESIDE)


def calibration_of(cfg, source):
    """Return the run folder with the adapter's model: adapt.calibration, or by default the training's calibration=.

    If the run folder that the training's calibration= names no longer exists or has changed, return `source`, the
    training's own run folder, which contains a copy of the model but no recordings.
    """
    if cfg.adapt.get("calibration"):
        folder = run_folder(cfg.adapt.calibration)
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


def run_folder(path):
    """Return the run folder, given its path or the path of a file in the folder."""
    return Path(path) if Path(path).is_dir() else Path(path).parent
