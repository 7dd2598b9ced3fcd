"""Run the numeric tests again as other processors would: `make test-portable`.

A processor decides which kernels the libraries pick, and with them the last bits: fused multiply-adds or not, sums in
2, 4 or 8 lanes. Each row of PROCESSORS makes the libraries pick what they would there; `make test` and
`make test-long` run them as this processor. numba needs no row: it fuses no multiply with an add and reorders no sum,
so its code rounds alike everywhere, and one cache serves all rows. Rows that need more than this processor has are
skipped, with a line. A variable that is set already stays as it is, since this machine may need it.
"""

import importlib
import os
import subprocess
import sys
from pathlib import Path

# tests that compare bits, or numbers within a tolerance, through linear algebra, sums or torch
NUMERIC = (
    *("physics", "regressor", "driver", "engines", "oracle", "twin", "breakaway", "identify", "tqc", "algorithms"),
    *("identify_torque", "env", "excitation", "contact_physics", "push_limit", "presliding"),
    *("breakaway_by_hand", "ramp_files", "friction_families", "simulator", "losses", "cable_torque"),
)
# What is no matter of rounding: a million cycles, what torch compiles for the processor that it finds, and mistakes
LEFT_OUT = (
    *("hostile_policy", "nor_those_of_an_fr3", "compiled_learns", "without_a_compiler"),
    *("one_line", "refused", "named", "interrupted_run"),
)
# what a processor must have for a row (in numpy's names for the levels of x86-64), and the settings of the libraries
PROCESSORS = {
    # a desktop: AVX2 and fused multiply-adds
    "haswell": (
        "X86_V3",
        {
            "OPENBLAS_CORETYPE": "Haswell",
            "ATEN_CPU_CAPABILITY": "avx2",
            "MKL_ENABLE_INSTRUCTIONS": "AVX2",
            "ONEDNN_MAX_CPU_ISA": "AVX2",
        },
    ),
    # plain x86-64: no fused multiply-add in numpy, torch and the C library; OpenBLAS as it likes
    "generic": (
        "X86_V2",
        {
            "ATEN_CPU_CAPABILITY": "default",
            "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
            "ONEDNN_MAX_CPU_ISA": "SSE41",
            "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4",
        },
    ),
}
RANK = ["X86_V2", "X86_V3", "X86_V4"]


def numpy_features() -> tuple[dict[str, bool], list[str]]:
    """Return which features this processor has by numpy's names, and those whose kernels numpy can leave out."""
    numpy = importlib.import_module("numpy._core._multiarray_umath")
    return numpy.__cpu_features__, numpy.__cpu_dispatch__


def environment(level: str, libraries: dict[str, str], has: dict[str, bool], dispatched: list[str]) -> dict[str, str]:
    """Return the variables of a row: `libraries`, and numpy without its kernels for more than `level`."""
    kept = RANK[: RANK.index(level) + 1]
    more = [name for name in dispatched if has[name] and name not in kept]
    asked = libraries | ({"NPY_DISABLE_CPU_FEATURES": " ".join(more)} if more else {})
    for name in sorted(asked.keys() & os.environ.keys()):
        print(f"{name}={os.environ[name]} is set here and stays: not {asked.pop(name)!r}", flush=True)
    return asked


def main(words: list[str]) -> int:
    """Run pytest once for each processor, with `words` added; return 0 if all passed, else 1."""
    has, dispatched = numpy_features()
    failed = []
    for name, (level, libraries) in PROCESSORS.items():
        print(f"\n== as a processor of kind {name}", flush=True)
        if not has.get(level):
            print(f"skipped: this processor has no {level}", flush=True)
            continue
        asked = environment(level, libraries, has, dispatched)
        files = [f"tests/test_{file}.py" for file in NUMERIC]
        rest = " and ".join(f"not {word}" for word in LEFT_OUT)
        command = [sys.executable, "-m", "pytest", "-m", "not slow", "-k", rest, *words, *files]
        if subprocess.run(command, cwd=Path(__file__).parent.parent, env=os.environ | asked).returncode:
            failed.append(name)
    print(f"\nfailed as: {', '.join(failed)}" if failed else "\npassed as every processor that was tried")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
