"""`hydra/launcher=ray`: run the jobs of a sweep as Ray tasks, on this machine or on a cluster.

Hydra finds launchers in this namespace. If a worker or node dies, Ray restarts jobs with skip_completed=true, which
continue in their run folders. It restarts no other job, which would start a second run.
"""

import os
import secrets
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict


class RayLauncher(Launcher):
    """Hydra launcher that runs each job as one Ray task.

    Args:
        address: of the cluster's head node, or "auto" for this machine's cluster; None: start Ray for this sweep.
        num_cpus, num_gpus: number per job; a job may use a fraction of a GPU.
        retries: largest number of restarts of a job whose worker or node died.
    """

    def __init__(self, address: str | None = None, num_cpus: float = 1, num_gpus: float = 0, retries: int = 3):
        self.address, self.retries = address, retries
        self.each = {"num_cpus": num_cpus, "num_gpus": num_gpus}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Store what Hydra passes before a launch."""
        self.context, self.task, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run the jobs in parallel, and return their results in the order of the jobs.

        Raises:
            UserError: Ray is not installed, or there is no cluster at the address.
        """
        from r2s.errors import UserError, optional_import

        if self.address is None and "ray" not in sys.modules:
            # Ray accepts connections on all addresses of the machine; this token protects it
            os.environ.setdefault("RAY_AUTH_MODE", "token")
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        ray = optional_import("ray", "hydra/launcher=ray", "sweeps")
        from hydra.core.singleton import Singleton

        own = not ray.is_initialized()
        paths = [str(Path(__file__).parent.parent), os.getcwd(), os.environ.get("PYTHONPATH", "")]
        os.environ["PYTHONPATH"] = os.pathsep.join(p for p in paths if p)  # for workers on this machine
        try:
            if own:
                ray.init(self.address, include_dashboard=False, logging_level="ERROR")
        except (ConnectionError, ValueError) as error:
            raise UserError(f"hydra.launcher.address: no cluster at '{self.address}': {error}") from None
        try:
            shared = ray.put((self.context, self.config, self.task, Singleton.get_state(), os.getcwd()))
            tasks = []
            for k, overrides in enumerate(job_overrides):
                again = self.retries if self._resumable(overrides) else 0
                task = ray.remote(execute).options(max_retries=again, **self.each)
                tasks.append(task.remote(initial_job_idx + k, list(overrides), shared))
            return [_result(task, overrides) for task, overrides in zip(tasks, job_overrides, strict=True)]
        finally:
            if own:
                ray.shutdown()

    def _resumable(self, overrides: Sequence[str]) -> bool:
        return bool(self.context.config_loader.load_sweep_config(self.config, list(overrides)).skip_completed)


def execute(number: int, overrides: list[str], shared: Any) -> tuple[JobReturn, str]:
    """Run one job in a worker; return its result, and a text with one line per error."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.singleton import Singleton
    from hydra.core.utils import run_job, setup_globals

    context, config, task, state, at = shared
    if Path(at).is_dir():  # relative paths such as root=runs begin at this folder
        os.chdir(at)
    sys.path.append(at)
    setup_globals()
    Singleton.set_state(state)
    sweep = context.config_loader.load_sweep_config(config, overrides)
    with open_dict(sweep):
        sweep.hydra.job.id, sweep.hydra.job.num = f"{sweep.hydra.job.name}_{number}", number
    HydraConfig.instance().set_config(sweep)
    with TemporaryDirectory() as folder:
        failed = Path(folder) / "failed.txt"  # the sweep's own file may be on another machine
        os.environ["R2S_FAILED"] = str(failed)
        done = run_job(
            hydra_context=context,
            config=sweep,
            task_function=task,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )
        return done, failed.read_text() if failed.is_file() else ""


def _result(task: Any, overrides: Sequence[str]) -> JobReturn:
    """Wait for a job and return its result. A job whose worker was lost counts as failed; the others run on."""
    import ray

    try:
        done, noted = ray.get(task)
    except ray.exceptions.RayTaskError:  # an exception of the job itself
        raise
    except ray.exceptions.RayError as error:
        words = " ".join(str(error).split())[:300]
        noted = f"{' '.join(overrides)}: its worker was lost ({type(error).__name__}: {words})\n"
        print(f"error: {noted}", end="", file=sys.stderr)
        done = JobReturn(overrides=overrides, status=JobStatus.COMPLETED)
    if noted and "R2S_FAILED" in os.environ:
        with open(os.environ["R2S_FAILED"], "a") as file:
            file.write(noted)
    return done
