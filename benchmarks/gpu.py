"""Measure learning with device=cuda: updates beside TorchRL's, and one-minute trainings beside device=cpu.

`python benchmarks/gpu.py` needs a GPU. It writes benchmarks/results/gpu.md; `page` writes it from the kept figures,
runs/gpu/updates.json and runs/gpu/train/*.
"""

import json
import sys
from collections.abc import Callable

import torch
from bench import MODES, Mode, duel, make_tqc, random_batch, torchrl_update
from common import MACHINE, ROBOT, ROOT, markdown_rows, run_scripts, write_page
from tensordict.nn import CudaGraphModule

from r2s.learning.train import matmul_precision

RUNS_AT = ROOT / "runs" / "gpu"
SIZES = {"256 rows, 2 x [128, 128]": (256, (128, 128)), "4096 rows, 2 x [512, 512]": (4096, (512, 512))}
COMPILED = [mode for mode in MODES if mode.compiled]
COUNT = 100  # updates in a timed call
SEEDS = range(3)
DEVICES = ("cuda", "cpu")


def updates(mode: Mode, b: int, hidden: tuple[int, int]) -> dict[str, float]:
    """Return updates/s of r2s and of TorchRL's TQCLoss, both compiled and replayed as CUDA graphs, and on the CPU."""
    algo, batch = make_tqc(ROBOT, mode, b, hidden, "cuda"), random_batch(ROBOT, b)
    there = {k: v.cuda() for k, v in batch.items()}
    update = torchrl_update(algo, there, 5e-4)
    with matmul_precision(mode.matmul):  # as in TorchRL's sota-implementations
        theirs = CudaGraphModule(torch.compile(update), in_keys=[], out_keys=[], warmup=5)
    beside = make_tqc(ROBOT, mode, b, hidden)

    def repeated(call: Callable[[], object], count: int) -> Callable[[], object]:
        def run() -> None:
            with matmul_precision(mode.matmul):
                for _ in range(count):
                    call()
            torch.cuda.synchronize()

        return run

    ours, peer = duel(repeated(lambda: algo.update(there), COUNT), repeated(theirs, COUNT), COUNT)
    few = max(1, COUNT * 256 // b // 4)
    cpu = duel(repeated(lambda: beside.update(batch), few), lambda: 1.0, few)[0]
    return {"r2s, GPU": ours, "TorchRL, GPU": peer, "r2s, CPU": cpu}


def measure() -> None:
    """Write updates.json and train a minute per device and seed, one training at a time on all cores."""
    rows = {f"{size}, {mode}": updates(mode, *given) for size, given in SIZES.items() for mode in COMPILED}
    machine = {"gpu": torch.cuda.get_device_name(), "cpu": MACHINE, "torch": torch.__version__}
    RUNS_AT.mkdir(parents=True, exist_ok=True)
    (RUNS_AT / "updates.json").write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")
    kept = [f"root={RUNS_AT}", "skip_completed=true"]
    for seed in SEEDS:
        for device in DEVICES:
            words = [f"device={device}", f"seed={seed}", "budget.minutes=1", f"name={device}_{seed}"]
            run_scripts([["run.py", *words, *kept]])


def page() -> None:
    """Write the page."""
    kept = json.loads((RUNS_AT / "updates.json").read_text())
    rates = {
        what: {k: f"{v:,.0f}" for k, v in row.items()} | {"ratio": f"{row['r2s, GPU'] / row['TorchRL, GPU']:.2f}"}
        for what, row in kept["rows"].items()
    }
    trained = {}
    for device in DEVICES:
        found = [RUNS_AT / "train" / f"{device}_{seed}" / "summary.json" for seed in SEEDS]
        last = [json.loads(path.read_text())["last"] for path in found if path.is_file()]
        columns = {"1000 env steps": ("env_steps", 1e-3, 0), "< 1 cm, %": ("success_1cm", 100, 1)}
        columns |= {"median, mm": ("distance_median_m", 1e3, 1), "at rest, %": ("rest", 100, 1)}
        columns |= {"return": ("return_paper", 1, 1)}
        trained[f"device={device}"] = {
            name: ", ".join(f"{scale * row[key]:.{digits}f}" for row in last)
            for name, (key, scale, digits) in columns.items()
        }
    parts = [
        f"{kept['machine']['gpu']}; {kept['machine']['cpu']}; torch {kept['machine']['torch']}.",
        "TQC updates/s; both compiled, then replayed as CUDA graphs.",
        markdown_rows(rates, "batch, networks, mode"),
        "Default training for one minute; the physics runs on the CPU in both rows.",
        markdown_rows(trained, "training"),
    ]
    write_page("gpu", "Learning on a GPU", "python benchmarks/gpu.py", parts)


if __name__ == "__main__":
    if sys.argv[1:] not in ([], ["page"]):
        sys.exit(f"error: gpu.py: unknown argument '{sys.argv[1]}'; allowed: page")
    if len(sys.argv) == 1:
        if not torch.cuda.is_available():
            sys.exit("error: gpu.py: torch finds no GPU")
        measure()
    page()
