"""Mistakes on the command line: one line on stderr, exit status 2, and no run folder."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from cli_runs import one_line, r2s, recording  # noqa: F401

from r2s.override_checks import check_overrides, quoted

MISTAKES = {
    "stage=identify arm.payload=4": r"arm.payload: expected a number in \[0, 3\], got 4",
    "stage=estimate arm.friction_scale=warm": r"arm.friction_scale: expected a number, got 'warm'",
    "stage=estimate arm.friction_scale=nan": r"arm.friction_scale: expected a number in \[0.1, 3\], got nan",
    "stage=estimate arm.extra_delay_s=5": r"arm.extra_delay_s: expected a number in \[0, 0.02\], got 5",
    "stage=estimate arm.payload=4": r"arm.payload: expected a number in \[0, 3\], got 4",
    "stage=excite excite.seconds=700": r"excite.seconds: expected a number in \[2, 600\], got 700",
    "stage=excite excite.parameters=[ofset]": r"excite.parameters: 'ofset' is not estimated.*did you mean 'offset'",
    "stage=excite excite.obstacles=[{center:[0.4,0,0.3],size:[0.2,0.2,0.6]}]": r"obstacle 1 is .* at robot.q_home",
    "algo=tqq": r"algo: no option 'tqq'.*tqc",
    "algo.gama=0.9": r"unknown option 'algo.gama'; did you mean 'algo.gamma'",
    "+typo=1": r"unknown option 'typo'",
    "algo.lr=abc": r"algo.lr: expected a number, got 'abc'",
    "stage=identify data=recording data.torque=measured": r"data.path must be given",
    "nonsense": r"'nonsense' is not KEY=VALUE",
    "-m seed=0,1 dr=papr": r"dr: no option 'papr'.*did you mean 'paper'",
    "stage=identify data=recording data.path=nowhere.npz data.torque=measured": r"nowhere.npz",
    "stage=identify data=recording data.path=LOG": r"torque is not declared.*data.torque=measured",
    "stage=identify data=recording data.path=LOG data.torque=mesured": r"mesured.*did you mean 'measured'",
    "stage=identify data=recording data.path=LOG data.torque=measured data.columns.q=qq": r"qq",
    "stage=identify data=recording data.path=NAN data.torque=commanded": r"q: expected finite values, got nan at row",
    "stage=identify data=recording data.path=BACK data.torque=commanded": r"time does not increase at row",
    "stage=identify data=recording data.path=SIX data.torque=commanded": r"6.*7|7.*6",
    "stage=identify data=recording data.path=LOG data.torque=commanded data.validation=LOG": r"training file itself",
    "stage=identify data=recording data.path=LOG data.torque=commanded data.validation=COPY": r"rows of the training",
    "stage=identify data=recording data.path=STILL data.torque=commanded": r"the recording: expected at least 1 s",
    "stage=identify data=recording data.path=DEGREES data.torque=commanded": r"joint \d is at .*allows .*degrees",
    "stage=identify data=recording data.path=MILLI data.torque=commanded": r"1000 times what panda needs.*mNm",
    "stage=identify data=recording data.path=LOG data.torque=commanded data.validation=AGAIN": r"motion repeats",
    "stage=identify data=recording data.path=LOG data.torque=commanded data.ramps=LOG": r"no column 'joint'",
    "stage=identify friction.family=strbeck": r"got 'strbeck'.*did you mean 'stribeck'",
    "stage=identify identify.terms.commanded=[ofset]": r"unknown term 'ofset'.*did you mean 'offset'",
    "stage=identify data.excitation=nowhere.csv": r"nowhere.csv",
    "stage=identify data=recording data.path=LOG data.torque=commanded data.ramps=nowhere.npz": r"no file nowhere",
    "dr=identified": r"give calibration=RUN_FOLDER",
    "task=track robot.torque_fraction=null": r"robot.torque_fraction: expected a number in \[1e-6, 1\], got None",
    "robot.torque_fraction=[0.3,nan]": r"robot.torque_fraction: expected a number in \[1e-6, 1\], got nan",
    "robot.torque_fraction=[0.1,0.2]": r"expected 7 values, .* got 2; its default is robot.torque_fraction",
    "stage=pipeline pipeline.train_minutes=0": r"pipeline.train_minutes: expected a number in \(0, inf\), got 0",
    "stage=pipeline +experiment=toy algo.tau=nan": r"algo.tau: expected a number in \(0, 1\], got nan",
    "+experiment=paper_grid": r"this is a grid of jobs, and only -m runs it: .* -m \+experiment=paper_grid",
    "+experiment=[tune,toy] algo.tau=nan": r"algo.tau: expected a number in \(0, 1\], got nan",
    "+experiment=[tune,toy] algo.lr=1e-3": r"algo.lr: tune.space searches it; leave it out, or give tune.space=",
    "+experiment=[tune,toy] tune.space={algo:[td3,td5]}": r"tune.space: Could not find 'algo/td5'",
    "+experiment=[tune,toy] tune.space={algo:[td3]} tune.measure=stops": r"no measure 'stops'; allowed: limited",
    "+experiment=[tune,toy] tune.space={algo:[td3]} tune.against=GRID": r"tune.against: expected finished",
    "+experiment=toy budget.env_steps=800": r"budget.env_steps: expected more than 800, .* algo.n_envs=8, got 800",
    "lst": r"'lst' is not KEY=VALUE; did you mean 'list'",
    "resume=nowhere": r"'nowhere' is no run folder",
    "robot.mjcf=nowhere.xml": r"nowhere.xml",
    "robot.ee=end_efector": r"robot.ee: expected one of .*, got 'end_efector'; did you mean 'end_effector'",
    "stage=identify data=kinova_gen3 robot=panda": r"joint 4 is at .* panda allows",
    "calibration=nowhere": r"calibration: no parameters.yaml",
    "stage=transfer policy=nowhere": r"policy: 'nowhere'",
    "stage=compare runs=nowhere/*": r"no folder matches 'nowhere/\*'",
    "budget.minutes=null": r"budget",
    "budget.minutes=-1": r"budget.minutes: expected a number in \(0, inf\), got -1",
    "algo.lr_decay=2": r"algo.lr_decay: expected .*, got 2",
    "algo.batch_size=0": r"algo.batch_size: expected .*, got 0",
    "algo.n_envs=0": r"algo.n_envs: expected .*, got 0",
    "evaluation.episodes=0": r"evaluation.episodes: expected a whole number in \[1, inf\), got 0",
    "task.ctrl_hz=60": r"task.ctrl_hz: 60 is not allowed; what divides 1000 is",
    "seed=-1": r"seed: expected .*, got -1",
    "seed=9223372036854775808": r"seed: expected .*, 4294967295\], got 9223372036854775808",
    "device=tpu": r"device: expected cpu or cuda, got 'tpu'",
    "matmul=low": r"matmul: expected auto, medium, high or highest, got 'low'",
    "friction.phi1=[1,2]": r"friction.phi1: expected 7 values, for the 7 joints of panda, got 2",
    "friction.phi1=abc": r"friction.phi1: expected a number, got 'abc'",
    "friction.phi1=true": r"friction.phi1: expected a number, or one for each of the 7 joints of panda, got True",
    "task.episode_s=1e308": r"task.episode_s: expected a number in \[0.02, 600\], got 1e\+308",
    "algo.lr=2.0": r"algo.lr: expected a number in \(0, 1\], got 2.0",
    "algo.hidden=abc": r"algo.hidden: expected a number, got 'abc'",
    "dr.phi_relative=1.5": r"dr.phi_relative: expected .*, got 1.5",
    "reward.anneal=[a,b]": r"reward.anneal: expected a number, got 'a'",
    "reward.max_filter_rate=0": r"reward.max_filter_rate: expected a number in \(0, 1\], got 0",
    "evaluation.env_steps=ten": r"evaluation.env_steps: expected a whole number in \[1, inf\), got 'ten'",
    "budget.minutes=four": r"budget.minutes: expected a number, got 'four'",
    "stage=identify identify.window_s=-1": r"identify.window_s: expected .*, got -1",
    "stage=identify identify.folds=few": r"identify.folds: expected a number, got 'few'",
    "stage=identify identify.bounds.phi1=[2,1]": r"identify.bounds.phi1: \[2, 1\] is not \[low, high\]",
    "stage=identify data.seconds=1": r"data.seconds: expected a number in \[2, 120\], got 1",
    "--config-dir cnf algo=cooling": r"--config-dir: no folder 'cnf'; did you mean 'conf'",
    "stage=identify arm=panda_emulated arm.realtime=ture": r"arm.realtime: expected true or false, got 'ture'",
    "compile=1": r"compile: expected true or false, got 1",
    "stage=identify data.seconds=long": r"data.seconds: expected a number, got 'long'",
    "stage=identify data=simulated data.truth=papr": r"data.truth: no 'papr'.*did you mean 'paper'",
    "stage=identify search.0.ftol=small": r"search.0.ftol: expected a number, got 'small'",
    "stage=identify dr=none": r"dr: stage=identify does not read it",
    "stage=identify data=simulated arm.seed=1": r"arm.seed: stage=identify does not read it: only data=arm moves",
    "stage=transfer robot=fr3": r"robot: stage=transfer does not read it: it comes from the policy's run; leave it",
    "stage=transfer task.ctrl_hz=20": r"task.ctrl_hz: stage=transfer does not read it",
    "stage=transfer control=torque": r"control: stage=transfer does not read it: it comes from the policy's run",
    "stage=compare friction=paper": r"friction: stage=compare does not read it: it reads robot, runs; leave it out",
    "arm.seed=3": r"arm.seed: stage=train does not read it: a training uses no arm",
    "calibration=RUN friction=uniform": r"friction: stage=train does not read it: the friction comes from",
    "algo=oracle budget.minutes=3": r"budget.minutes: stage=train does not read it: nothing is trained",
    "-m algo=tqc seed=0,1 policy=x": r"policy: stage=train does not read it",
    "stage=pipeline calibration=RUN": r"calibration: stage=pipeline does not read it: it identifies the arm itself",
    "stage=pipeline budget.minutes=1": r"budget.minutes: stage=pipeline .*pipeline.train_minutes",
    "stage=pipeline dr=identified": r"dr: the nominal training of stage=pipeline has no calibration",
    "algo._target_=nowhere.Mine": r"algo._target_: cannot load 'nowhere.Mine'.*No module named 'nowhere'",
    "+algo.speed=1": r"unknown option 'algo.speed'",
    "-m seed=0,1 hydra/launcher=jobib": r"hydra/launcher: no option 'jobib'.*did you mean 'joblib'",
    "-m seed=0,1 hydra/launher=joblib": r"unknown option 'hydra/launher'; did you mean 'hydra/launcher'",
    "-m seed=0,1 hydra/launcher=joblib hydra.launcher.n_job=2": r"launcher.n_job'.*mean 'hydra.launcher.n_jobs'",
    "-m seed=0,1 hydra.sweep.dir=elsewhere": r"hydra.sweep.dir: a run folder is ROOT/STAGE/NAME; give root= and",
    "hydra.run.dir=elsewhere": r"hydra.run.dir: a run folder is ROOT/STAGE/NAME",
    "-m seed=0,1 hydra/sweeper=optuna": r"hydra/sweeper=optuna: r2s searches by \+experiment=tune",
    "-m +experiment=paper_grid hydra.launcher.n_job=2": r"launcher.n_job'.*mean 'hydra.launcher.n_jobs'",
    "seed=0,1": r"seed=0,1: several values make a sweep, which only -m runs; 'seed=\"0,1\"' is one value$",
    "data.path=a=b.csv": r"""data.path: a value with = needs quotes: 'data.path="a=b.csv"'$""",
    "data.path=a#b.csv": r"""data.path: a value with # needs quotes: 'data.path="a#b.csv"'$""",
    "data.path=a(b.csv": r"""data.path: a value with \( needs quotes: 'data.path="a\(b.csv"'$""",
    "data.path=a[b.csv": r"""data.path: a value with \[ needs quotes: 'data.path="a\[b.csv"'$""",
    "stage=watch": r"stage=watch is now stage=estimate$",
    "stage=estimate watch.every_s=2": r"watch.every_s is now estimate.every_s$",
    "arm.make=2 stage=identify": r"arm.make=2 is now arm.variant=elastic$",
    "-m arm.make=1,2 stage=identify": r"arm.make=1 is now arm.variant=rigid$",
    "stage=identify arm.friction=1.1": r"arm.friction is now arm.friction_scale$",
    "stage=identify arm.late=0.01": r"arm.late is now arm.extra_delay_s$",
    "stage=identify arm.load=0.5": r"arm.load is now arm.declared_payload$",
    "stage=identify friction.hold=net": r"friction.hold is now friction.stiction_model$",
    "stage=identify identify.extra.motor=[]": r"identify.extra.motor is now identify.candidate_terms.motor$",
    "stage=identify identify.spare.measured=[]": r"identify.spare.measured is now identify.prunable_terms.measured$",
    "-m seed=0,1 only_missing=true name=a": r"only_missing is now skip_completed$",
    "reward.limited=[0,0]": r"reward.limited is now reward.filter_penalty$",
    "+reward.limited_most=0.1": r"reward.limited_most is now reward.max_filter_rate$",
    "task=track task.base=none": r"task.base=none is now control=torque$",
    "task=track task.base=model": r"task.base=model is now control=computed_torque$",
    "task=track task.residual=0.2": r"task.residual is now control.residual, with control=computed_torque$",
    "task.bandwidth=3": r"task.bandwidth is now control.bandwidth, with control=computed_torque$",
}


