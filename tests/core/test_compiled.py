"""Where machine code is kept: that of kernels that outside types have reached, that of users."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hiersched.core.compiled import CACHE_FOLDER

CALL = """
from typing import NamedTuple
import numpy as np
from hiersched.models.plant.feedback import entry_in_force

class {name}(NamedTuple):
    max_delay_steps: int
    hold_samples: int

assert entry_in_force({name}(3, 0), 5, np.zeros(2, np.int64)) == 3
print(sum(entry_in_force.stats.cache_hits.values()))
"""
OURS = """
import numpy as np
from hiersched.models.plant.command_link import NO_LINK
from hiersched.models.plant.estimator import no_filter
from hiersched.models.plant.feedback import LoopConstants, entry_in_force

rows = [np.zeros((2, 1, 1))] * 2
tables = *rows, np.zeros((2, 1, 1, 1))
steps = np.zeros(2, np.uint32)
rest = steps, no_filter(1), NO_LINK
kind = np.zeros(1, np.int64)
loop = LoopConstants(0.1, 0.0, 1, kind, *tables, False, 0, 0, False, False, *rest)
assert entry_in_force(loop, 5, np.zeros(2, np.int64)) == 1
print(sum(entry_in_force.stats.cache_hits.values()))
"""


@pytest.mark.nightly
def test_a_class_that_is_not_there_any_more_disturbs_no_kernel(project_root, tmp_path):
    """Numba reads all entries of an index at once, and fails where one names a class in vain."""
    path = os.pathsep.join((str(tmp_path), str(project_root / "src")))
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": path}

    def hits(*words):
        done = subprocess.run(
            [sys.executable, *words], env=env, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return int(done.stdout)

    module = tmp_path / "my_loop.py"
    module.write_text(CALL.format(name="Loop"), encoding="utf-8")
    use = "-c", "import my_loop"
    assert [hits(*use), hits(*use)] == [0, 1]
    module.write_text(CALL.format(name="Other"), encoding="utf-8")
    assert [hits(*use), hits(*use)] == [0, 1]
    module.unlink()
    assert [hits("-c", OURS), hits("-c", OURS)] == [0, 1]


OF_A_USER = """
import numba

def settings():
    return {name: getattr(numba.config, name) for name in dir(numba.config) if name.isupper()}

before = settings()
import numpy as np
from hiersched.env import SlicingVectorEnv
from hiersched.models.plant.dexterity import dexterity_index
assert settings() == before

@numba.njit(cache=True)
def twice(x):
    return 2 * x

assert twice(3) == 6
assert dexterity_index(0.0, 0.0, 0.0) == 1.0
print(twice.stats.cache_path)
print(dexterity_index.stats.cache_path)
"""


def test_a_users_own_functions_keep_their_settings_and_their_cache(project_root, tmp_path):
    """Where the machine code lies: that of a user where Numba has it, ours apart from it."""
    module, chosen = tmp_path / "my_module.py", tmp_path / "chosen"
    module.write_text(OF_A_USER, encoding="utf-8")
    env = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), str(project_root / "src")))}
    env.pop("NUMBA_CACHE_DIR", None)

    def folders(**more):
        done = subprocess.run(
            [sys.executable, "-c", "import my_module"],
            env={**env, **more}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return map(Path, done.stdout.split())

    theirs, ours = folders()
    assert theirs == tmp_path / "__pycache__"
    assert list(theirs.glob("my_module.twice*.nbc"))
    assert ours.is_relative_to(CACHE_FOLDER)
    theirs, ours = folders(NUMBA_CACHE_DIR=str(chosen))
    assert theirs.parent == chosen
    assert ours.is_relative_to(chosen / CACHE_FOLDER.name)
    assert list(ours.glob("*.nbc"))
