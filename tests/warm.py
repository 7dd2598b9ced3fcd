"""Import this in a process that commands are forked off: what each of them would do again is then done."""

import gc

from hydra import compose, initialize_config_dir

from r2s.cli import CONF
from r2s.physics import native_friction

native_friction.install()
with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
    compose("config")
gc.collect()
gc.freeze()  # what is there is neither looked through nor copied by every command
