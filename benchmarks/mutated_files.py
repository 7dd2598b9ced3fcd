"""Files of run folders that are damaged or hold nonsense, read as what comes after them reads them."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from common import NEW, ROBOT, conf
from hypothesis import strategies as st
from mutated import COUNTS, damaged, drawn, judged


def leaves(node, path=()) -> list[tuple]:
    """Return the paths to the leaves of nested dicts and lists."""
    if isinstance(node, dict):
        return [p for k, v in node.items() for p in leaves(v, (*path, k))]
    if isinstance(node, list):
        return [p for k, v in enumerate(node) for p in leaves(v, (*path, k))]
    return [path]


def replaced(draw, document, names: list[str]) -> str:
    """Change one leaf of nested dicts and lists in place, or take it away; return what was done."""
    path = draw(st.sampled_from([p for p in leaves(document) if p and (not names or str(p[0]) in names)]))
    depth = draw(st.integers(1, len(path)))
    node = document
    for key in path[: depth - 1]:
        node = node[key]
    key, where = path[depth - 1], ".".join(map(str, path[:depth]))
    if draw(st.booleans()) and isinstance(node, dict):
        del node[key]
        return f"no {where}"
    value = draw(st.sampled_from([math.nan, math.inf, -1.0, -1e9, 1e30, "word", "", None, [], {}, [1.0, 2.0], True]))
    node[key] = value
    return f"{where} is {value!r}"


def plausible(d) -> str:
    """Return why dynamics cannot be an arm's; "" where they can."""
    fields = (
        "phi",
        "offset",
        "breakaway",
        "mass",
        "com",
        "inertia",
        "armature",
        "load",
        "drag",
        "gain",
        "delay",
        "lag",
    )
    for name in fields:
        if not np.isfinite(getattr(d, name)).all():
            return f"{name} is not finite"
    if (d.mass <= 0).any() or (np.linalg.eigvalsh(d.inertia) <= 0).any():
        return "a link that no body can be"
    if (d.phi[..., :2] < 0).any() or (d.armature < 0).any() or (d.load < 0).any():
        return "friction or rotors that give energy"
    if not (0 <= d.delay <= 1 and 0 <= d.lag <= 1 and d.dq_min >= 0):
        return "a delay, a lag or a speed that is none"
    if (np.abs(d.phi) > 1e6).any() or (np.abs(d.offset) > 1e4).any() or (np.abs(d.gain) >= 1).any():
        return "friction, an offset or a gain beyond any arm"
    return ""


def mutate_files(at: Path, err: Path) -> list[dict]:
    """Read files of run folders that are damaged or hold nonsense."""
    import torch

    from r2s.identification.parameter_file import save_parameters
    from r2s.identification.parameters import Estimate, parameter_space
    from r2s.learning.policy import make_policy, save_policy
    from r2s.tasks.reach import ReachTask

    whole, rows = at / "whole", []
    whole.mkdir()
    task = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
    bounds = conf("config")["identify"]["bounds"]
    space = parameter_space(ROBOT, NEW, {k: bounds[k] for k in ("phi1", "phi2", "phi3", "offset", "delay")})
    x = space.start
    found = Estimate(x, x - 0.01, x + 0.01, np.ones(len(x), bool), np.tile(x, (20, 1)))
    save_parameters(whole / "parameters.yaml", space, found, {"recording": "made here"})
    save_policy(whole, make_policy(ROBOT, task, (16, 16)))
    row = {"env_steps": 960, "updates": 100, "wall_clock_s": 1.5, "success_1cm": 0.5, "return_paper": -80.5}
    pd.DataFrame([row | {"env_steps": k} for k in (320, 640, 960)]).to_csv(whole / "evaluations.csv", index=False)
    (whole / "summary.json").write_text(json.dumps({"best": row, "last": row}))
    (whole / "meta.json").write_text(json.dumps({"status": "done", "stage": "train", "inputs": {}}))
    (whole / "overrides.yaml").write_text('- "seed=1"\n')
    np.savez(whole / "memo.npz", x=np.arange(100.0), y=np.arange(5))
    torch.save({"seen": 8, "chunks": ["a.pt"]}, whole / "state.pt")
    composed(whole / "config.yaml", err)
    names = sorted(p.name for p in whole.iterdir())
    own = {"parameters.yaml": ["robot", "joints", "friction_family", "parameters", "fixed"]}
    own["config.yaml"] = ["stage", "seed", "robot", "task", "dr", "friction", "inertia", "algo"]

    def one(draw):
        name = draw(st.sampled_from(names))
        folder = at / "changed"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(whole, folder)
        path = folder / name
        if path.suffix in (".yaml", ".json") and draw(st.integers(0, 3)):
            document = yaml.safe_load(path.read_text())
            what = replaced(draw, document, own.get(name, []))
            text = yaml.safe_dump(document, sort_keys=False) if path.suffix == ".yaml" else json.dumps(document)
            path.write_text(text)
        else:
            content, what = damaged(draw, path.read_bytes())
            path.write_bytes(content)
        end, said = judged(lambda: READ[name](folder, task))
        rows.append({"kind": "files", "what": f"{name}: {what}", "end": end, "said": said})

    drawn("files", one, COUNTS["files"])
    return rows


