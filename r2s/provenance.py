"""Where a result comes from: commit, versions, machine, and digests of files."""

import hashlib
import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = (
    "mujoco",
    "torch",
    "torchrl",
    "tensordict",
    "hydra-core",
    "pymoo",
    "dartpy",
    "numba",
    "numpy",
    "scipy",
)


def sha256(path: str | Path) -> str:
    """Return the hex digest of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def git() -> dict[str, Any]:
    """Return the commit of the checkout, and whether it has changes; None where there is none."""
    root = Path(__file__).parent.parent
    if not (root / ".git").exists():  # installed, perhaps within somebody else's repository
        return {"commit": None, "dirty": None}

    def ask(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    changes = ask("status", "--porcelain")
    return {"commit": ask("rev-parse", "HEAD"), "dirty": None if changes is None else bool(changes)}


def packages() -> dict[str, str | None]:
    """Return the versions of the packages that results depend on, and of Python."""

    def version_of(package: str) -> str | None:
        try:
            return version(package)
        except PackageNotFoundError:
            return None

    return {package: version_of(package) for package in PACKAGES} | {"python": platform.python_version()}


def machine() -> dict[str, Any]:
    """Return processor, cores and system of this computer."""
    return {"cpu": cpu(), "cores": os.cpu_count(), "system": platform.platform(terse=True)}


def cpu() -> str:
    """Return what the processor calls itself."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
