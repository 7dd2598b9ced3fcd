"""A sweep on a cluster of three nodes, one of which is killed: every job is done, and none twice."""

import json
import os
import subprocess
import sys
import time

import pandas as pd
import psutil
import pytest
from conftest import ROOT

GRID = ["-m", "+experiment=[paper_grid,toy]", "compile=false", "hydra/launcher=ray", 'grid.algo="ddpg,td3"']
GRID += ['grid.lr="1e-3"', 'grid.batch_size="16"', 'grid.gamma="0.9"', 'grid.seed="0,1,2"', "budget.env_steps=4000"]
JOBS = 6


@pytest.fixture
def cluster():
    """A head without processors and three nodes of one each; the last is the one to lose."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)
        patch.setenv("OMP_NUM_THREADS", "1")
        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        nodes = [made.add_node(num_cpus=1) for _ in range(3)]
        yield made, nodes
        made.shutdown()


def raylet_of(process):
    """Return the id of the node's process that a worker belongs to, or None."""
    return next((p.pid for p in process.parents() if "raylet" in p.name()), None)


@pytest.mark.slow
def test_a_sweep_outlives_a_node(cluster, tmp_path):
    """Six jobs; a node is killed while it works on one: the sweep ends well, with six folders and one table."""
    made, nodes = cluster
    words = [*GRID, f"hydra.launcher.address={made.address}", f"root={tmp_path}"]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    sweep = subprocess.Popen([sys.executable, "run.py", *words], cwd=ROOT, env=env, stderr=subprocess.PIPE, text=True)
    victim = None
    while victim is None:
        assert sweep.poll() is None, sweep.stderr.read()
        time.sleep(0.2)
        for path in (tmp_path / "train").glob("*/checkpoints/state.pt"):
            meta = json.loads((path.parents[1] / "meta.json").read_text())
            if meta["status"] == "running":
                victim = path.parents[1], meta["process"]["pid"]
    folder, worker = victim
    lost = raylet_of(psutil.Process(worker))
    node = next(n for n in nodes if lost in {i.process.pid for i in n.all_processes["raylet"]})
    made.remove_node(node, allow_graceful=False)
    _, said = sweep.communicate(timeout=1500)
    assert sweep.returncode == 0, said
    folders = sorted((tmp_path / "train").iterdir())
    assert [f.name for f in folders] == [
        f"grid_{algo}_lr0.001_batch16_gamma0.9_seed{seed}" for algo in ("ddpg", "td3") for seed in range(3)
    ]
    metas = {f: json.loads((f / "meta.json").read_text()) for f in folders}
    assert {m["status"] for m in metas.values()} == {"done"}
    assert metas[folder]["process"]["pid"] != worker, "the job that was lost was done by another worker"
    for f in folders:  # what was done before the node died was not done again
        steps = pd.read_csv(f / "evaluations.csv")["env_steps"].tolist()
        assert steps == [2000, 4000, 4000]
    words = ["stage=compare", f"runs={tmp_path}/train/*", f"root={tmp_path}", "name=table"]
    done = subprocess.run([sys.executable, "run.py", *words], cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(pd.read_csv(tmp_path / "compare" / "table" / "last.csv")) == JOBS


@pytest.mark.long
def test_ray_is_one_line_where_it_is_not(tmp_path):
    """Without ray, or without a cluster at the address."""
    code = "import sys; sys.modules['ray'] = None; import runpy; runpy.run_path('run.py', run_name='__main__')"
    words = ["-m", "+experiment=toy", "hydra/launcher=ray", "seed=0,1", f"root={tmp_path}"]
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2
    assert (
        done.stderr.strip()
        == "error: hydra/launcher=ray needs ray, which is not installed: pip install 'r2s[sweeps]'"
    )