@pytest.mark.long
def test_options_of_the_launcher_that_an_experiment_chose():
    """They are known, and what the lines above say to type is taken."""
    check_overrides(["+experiment=paper_grid", "hydra.launcher.n_jobs=2"], None, multirun=True)
    for character in ",=#([":
        check_overrides([shlex.split(quoted(f"name=a{character}b"))[0]], None)


@pytest.fixture(scope="module")
def logs(recording, tmp_path_factory) -> dict[str, Path]:  # noqa: F811
    """The recording and damaged versions of it: {placeholder in MISTAKES: path}."""
    folder, text = tmp_path_factory.mktemp("logs"), recording.read_text()
    rows = text.splitlines()
    six = [
        ",".join(v for k, v in zip(rows[0].split(","), r.split(","), strict=True) if not k.endswith("7"))
        for r in rows
    ]
    broken = {
        "NAN": [*rows[:500], rows[500].replace(rows[500].split(",")[1], "nan", 1), *rows[501:]],
        "BACK": [*rows[:500], rows[400], *rows[500:]],
        "SIX": six,
        "COPY": rows[:1500],
    }
    values = np.loadtxt(recording, delimiter=",", skiprows=1)
    t, q, dq, torques = values[:, :1], values[:, 1:8], values[:, 8:15], values[:, 15:]
    noise = np.random.default_rng(0).standard_normal(values.shape)
    tables = {
        "STILL": np.column_stack([t, q[0] + 1e-3 * (q - q[0]), dq, torques]),
        "DEGREES": np.column_stack([t, np.degrees(q), dq, torques]),
        "MILLI": np.column_stack([t, q, dq, 1e3 * torques]),
        "AGAIN": values + noise * ([0] + [1e-4] * 7 + [1e-3] * 7 + [0.05] * 14),
    }
    paths = {name: folder / f"{name.lower()}.csv" for name in (*broken, *tables)}
    for name, lines in broken.items():
        paths[name].write_text("\n".join(lines))
    for name, table in tables.items():
        np.savetxt(paths[name], table, delimiter=",", header=rows[0], comments="")
    return {"LOG": recording, "GRID": folder} | paths


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_gets_one_line(mistake, logs, tmp_path):
    """One line on stderr, exit status 2, and no run folder."""
    if "tune" in mistake:
        pytest.importorskip("optuna")
    command = re.sub("|".join(logs), lambda found: str(logs[found[0]]), mistake)
    done = r2s(*command.split(), f"root={tmp_path / 'runs'}")
    one_line(done, MISTAKES[mistake])
    assert not (tmp_path / "runs").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_gets_one_line(tmp_path):
    done = r2s("device=cuda", f"root={tmp_path}")
    assert done.returncode == 2
    assert done.stderr.strip() == "error: device: torch finds no GPU for device=cuda; device=cpu works"
