"""stage=train: train one policy in simulation, evaluate it, save it as policy.pt and policy.onnx."""

from r2s.stages.build import (
    console,
    device,
    learner,
    make_draw,
    make_dynamics,
    make_robot,
    make_task,
    open_run,
    oracle,
    plain,
    set_threads,
)

# what conf/algo says of the loop rather than of the learner
LOOP = ("batch_size", "learning_starts", "updates_per_step", "replay_size", "lr_decay", "lr_end")


def train(cfg, overrides):
    """Train one policy in simulation, evaluate it, save it as policy.pt and policy.onnx."""
    import copy
    from functools import partial

    import torch

    from r2s.learning.checkpoint import Checkpoint
    from r2s.learning.env import TaskEnv
    from r2s.learning.evaluate import make_evaluation, selection_score
    from r2s.learning.policy import export_onnx, load_policy, save_policy
    from r2s.learning.train import Budget, Listeners, Loop
    from r2s.learning.train import train as run_train
    from r2s.progress import Progress
    from r2s.reporting import pages
    from r2s.reporting.tables import reach_table
    from r2s.tasks.rewards import curriculum

    if cfg.algo.name == "oracle":
        return reference(cfg, overrides)
    budget = Budget(cfg.budget.minutes, cfg.budget.env_steps)
    robot, task, settings = make_robot(cfg), make_task(cfg), plain(cfg.algo)
    center = make_dynamics(cfg, robot)
    draw = make_draw(cfg, robot, center)
    set_threads(cfg)
    loop = Loop(
        **{k: settings.pop(k) for k in LOOP},
        eval_env_steps=cfg.evaluation.env_steps,
        compile=cfg.compile,
        matmul=cfg.matmul,
    )
    n_envs, name = settings.pop("n_envs"), settings.pop("name")
    env = TaskEnv(robot, task, draw, n_envs, nthread=cfg.threads, seed=cfg.seed, stagger=True)
    evaluate = make_evaluation(robot, task, draw, episodes=cfg.evaluation.episodes, nthread=cfg.threads)
    torque = torch.from_numpy(task.torque(robot))
    mean, std = (torch.from_numpy(s) for s in task.observation_scale(robot))
    algo = learner(name)((mean, std), torque, **settings).to(device(cfg))
    weights = partial(curriculum, **plain(cfg.reward))
    best: dict = {}
    last: dict = {}

    def is_best(row):
        nonlocal best, last
        last = row
        better = not best or selection_score(row) >= selection_score(best)
        best = row if better else best
        return better

    with open_run(cfg, overrides, parents=[cfg.calibration] if cfg.calibration else []) as run:
        progress = Progress(f"train {name}")
        checkpoint = Checkpoint(run.folder / "checkpoints")
        if cfg.resume:
            run.rewind("metrics", "env_steps", checkpoint.env_steps)
            for row in run.rewind("evaluations", "env_steps", checkpoint.env_steps):
                is_best(row)

        def evaluated(row):
            run.log("evaluations", row)
            if is_best(row):
                save_policy(run.folder, copy.deepcopy(algo.policy).cpu())

        def show(share, row):
            text = f"{row['env_steps'] / 1e3:.0f}k env steps, {row['updates']} updates"
            if "success_1cm" in row:
                text += f", {100 * row['success_1cm']:.0f} % < 1 cm, return {row['return_paper']:.0f}"
            progress(share, text)

        run_train(
            env,
            algo,
            evaluate,
            weights,
            loop,
            budget,
            checkpoint=checkpoint,
            dump=run.folder / "dump.pt",
            listeners=Listeners(lambda row: run.log("metrics", row), evaluated, show),
        )
        progress.close()
        checkpoint.clear()
        export_onnx(run.folder / "policy.onnx", load_policy(run.folder, robot, task), robot, task)
        run.summary({"best": best, "last": last})
        pages.training(run, robot)
        reach_table(console(), {"best": best, "last": last}, f"{name} in MuJoCo, dr: {plain(cfg.dr)}")
    print(f"written: {run.folder}")


def reference(cfg, overrides):
    """Evaluate the model-based controller, which is not trained, as a training is evaluated."""
    from r2s.learning.evaluate import make_evaluation
    from r2s.reporting import pages
    from r2s.reporting.tables import reach_table

    robot, task = make_robot(cfg), make_task(cfg)
    draw = make_draw(cfg, robot, make_dynamics(cfg, robot))
    with open_run(cfg, overrides, parents=[cfg.calibration] if cfg.calibration else []) as run:
        evaluate = make_evaluation(robot, task, draw, episodes=cfg.evaluation.episodes, nthread=cfg.threads)
        done = evaluate(oracle(cfg, robot, task))
        row = {"env_steps": 0, "updates": 0, "wall_clock_s": 0.0} | task.measures(done)
        run.log("evaluations", row)
        run.summary({"best": row, "last": row})
        pages.transfer(run, robot, {"oracle": done}, {"oracle": row}, task.torque(robot))
        reach_table(console(), {"oracle": row}, f"oracle in MuJoCo, dr: {plain(cfg.dr)}")
    print(f"written: {run.folder}")
