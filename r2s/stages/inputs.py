"""Find the files and run folders that a job reads; meta.json records the SHA-256 of the files."""

from collections.abc import Iterable
from pathlib import Path

from r2s.files import OWN

PARENTS = (
    "calibration",
    "identify.from",
    "policy",
    "adapt.calibration",
    "estimate.surface",
    "dr.surface",
    "identify.gears.stiffness",
)  # config keys that name a run folder
# config keys that name a file; files inside the package need no digest, because the commit determines them
FILES = ("robot.mjcf", "robot.tool")
# files of a run folder that another job may read
READ = (
    *("config.yaml", "overrides.yaml", "policy.yaml", "summary.json", "measures.json", "evaluations.csv"),
    *("parameters.yaml", "posterior.npz", "contact.yaml", "contact_posterior.npz", "policy.pt", "timing.csv"),
    *("train.npz", "validation.npz", "ramps.npz", "contact.npz", "episodes_*"),
    *("gears.yaml", "gears.npz"),
)


def parents_of(cfg) -> list[str]:
    """Return the run folders and parameter files that a config names."""
    from omegaconf import OmegaConf

    copies = {"calibration": "parameters.yaml", "dr.surface": "contact.yaml"}  # a resumed run reads its copies
    keys = [k for k in PARENTS if not (cfg.resume and k in copies and (Path(cfg.resume) / copies[k]).is_file())]
    values = [OmegaConf.select(cfg, key) for key in keys]
    return [str(Path(value)) for value in values if isinstance(value, str) and value]


def files_of(cfg, parents: Iterable[str]) -> list[Path]:
    """Return the files that a job reads: the robot files that the config names, and files of `parents`.

    parents: run folders, from which a job reads the files READ, or parameter files with posterior.npz beside them.
    """
    from omegaconf import OmegaConf

    named = [str(value) for key in FILES if (value := OmegaConf.select(cfg, key))]
    found = [Path(name) for name in named if not name.startswith(OWN)]
    for parent in map(Path, parents):
        file = [parent, parent.with_name("posterior.npz")]
        found += [path for name in READ for path in sorted(parent.glob(name))] if parent.is_dir() else file
    return [path for path in found if path.is_file()]
