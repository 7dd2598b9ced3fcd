"""Record the provenance of a result: git commit, package versions, computer and digests of files."""

import hashlib
import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

# The packages on which numerical results depend.
PACKAGES = ("mujoco", "torch", "torchrl", "tensordict", "hydra-core", "pymoo", "dartpy", "numba", "numpy", "scipy")


def sha256(path: str | Path) -> str:
    """Return the SHA-256 digest of a file as hexadecimal text."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def git() -> dict[str, Any]:
    """Return the commit of the git checkout, and whether it has uncommitted changes; both None without a checkout."""
    root = Path(__file__).parent.parent
    if not (root / ".git").exists():  # an installed r2s may lie inside another project's repository
        return {"commit": None, "dirty": None}

    def run(*arguments: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    changes = run("status", "--porcelain")
    return {"commit": run("rev-parse", "HEAD"), "dirty": None if changes is None else bool(changes)}


def packages() -> dict[str, str | None]:
    """Return the versions of Python and PACKAGES; the version of a package that is not installed is None."""

    def version_of(package: str) -> str | None:
        try:
            return version(package)
        except PackageNotFoundError:
            return None

    return {package: version_of(package) for package in PACKAGES} | {"python": platform.python_version()}


def machine() -> dict[str, Any]:
    """Return processor, number of cores, GPUs and operating system."""
    return {"cpu": cpu(), "cores": os.cpu_count(), "gpus": gpus(), "system": platform.platform(terse=True)}


def gpus() -> list[str]:
    """Return the model names of the NVIDIA GPUs that the driver lists."""
    files = sorted(Path("/proc/driver/nvidia/gpus").glob("*/information"))
    lines = [line for path in files for line in path.read_text().splitlines()]
    return [line.split(":", 1)[1].strip() for line in lines if line.startswith("Model:")]


def cpu() -> str:
    """Return the processor's model name."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
