"""Read the measure table of a run folder."""

from pathlib import Path

from r2s.tasks.measures import MeasureTable, read_measures


def measures_of(folder: Path) -> MeasureTable:
    """Return the table in measures.json; for an older run without this file, infer the table from the run's results.

    Raises:
        UserError: measures.json is damaged.
    """
    table = read_measures(folder)
    if table is not None:
        return table
    from r2s.tasks.reach import REACH  # imports torch, which `r2s list` avoids
    from r2s.tasks.track import TRACK

    files = [folder / name for name in ("evaluations.csv", "summary.json")]
    text = "".join(path.read_text() for path in files if path.is_file())
    return TRACK if TRACK.selection[0] in text else REACH
