"""`hydra/launcher=ray`: the jobs of a sweep as Ray tasks, on this machine or on a cluster.

Hydra finds launchers in this namespace. Ray begins a job again where its worker or its node died; only a job with
only_missing=true may be, for it goes on in its run folder, where any other would be done twice.
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
    """One task per job.

    Args:
        address: of a cluster's head, "auto" for the one that this machine is in; None: Ray is started here, for this
            sweep.
        num_cpus: processors that a job takes, and its threads.
        num_gpus: graphics processors, or a share of one.
        retries: how often a job whose worker or node died is begun again.
    """

    def __init__(self, address: str | None = None, num_cpus: float = 1, num_gpus: float = 0, retries: int = 3):
        self.address, self.retries = address, retries
        self.each = {"num_cpus": num_cpus, "num_gpus": num_gpus}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Take what Hydra gives a launcher."""
        self.context, self.task, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run the jobs; return what came of each, in their order.

        Raises:
            UserError: Ray is not installed, or there is no cluster at the address.
        """
        from r2s.errors import UserError

        if self.address is None and "ray" not in sys.modules:
            # Ray listens at all addresses of the machine: nobody gets in without this word
            os.environ.setdefault("RAY_AUTH_MODE", "token")
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        try:
            import ray
        except ImportError:
            raise UserError("hydra/launcher=ray: ray is not installed: pip install 'r2s[ray]'") from None
        from hydra.core.singleton import Singleton

        own = not ray.is_initialized()
        paths = [str(Path(__file__).parent.parent), os.getcwd(), os.environ.get("PYTHONPATH", "")]
        os.environ["PYTHONPATH"] = os.pathsep.join(p for p in paths if p)  # of workers that are started here
        try:
            if own:
                ray.init(self.address, include_dashboard=False, logging_level="ERROR")
        except (ConnectionError, ValueError) as error:
            raise UserError(f"hydra.launcher.address: no cluster at '{self.address}': {error}") from None
        try:
            shared = ray.put((self.context, self.config, self.task, Singleton.get_state(), os.getcwd()))
            tasks = []
            for k, overrides in enumerate(job_overrides):
                again = self.retries if self._only_missing(overrides) else 0
                task = ray.remote(execute).options(max_retries=again, **self.each)
                tasks.append(task.remote(initial_job_idx + k, list(overrides), shared))
            return [_result(task, overrides) for task, overrides in zip(tasks, job_overrides, strict=True)]
        finally:
            if own:
                ray.shutdown()

    def _only_missing(self, overrides: Sequence[str]) -> bool:
        return bool(self.context.config_loader.load_sweep_config(self.config, list(overrides)).only_missing)


def execute(number: int, overrides: list[str], shared: Any) -> tuple[JobReturn, str]:
    """Run one job in a worker; return what came of it and what it noted for the end of the sweep."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.singleton import Singleton
    from hydra.core.utils import run_job, setup_globals

    context, config, task, state, at = shared
    if Path(at).is_dir():  # where relative paths, such as root=runs, were meant
        os.chdir(at)
    sys.path.append(at)
    setup_globals()
    Singleton.set_state(state)
    sweep = context.config_loader.load_sweep_config(config, overrides)
    with open_dict(sweep):
        sweep.hydra.job.id, sweep.hydra.job.num = f"{sweep.hydra.job.name}_{number}", number
    HydraConfig.instance().set_config(sweep)
    with TemporaryDirectory() as folder:
        failed = Path(folder) / "failed.txt"  # the sweep's own is on another machine, perhaps
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
    """Wait for a job; one that is lost with its worker is noted as failed, and leaves the others alone."""
    import ray

    try:
        done, noted = ray.get(task)
    except ray.exceptions.RayTaskError:  # the job's own exception: a fault of the program, with its trace
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
