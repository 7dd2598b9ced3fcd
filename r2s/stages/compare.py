"""stage=compare: runs of stage=train side by side."""

from r2s.stages.build import console, make_robot, open_run

WHY: dict[str, str] = {}


def reads(cfg):
    """Return the keys of the config that this stage reads."""
    return {"runs", "robot"}


def compare(cfg, overrides):
    """Put runs of stage=train side by side: tables with intervals over seeds, learning curves."""
    from glob import glob

    from r2s.errors import UserError
    from r2s.reporting import pages
    from r2s.reporting.grouping import group
    from r2s.reporting.tables import print_table, scores_rows
    from r2s.reporting.trainings import comparable, in_words, read_trainings

    folders = sorted(glob(cfg.runs or ""))
    if not folders:
        raise UserError(f"runs: nothing matches '{cfg.runs}'; such as runs='runs/train/*'")
    trained, others = read_trainings(folders)
    runs, apart = comparable(trained)
    grouped = group(runs)
    with open_run(cfg, overrides, parents=[str(r.folder) for r in runs]) as run:
        tables = pages.compare(run, make_robot(cfg), grouped, apart, others)
        run.summary({name: table.to_dict("records") for name, table in tables.items()})
        title = f"{len(runs)} runs, last evaluation: interquartile mean over seeds [95 % interval]"
        out = console()
        print_table(out, scores_rows(tables["scores"]), title)
        lines = [f"{label} = {name}" for label, name in grouped.key.items()]
        lines += [f"set apart, not comparable with these: {words}" for words in in_words(apart)]
        lines += [f"left out, no finished trainings: {'; '.join(in_words(others))}"] if others else []
        for line in lines:
            out.print(line, markup=False, highlight=False)
    print(f"written: {run.folder} (look: {run.folder / 'report.md'})")
