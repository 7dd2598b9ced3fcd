"""2,000 recordings, files of run folders and command lines, each changed so that it is nonsense or damaged.

Hypothesis draws them, from fixed seeds. Files are read here, a command is typed in a process of its own, up to where
its run folder would be made.
Three ends are good: one line that begins with `error:` and exit status 2; a command that may stand; a file whose
content may stand, judged here by what it holds and not by the code that read it.
"""

import json
from collections import Counter
from pathlib import Path

from mutated import COUNTS, SEEDS
from mutated_commands import mutate_commands
from mutated_files import mutate_files
from mutated_recordings import mutate_recordings


def mutate(at: Path, err: Path) -> dict:
    """Do all; return the counts, and every case that ended badly."""
    rows = []
    for part in (mutate_recordings, mutate_files, mutate_commands):
        folder = at / part.__name__
        folder.mkdir()
        own = part(folder, err)
        print(part.__name__, Counter(r["end"] for r in own), flush=True)
        for r in own:
            if r["end"] in ("traceback", "nonsense") or r.get("left"):
                print(json.dumps(r, ensure_ascii=False), flush=True)
        rows += own
    bad = [r for r in rows if r["end"] in ("traceback", "nonsense") or r.get("left")]
    counts = {kind: Counter(r["end"] for r in rows if r["kind"] == kind) for kind in COUNTS}
    return {"counts": counts, "bad": bad, "left": sum(len(r.get("left", [])) for r in rows), "seeds": SEEDS}
