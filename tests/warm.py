"""Import this in a process that commands are forked off: what each of them would do again is then done."""

import contextlib
import gc
import io
import logging
import threading
import warnings

import torch
from hydra import compose, initialize_config_dir
from matplotlib.figure import Figure
from tqdm import tqdm

from r2s.cli import CONF
from r2s.physics import mujoco_callback as native_friction

native_friction.install()
with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
    compose("config")
logging.getLogger("torch.onnx").setLevel(logging.ERROR)
tqdm.monitor_interval = 0  # its thread might hold a lock when a command is forked off;
tqdm.set_lock(threading.RLock())  # its own lock would leave a process of the server behind
with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
    warnings.simplefilter("ignore")
    torch.onnx.export(torch.nn.Linear(1, 1), (torch.zeros(2, 1),), verbose=False)  # it finds its operators: 2 s
figure = Figure()
figure.subplots().set_title("fonts")
figure.savefig(io.BytesIO())
gc.collect()
gc.freeze()  # what is there is neither looked through nor copied by every command
