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
    from r2s.reporting.comparison import read_runs
    from r2s.reporting.tables import print_table, scores_rows

    folders = sorted(glob(cfg.runs or ""))
    if not folders:
        raise UserError(f"runs: nothing matches '{cfg.runs}'; such as runs='runs/train/*'")
    runs = read_runs(folders)
    with open_run(cfg, overrides, parents=[str(r.folder) for r in runs]) as run:
        tables = pages.compare(run, make_robot(cfg), runs)
        run.summary({name: table.to_dict("records") for name, table in tables.items()})
        title = f"{len(runs)} runs, last evaluation: interquartile mean [95 % interval over seeds]"
        print_table(console(), scores_rows(tables["scores"]), title)
    print(f"written: {run.folder} (look: {run.folder / 'report.md'})")
