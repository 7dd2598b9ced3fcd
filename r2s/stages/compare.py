"""stage=compare: compare trainings with each other, or transfers with different adapters."""

from r2s.stages.build import console, make_robot, open_run

WHY: dict[str, str] = {}
HINT = "stage=compare compares adapters if runs= has transfers only: runs='runs/transfer/*'"


def reads(cfg):
    """Return the config keys that stage=compare reads."""
    return {"runs", "robot"}


def compare(cfg, overrides):
    """Compare the trainings that `runs=` matches; if only transfers match, compare their adapters."""
    from glob import glob

    from r2s.errors import UserError
    from r2s.reporting.comparison.trainings import by_reason, trainings_among
    from r2s.reporting.comparison.transfers import read_transfers

    folders = sorted(glob(cfg.runs or ""))
    if not folders:
        raise UserError(f"runs: no folder matches '{cfg.runs}'; example: runs='runs/train/*'")
    trained, others = trainings_among(folders)
    if trained:
        compare_trainings(cfg, overrides, trained, others)
        return
    transferred, left = read_transfers(folders)
    if transferred:
        compare_transfers(cfg, overrides, transferred, left)
        return
    seen = {k: left[k] if why == "stage=transfer" else why for k, why in others.items()}
    raise UserError(
        "runs: expected finished runs of stage=train or stage=transfer (runs='runs/train/*'), got "
        f"{'; '.join(by_reason(seen))}"
    )


def compare_trainings(cfg, overrides, trained, others):
    """Write the comparison of trainings: tables with intervals over seeds, and learning curves."""
    from r2s.reporting.comparison.grouping import group
    from r2s.reporting.comparison.page import comparison_page
    from r2s.reporting.comparison.scores import at_edges
    from r2s.reporting.comparison.trainings import by_reason, comparable
    from r2s.reporting.tables import print_table, scores_rows

    runs, apart = comparable(trained)
    grouped = group(runs)
    with open_run(cfg, overrides, parents=[str(r.folder) for r in runs]) as run:
        tables = comparison_page(run, make_robot(cfg), grouped, apart, others)
        run.summary({name: table.to_dict("records") for name, table in tables.items()})
        title = f"{len(runs)} runs, last evaluation: interquartile mean over seeds [95 % interval]"
        out = console()
        print_table(out, scores_rows(runs[0].measures, tables["scores"]), title)
        print_lines(out, [f"{label} = {name}" for label, name in grouped.key.items()])
        print_lines(out, at_edges(grouped.members))
        print_lines(out, [f"not comparable with these: {words}" for words in by_reason(apart)])
        print_lines(out, [f"no finished trainings: {'; '.join(by_reason(others))}"] if others else [])
        print_lines(out, [HINT] if "stage=transfer" in others.values() else [])
    print(f"written: {run.folder} (report: {run.folder / 'report.md'})")


def compare_transfers(cfg, overrides, transferred, others):
    """Write the comparison of adapters: one row per adapter, one column per condition, with paired intervals."""
    from r2s.reporting.comparison.adapter_comparison import compare_adapters
    from r2s.reporting.comparison.adapter_comparison_page import heading, lines, write
    from r2s.reporting.comparison.trainings import by_reason
    from r2s.reporting.comparison.transfers import comparable
    from r2s.reporting.tables import print_table

    runs, apart = comparable(transferred)
    found = compare_adapters(runs)
    with open_run(cfg, overrides, parents=[str(r.folder) for r in runs]) as run:
        tables = write(run, make_robot(cfg), found, apart, others)
        run.summary({"adapter_comparison": found.scores.to_dict("records"), "costs": found.costs.to_dict("index")})
        out = console()
        print_lines(out, [heading(found)])
        for title, table in tables.items():
            print_table(out, table, title)
        print_lines(out, lines(found))
        print_lines(out, [f"not comparable with these: {words}" for words in by_reason(apart)])
        print_lines(out, [f"no finished transfers to an arm: {'; '.join(by_reason(others))}"] if others else [])
    print(f"written: {run.folder} (report: {run.folder / 'report.md'})")


def print_lines(out, lines):
    """Print lines on the console `out` without markup."""
    for line in lines:
        out.print(line, markup=False, highlight=False)
