"""The whole pipeline on development twin 0, as `make run` runs it.

`python benchmarks/pipeline.py` writes benchmarks/results/pipeline.md; a finished run is not repeated.
"""

import json
import subprocess
import sys

from common import ROOT, markdown, write_page

from r2s.reporting.tables import diagnostic_rows, measure_rows
from r2s.tasks.reach import REACH

RUN = ROOT / "runs" / "pipeline" / "page"


def main() -> None:
    """Run the pipeline and write the page."""
    if not (RUN / "summary.json").is_file():
        subprocess.run([sys.executable, "run.py", "stage=pipeline", f"name={RUN.name}"], cwd=ROOT, check=True)
    seconds = json.loads((RUN / "meta.json").read_text())["wall_clock_s"]
    rows = json.loads((RUN / "summary.json").read_text())["reach"]
    parts = [
        f"One seed, twin 0, 200 goals. {seconds / 60:.1f} minutes.",
        markdown(measure_rows(REACH, rows)),
        markdown(diagnostic_rows(REACH, rows)),
    ]
    write_page("pipeline", "The whole pipeline", "python benchmarks/pipeline.py", parts)


if __name__ == "__main__":
    main()
