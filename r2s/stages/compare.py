"""stage=compare: runs of stage=train side by side, or of stage=transfer: the league of adapters."""

from r2s.stages.build import console, make_robot, open_run

WHY: dict[str, str] = {}
LEAGUE = "stage=compare makes the league of transfers where runs= matches no training, such as runs='runs/transfer/*'"


def reads(cfg):
    """Return the keys of the config that this stage reads."""
    return {"runs", "robot"}


def compare(cfg, overrides):
    """Put trainings side by side; where there are only transfers, make the league of adapters of these."""
    from glob import glob

    from r2s.errors import UserError
    from r2s.reporting.trainings import in_words, trainings_among
    from r2s.reporting.transfers import read_transfers

    folders = sorted(glob(cfg.runs or ""))
    if not folders:
        raise UserError(f"runs: nothing matches '{cfg.runs}'; such as runs='runs/train/*'")
    trained, others = trainings_among(folders)
    if trained:
        trainings(cfg, overrides, trained, others)
        return
    carried, left = read_transfers(folders)
    if carried:
        league_of(cfg, overrides, carried, left)
        return
    seen = {k: left[k] if why == "stage=transfer" else why for k, why in others.items()}
    raise UserError(
        "runs: no finished run of stage=train or stage=transfer among them, such as runs='runs/train/*' has; "
        f"seen: {'; '.join(in_words(seen))}"
    )


def trainings(cfg, overrides, trained, others):
    """Put runs of stage=train side by side: tables with intervals over seeds, learning curves."""
    from r2s.reporting import pages
    from r2s.reporting.grouping import group
    from r2s.reporting.tables import print_table, scores_rows
    from r2s.reporting.trainings import comparable, in_words

    runs, apart = comparable(trained)
    grouped = group(runs)
    with open_run(cfg, overrides, parents=[str(r.folder) for r in runs]) as run:
        tables = pages.compare(run, make_robot(cfg), grouped, apart, others)
        run.summary({name: table.to_dict("records") for name, table in tables.items()})
        title = f"{len(runs)} runs, last evaluation: interquartile mean over seeds [95 % interval]"
        out = console()
        print_table(out, scores_rows(tables["scores"]), title)
        say(out, [f"{label} = {name}" for label, name in grouped.key.items()])
        say(out, [f"set apart, not comparable with these: {words}" for words in in_words(apart)])
        say(out, [f"left out, no finished trainings: {'; '.join(in_words(others))}"] if others else [])
        say(out, [LEAGUE] if "stage=transfer" in others.values() else [])
    print(f"written: {run.folder} (look: {run.folder / 'report.md'})")


def league_of(cfg, overrides, carried, others):
    """Put runs of stage=transfer side by side: a row per adapter, a column per condition, paired intervals."""
    from r2s.reporting import league_page
    from r2s.reporting.league import league
    from r2s.reporting.tables import print_table
    from r2s.reporting.trainings import in_words
    from r2s.reporting.transfers import comparable

    runs, apart = comparable(carried)
    made = league(runs)
    with open_run(cfg, overrides, parents=[str(r.folder) for r in runs]) as run:
        tables = league_page.write(run, make_robot(cfg), made, apart, others)
        run.summary({"league": made.scores.to_dict("records"), "costs": made.costs.to_dict("index")})
        out = console()
        say(out, [league_page.heading(made)])
        for title, table in tables.items():
            print_table(out, table, title)
        say(out, league_page.lines(made))
        say(out, [f"set apart, not comparable with these: {words}" for words in in_words(apart)])
        say(out, [f"left out, no finished transfers to an arm: {'; '.join(in_words(others))}"] if others else [])
    print(f"written: {run.folder} (look: {run.folder / 'report.md'})")


def say(out, lines):
    """Print lines as they are."""
    for line in lines:
        out.print(line, markup=False, highlight=False)
