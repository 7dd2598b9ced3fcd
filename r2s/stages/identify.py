"""stage=identify: identify the arm from recordings; write parameters.yaml, prediction errors and figures."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from r2s.errors import UserError, check_number, choices
from r2s.files import located
from r2s.stages.build import base_dynamics, check_source, console, make_robot, open_run
from r2s.stages.contact import contact_data, identify_surface, stated_stiffness
from r2s.stages.data import check_cutoff, check_data, ramp_poses, read_user_ramps, record_arm
from r2s.stages.known_arm import identify_with_known_arm, with_known_arm
from r2s.stages.parts import part
from r2s.stages.payload import LoadedData, identify_load, loaded_data
from r2s.stages.prior import Earlier, check_known, earlier_run, make_settings, start_of
from r2s.stages.recordings import Group, read_groups, recording_files, whole

WHY = {
    "arm": "only data=arm moves an arm",
    "safety": "only data.presses touches a surface",
    "inertia": "calibration= gives the links",
    "friction": "calibration= gives the friction; friction.family= may change its law",
}


def reads(cfg):
    """Return the config keys that stage=identify reads."""
    keys = {"robot", "calibration", "identify", "search", "data"}
    keys |= {"friction.family"} if cfg.calibration else {"friction", "inertia"}
    keys |= {"safety"} if cfg.data.get("presses") else set()
    return keys | ({"arm"} if cfg.data.kind == "arm" else set())


@dataclass(frozen=True)
class Parts:
    """Inputs of an identification, checked before a run folder is made.

    groups, ramps: the recordings and ramps of data=recording; for other data=, r2s records motion and ramps later.
    motion: the motion in data.excitation. earlier: the identification that identify.from names.
    """

    robot: Any
    nominal: Any
    searches: list[Any]
    inputs: list[Path | str]
    motion: Any = None
    groups: tuple[Group, ...] = ()
    ramps: Any = None
    contact: Any = None
    loaded: Any = None
    earlier: Any = None


def make_parts(cfg):
    """Return the inputs of an identification, without connecting to a physical arm.

    Raises:
        UserError: settings contradict each other, or a file is missing or wrong.
    """
    from r2s.excitation.motion import load
    from r2s.identification.stated import check_stated

    robot = make_robot(cfg)
    earlier = earlier_run(cfg, robot)
    nominal = base_dynamics(cfg, robot)
    searches = [part(node, f"search.{k}") for k, node in enumerate(cfg.search)]
    check_number("identify.validation_fraction", cfg.identify.validation_fraction, "(0, 1)")
    check_number("identify.drift", cfg.identify.get("drift", 0.0), "[0, inf)")
    stated_stiffness(cfg, robot)
    if cfg.data.torque in cfg.identify.terms:
        check_stated(make_settings(cfg, cfg.data.torque, [earlier] if earlier else []).stated, robot.n)
    if cfg.data.kind == "recording":
        files, validation = recording_files(cfg), recording_files(cfg, "validation")
        file = replace(files[0], ramps=cfg.data.ramps and str(located(cfg.data.ramps)))
        loaded = loaded_data(cfg, robot, file)
        how = cfg.identify.validation_fraction, cfg.identify.cutoff_hz
        groups = read_groups(robot, files, validation, *how)
        for group in groups:
            check_cutoff(cfg.identify.cutoff_hz, (*group.train.values(), *group.validation.values()))
            settings = make_settings(cfg, group.torque, [earlier] if earlier else [], group is groups[-1])
            check_known(robot, nominal, whole(group.train), settings)
        kinds = [group.torque for group in groups]  # commanded torque, if any, is last
        contact = contact_data(cfg, robot, replace(file, torque=kinds[-1]))
        if loaded and loaded.recording.torque not in kinds:
            raise UserError(
                f"data.loaded: expected {choices(kinds)} torque as in data.path, got {loaded.recording.torque}"
            )
        if file.ramps and "commanded" not in kinds:
            raise UserError(
                f"data.ramps: ramps determine the breakaway torques of commands, and data.path has only {kinds[-1]} "
                "torque; leave data.ramps out"
            )
        ramps = read_user_ramps(robot, file)
        paths = [path for f in (*files, *validation) for path in f.files] + ([file.ramps] if file.ramps else [])
        paths += [f for more in (contact, loaded) if more for f in more.files]
        return Parts(robot, nominal, searches, paths, None, tuple(groups), ramps, contact, loaded, earlier)
    check_data(cfg)
    check_cutoff(cfg.identify.cutoff_hz, ())
    ramp_poses(cfg, robot)
    check_source(cfg, robot)
    if not cfg.data.excitation:
        return Parts(robot, nominal, searches, [], earlier=earlier)
    motion = load(cfg.data.excitation, robot)
    return Parts(robot, nominal, searches, [cfg.data.excitation], motion, earlier=earlier)


def identify(cfg, overrides):
    """Identify the arm; write parameters.yaml, errors on training and validation motion, and figures."""
    if key := with_known_arm(cfg):
        identify_with_known_arm(cfg, overrides, key)
        return
    from r2s.identification.arm_uncertainty import Arm

    made = make_parts(cfg)
    with open_run(cfg, overrides, made.inputs) as run:
        if cfg.data.kind != "recording":
            train, validation, ramps = record_arm(cfg, made.robot, run, made.motion)
            group = Group(train.torque, {"train": train}, {"validation": validation})
            made = replace(made, groups=(group,), ramps=ramps)
        judge_recordings(cfg, run, made)
        earlier, kinds, arms = [made.earlier] if made.earlier else [], dict[str, Any](), dict[str, Arm]()
        for group in made.groups[:-1]:  # the result of each fit is a prior of the next fit
            fit = fit_group(cfg, run, made, group, earlier, run.folder / group.torque)
            space, found = fit.found.saved
            earlier.append(Earlier(str(run.folder / group.torque), group.torque, space, found.x, found.samples))
            kinds |= {group.torque: fit.summary}
            arms[group.torque] = Arm(fit.found.space, fit.found.x, fit.found.found.samples)
        fit = fit_group(cfg, run, made, made.groups[-1], earlier, run.folder)
        summary, found, nominal = fit.summary | kinds, fit.found, fit.nominal
        found.history.to_csv(run.folder / "metrics.csv", index=False)
        for row in found.history.to_dict("records"):
            run.track("metrics", row)
        run.summary(summary)
        how = {"window_s": cfg.identify.window_s, "cutoff_hz": cfg.identify.cutoff_hz}
        # import only now, after the memory peak of the fits: matplotlib and rerun need 70 MB
        from r2s.reporting.identification.page import identification_page
        from r2s.reporting.identification.tables import identification_table

        identification_page(run, nominal, found, fit.validation, summary, **how, more=fit.tables)
        identification_table(console(), made.robot, found, summary)
        arm = Arm(found.space, found.x, found.found.samples)
        if made.contact:
            run.summary(summary | {"contact": identify_surface(cfg, run, arm, made.contact)})
        if made.loaded:
            load = identify_load(cfg, run, arms.get(made.loaded.recording.torque, arm), made.loaded)
            run.summary(summary | {"payload": load})
    print(f"written: {run.folder}")


def judge_recordings(cfg, run, made):
    """Judge the training recordings: write verdict.json and print warnings; raise UserError if a verdict is fail."""
    from r2s.identification.verdict import judge
    from r2s.runs import write_json

    verdicts = {}
    for group in made.groups:
        settings = make_settings(cfg, group.torque, [made.earlier] if made.earlier else [], group is made.groups[-1])
        for label, recording in group.train.items():
            verdicts[label] = judge(made.robot, made.nominal, recording, settings)
    several = len(verdicts) > 1
    documents = {label: verdict.document() for label, verdict in verdicts.items()}
    write_json(run.folder / "verdict.json", {"recordings": documents} if several else next(iter(documents.values())))
    for label, verdict in verdicts.items():
        verdict.refuse(f"{label}: " if several else "")
        for warning in verdict.warnings:
            print(f"warning: {f'{label}: ' if several else ''}{warning}")


@dataclass(frozen=True)
class Fit:
    """Result of an identification from one kind of torque, with prediction errors and tables."""

    found: Any
    nominal: Any
    validation: Any
    summary: dict[str, Any]
    tables: dict[str, Any]


def fit_group(cfg, run, made, group, earlier, folder):
    """Identify the arm from one kind of torque; write parameters.yaml and model/ to `folder`; return the `Fit`."""
    from r2s.identification.arm_uncertainty import Arm
    from r2s.identification.identify import identify as run_identify
    from r2s.identification.parameter_file import save_parameters
    from r2s.identification.prediction import prediction_errors
    from r2s.physics.crisp import write_crisp
    from r2s.physics.description import write_description
    from r2s.progress import Progress
    from r2s.recordings.speed_noise import speed_noise

    robot, several = made.robot, len(made.groups) > 1
    train, validation = whole(group.train), whole(group.validation)
    settings = make_settings(cfg, group.torque, earlier, last=group is made.groups[-1])
    nominal = made.nominal
    for known in earlier:
        nominal = start_of(nominal, known, group.torque)
    nominal = replace(nominal, speed_noise=speed_noise([*group.train.values(), *group.validation.values()]))
    progress = Progress(f"identify, {group.torque} torque" if several else "identify")

    def report(row):
        cost = f"cost {row.get('cost', float('nan')):.4g}"
        progress(row["done"] / row["total"], f"{row['search']}, {row['evaluations']} candidates, {cost}")

    def memo(name, make):
        return run.memo(f"{group.torque} {name}" if several else name, make)

    found = run_identify(robot, nominal, train, made.searches, settings, ramps=made.ramps, report=report, memo=memo)
    progress.close()
    for line in found.at_bounds:
        print(f"warning: {line}")
    how = {"window_s": settings.window_s, "cutoff_hz": settings.cutoff_hz, "nthread": cfg.threads}
    summary = {
        side: prediction_errors(robot, nominal, found.dynamics, data, **how)
        for side, data in (("train", train), ("validation", validation))
    }
    source = {"recording": train.name, "torque": train.torque, "run": str(run.folder)}
    folder.mkdir(exist_ok=True)
    save_parameters(folder / "parameters.yaml", *found.saved, source, found.note)
    for line in write_description(folder / "model", robot, found.dynamics):
        print(line)
    if train.torque != "measured":  # a link-side sensor does not measure the friction that commands overcome
        write_crisp(folder / "model" / "crisp_friction.yaml", robot, found.dynamics)
    tables, entries = compared(made, group, found, settings, " and ".join(str(e) for e in earlier))
    arm = Arm(found.space, found.x, found.found.samples)
    for label, recording in group.loaded.items():
        data = LoadedData(recording, None, [])
        entries.setdefault("payloads", {})[label] = identify_load(cfg, run, arm, data, label)
    return Fit(found, nominal, validation, summary | entries, tables)


def compared(made, group, found, settings, known_from):
    """Return tables and summary.json entries: contribution of each recording, and drift since the run identify.from.

    known_from: names of the earlier identifications that provide `settings.known`, as text for messages.
    """
    from r2s.identification.contributions import contradictions, contributions, validated
    from r2s.identification.known import FAR, block_of, disagreement, drift_table
    from r2s.reporting.identification.several import (
        CONTRIBUTIONS,
        contribution_entry,
        contribution_table,
        drift_entry,
        drift_items,
    )
    from r2s.reporting.tables import print_table

    tables: dict[str, list[Any]] = {}
    entries: dict[str, Any] = {}
    if len(group.train) + len(group.validation) > 2 or len(made.groups) > 1:
        parts = contributions(found, group.train, settings.cutoff_hz)
        lines, names = contradictions(parts), found.space.names
        for line in lines:
            print(f"warning: {line}")
        held = {f"{k}, held out" if k in group.train else k: r for k, r in group.validation.items()}
        parts += validated(found, held, settings.cutoff_hz)
        table = contribution_table(parts, names)
        tables["Recordings"] = [CONTRIBUTIONS, table, *(f"{line[0].upper()}{line[1:]}." for line in lines)]
        print_table(console(), table, f"recordings of {group.torque} torque")
        entries["recordings"] = contribution_entry(parts, names)
    if settings.known is not None:
        off, name = disagreement(settings.known, found.space, found.x)
        if off > FAR:
            line = (
                f"{group.torque} torque disagrees with {known_from} by {off:.2g} standard deviations, most in {name}"
            )
            print(f"warning: {line}: another tool or payload, or a model that does not fit one of them?")
            tables.setdefault("Recordings", []).append(f"{line[0].upper()}{line[1:]}.")
    if made.earlier is not None and made.earlier.torque == group.torque:
        since = made.earlier.run
        known = settings.known.where(lambda name: block_of(name) not in settings.stated)
        drift = drift_table(known, found.space, found.x, found.found.samples)
        words, table = drift_items(drift, since)
        tables[f"Drift since {since}"] = [words, table]
        print_table(console(), table, f"drift since {since}, 95 % intervals")
        entries["drift"] = drift_entry(drift, since)
    return tables, entries
