"""What is compiled is compiled before the clock of a training starts."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

# In a process with caches of its own: nothing is compiled yet there.
SCRIPT = """
import json, sys
from dataclasses import replace
from pathlib import Path
from numba.core import event
from ebarf_ns.nerf.method import ebarf

compiled = []

class Listener(event.Listener):
    def on_start(self, found):
        compiled.append(found.data["dispatcher"].py_func.__module__)

    def on_end(self, found):
        pass

event.register("numba:compile", Listener())
config = ebarf.config
config.data = config.pipeline.datamanager.data = Path(sys.argv[1])
config.output_dir, config.timestamp, config.vis, config.max_num_iterations = Path(sys.argv[2]), "run", "tensorboard", 20
config.save_config()
trainer = config.setup()
trainer.setup()
charged = trainer.train_seconds
before = [name for name in compiled if name.startswith("ebarf_ns")]
compiled.clear()
trainer._begin_metrics()
trainer.stop_training = False
for step in range(3):
    trainer.step = step
    trainer.pipeline.train()
    trainer.train_iteration(step)
in_training = [name for name in compiled if name.startswith("ebarf_ns")]
print(json.dumps([before, in_training, charged, trainer.compile_seconds]))
"""


@pytest.mark.slow
def test_no_step_of_a_training_compiles_anything(tiny_scene: Path, tmp_path: Path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    words = (sys.executable, "-c", SCRIPT, tiny_scene, tmp_path / "outputs")
    finished = subprocess.run(
        words, capture_output=True, text=True, timeout=600, check=False, cwd=REPOSITORY, env=environment
    )
    assert finished.returncode == 0, finished.stderr[-2000:]
    before, in_training, charged, compile_seconds = json.loads(finished.stdout.splitlines()[-1])
    assert {"ebarf_ns.radiance.hash_grid_numba", "ebarf_ns.radiance.ray_sampling_numba"} <= set(before)
    assert in_training == []
    assert charged == 0 and compile_seconds > 0