def composed(path: Path, err: Path) -> None:
    """Write the config of a training."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from r2s.stages.build import CONF

    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        path.write_text(OmegaConf.to_yaml(compose("config", ["+experiment=toy"])))


def _parameters(folder: Path, task) -> str:
    from r2s.identification.parameter_file import load_parameters, load_posterior

    space, x = load_parameters(folder, ROBOT)
    samples = load_posterior(folder, space)
    if not np.isfinite(samples).all():
        return "draws that are not finite"
    return plausible(space.dynamics(x))


def _config(folder: Path, task) -> str:
    """Make what stage=transfer makes of the config of a training."""
    from omegaconf import OmegaConf

    from r2s.stages import build
    from r2s.stages.transfer import trained_config

    said: list[str] = []

    def work(cfg) -> None:
        cfg.policy = str(folder)
        _, trained = trained_config(cfg)
        robot = build.make_robot(trained)
        dynamics = build.make_dynamics(trained, robot)
        build.make_task(trained, robot, dynamics)
        build.make_draw(trained, robot, dynamics)
        said.append(plausible(dynamics))

    from r2s.cli import said_in_one_line

    with said_in_one_line():
        work(OmegaConf.create({"policy": None}))
    return said[0]


def _policy(folder: Path, task) -> str:
    import torch

    from r2s.learning.policy import load_policy

    policy = load_policy(folder, ROBOT, task)
    seen = torch.zeros(1, len(policy.normalizer.mean))
    return "" if torch.isfinite(policy(seen)).all() else "a policy whose torque is not finite"


def _trainings(folder: Path, task) -> str:
    from r2s.reporting.trainings import read_trainings

    (trained,), _ = read_trainings([folder])
    return "" if math.isfinite(trained.last["return_paper"]) else "a return that is not finite"


def _meta(folder: Path, task) -> str:
    from r2s.runs import is_done

    is_done(folder)
    return ""


def _overrides(folder: Path, task) -> str:
    from omegaconf import OmegaConf

    from r2s.cli import typed_in

    words = typed_in(folder)
    return "" if all(isinstance(w, str) for w in OmegaConf.to_container(OmegaConf.create(words))) else "no words"


def _summary(folder: Path, task) -> str:
    from r2s.runs import read_summary

    return "" if isinstance(read_summary(folder, "policy"), dict) else "no summary"


def _memo(folder: Path, task) -> str:
    from r2s.runs import load_arrays

    return "" if load_arrays(folder / "memo.npz") else "no arrays"


def _state(folder: Path, task) -> str:
    from r2s.learning.checkpoint import load_tensors

    load_tensors(folder / "state.pt", "resume")
    return ""


READ = {
    "parameters.yaml": _parameters,
    "posterior.npz": _parameters,
    "config.yaml": _config,
    "policy.pt": _policy,
    "evaluations.csv": _trainings,
    "meta.json": _meta,
    "overrides.yaml": _overrides,
    "summary.json": _summary,
    "memo.npz": _memo,
    "state.pt": _state,
}
