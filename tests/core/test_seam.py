"""Seams: kernels by their address, what is refused, errors, what the cache knows of plug-ins."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from hiersched.core import registry
from hiersched.core.compiled import CACHE_FOLDER, inner_kernel, kernel
from hiersched.core.pointer import Pointer
from hiersched.core.registry import load_plugin
from hiersched.core.seam import UNUSED, Seam, call_plug, outside_files

TRY = Seam("a place for tests", reads="state.values", writes="slot.values")


class Factor(NamedTuple):
    factor: float
    count: Any


class Fails(NamedTuple):
    above: float


class Unknown(NamedTuple):
    none: int = 0


class Constants(NamedTuple):
    offset: float


class Values(NamedTuple):
    values: Any


@TRY.kernel(Factor)
def multiply(me, constants, state, slot, env):
    me.count[env] += 1
    for user in range(state.values.shape[1]):
        slot.values[user] = constants.offset + me.factor * state.values[env, user]


@TRY.kernel(Fails)
def fail(me, constants, state, slot, env):
    for user in range(state.values.shape[1]):
        if state.values[env, user] > me.above:
            raise ValueError("a value is too large")
        slot.values[user] = state.values[env, user]


@kernel()
def call(plug, constants, state, slot, env):
    """Call what is plugged in, and say that it came back."""
    call_plug(plug, constants, state, slot, env)
    return env + 1


@kernel()
def call_all(plugs, constants, state, slot):
    """From within another kernel, by a pointer to plugs."""
    for env in range(state.values.shape[0]):
        call_within(plugs, constants, state, slot, env)


@inner_kernel()
def call_within(plugs, constants, state, slot, env):
    call_plug(plugs.one, constants, state, slot, env)


class Plugs(NamedTuple):
    other: float
    one: Any


@pytest.fixture
def world():
    """Constants, state of three worlds, and the slot in work, each as a pointer."""
    values = np.arange(12.0).reshape(3, 4)
    return Pointer(Constants(0.5)), Pointer(Values(values)), Pointer(Values(np.zeros(4)))


def test_a_kernel_is_called_with_its_own_words_and_those_of_the_loop(world):
    words = Factor(3.0, np.zeros(3, np.int64))
    plug, kept = TRY.plug(words, *world)
    _, state, slot = world
    for env in (2, 0):
        assert call(plug, *world, env) == env + 1
        np.testing.assert_array_equal(slot.value.values, 0.5 + 3.0 * state.value.values[env])
    assert words.count.tolist() == [1, 0, 1]
    assert kept.value is words


def test_plugs_of_the_same_words_are_one_kernel(world):
    first, kept = TRY.plug(Factor(3.0, np.zeros(3, np.int64)), *world)
    second, kept_too = TRY.plug(Factor(5.0, np.zeros(3, np.int64)), *world)
    assert first.kernel == second.kernel
    assert first.words != second.words
    call(second, *world, 1)
    assert world[2].value.values[0] == 0.5 + 5.0 * 4.0
    assert len(multiply.overloads) == 1
    assert kept.address == first.words
    assert kept_too.address == second.words


@pytest.mark.parametrize(
    "source",
    [
        "def bad(me, constants, state, slot): pass",
        "def bad(me, constants, state, slot, env, more): pass",
        "def bad(me, state, constants, slot, env): pass",
        "def bad(*arguments): pass",
    ],
)
def test_a_kernel_of_another_form_is_refused(source):
    made = {}
    exec(source, made)
    form = r"bad\(me, constants, state, slot, env\)"
    message = rf"bad\(.*\): a kernel of the seam a place for tests must be {form}"
    with pytest.raises(TypeError, match=message):
        TRY.kernel(Unknown)(made["bad"])


def test_words_of_another_file_keep_their_kernel():
    made = {"__name__": "seam_elsewhere"}
    code = compile("def mine(me, constants, state, slot, env): pass", "seam_elsewhere.py", "exec")
    exec(code, made)
    with pytest.raises(TypeError, match="mine: Factor has a kernel of the seam a place for tests"):
        TRY.kernel(Factor)(made["mine"])


def test_words_without_a_kernel_are_refused(world):
    with pytest.raises(TypeError, match="Unknown has no kernel for the seam a place for tests"):
        TRY.plug(Unknown(), *world)
    assert UNUSED.kernel == 0


def test_kernels_of_the_loop_cannot_be_called_from_python(world):
    """They have no entry for it: a call would end the process."""
    words = Pointer(Factor(3.0, np.zeros(3, np.int64)))
    for function, arguments in (
        (multiply, (words, *world, 0)),
        (call_within, (words, *world, 0)),
        (multiply, ()),
    ):
        with pytest.raises(
            TypeError, match=rf"{function.__name__} is called by other kernels only"
        ):
            function(*arguments)
    plug, _kept = TRY.plug(Factor(3.0, np.zeros(3, np.int64)), *world)  # nor a compiled one
    with pytest.raises(TypeError, match="multiply is called by other kernels only"):
        multiply(words, *world, 0)
    assert call(plug, *world, 0) == 1


@pytest.mark.parametrize("env", [0, 1, 2])
def test_an_error_in_a_plugged_kernel_reaches_python(world, env):
    """From any depth; what was written before it stays, and the next call works."""
    _, state, slot = world
    plug, _kept = TRY.plug(Fails(8.5), *world)
    plugs = Pointer(Plugs(0.0, plug))
    if env < 2:
        assert call(plug, *world, env) == env + 1
        np.testing.assert_array_equal(slot.value.values, state.value.values[env])
        return
    with pytest.raises(ValueError, match=r"^a value is too large$"):
        call(plug, *world, env)
    assert slot.value.values.tolist() == [8.0, 0.0, 0.0, 0.0]
    with pytest.raises(ValueError, match=r"^a value is too large$"):
        call_all(plugs, *world)
    assert slot.value.values.tolist() == [8.0, 5.0, 6.0, 7.0]
    assert call(plug, *world, 0) == 1


# What a plug-in is made of.


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """Write files, and load one of them as a plug-in; all is forgotten afterwards."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)

    def load(name, **files):
        for stem, text in files.items():
            path = tmp_path / f"{stem.replace('_of_', '/')}.py"
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
        return load_plugin(tmp_path / f"{name}.py")

    yield load
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path)):
            registry._forget(Path(sys.modules[name].__file__).resolve())
            del sys.modules[name]


@pytest.mark.parametrize(
    "line",
    [
        "import seam_other",
        "import seam_other as other",
        "from seam_other import function",
        "from seam_other import NUMBER",
        "from seam_other import *",
        "import seam_pack.seam_inner",
        "from seam_pack import seam_inner",
        "from seam_pack.seam_inner import NUMBER",
        "if True:\n    from seam_other import NUMBER as N",
    ],
)
def test_files_of_a_plugin_are_all_that_it_imports(plugin, tmp_path, line):
    """A number says nothing of the module that it is from."""
    module = plugin(
        "seam_mine",
        seam_mine=f"import math\nimport numpy as np\nfrom hiersched.core import seam\n{line}\n",
        seam_other="import seam_third\nNUMBER = seam_third.NUMBER\ndef function(): pass\n",
        seam_third="NUMBER = 3.0\n",
        seam_pack_of___init__="from .seam_beside import NUMBER\n",
        seam_pack_of_seam_beside="NUMBER = 4.0\n",
        seam_pack_of_seam_inner="from . import seam_beside\nNUMBER = seam_beside.NUMBER\n",
        seam_stranger="",
    )
    pack = {"seam_pack/__init__.py", "seam_pack/seam_beside.py", "seam_pack/seam_inner.py"}
    used = pack if "seam_pack" in line else {"seam_other.py", "seam_third.py"}
    found = {str(Path(file).relative_to(tmp_path)) for file in outside_files(module)}
    assert found == {"seam_mine.py", *used}


def test_our_own_modules_have_no_files_outside():
    assert outside_files(registry) == set()
    assert outside_files(np) == set()


# What the cache knows of them: processes of their own.

PLUGIN = """
from typing import NamedTuple
from seam_helper import share
from seam_numbers import SHIFT
from hiersched.core.seam import Seam

TRY = Seam("a place for tests", reads="", writes="")
FACTOR = 2.0

class Words(NamedTuple):
    gain: float

@TRY.kernel(Words)
def fill(me, constants, state, slot, env):
    for user in range(slot.values.shape[0]):
        slot.values[user] = me.gain * FACTOR * share(user) + SHIFT
"""
HELPER = """
from hiersched.core.compiled import inner_kernel

@inner_kernel()
def share(user):
    return user + 1.0
"""
NUMBERS = "SHIFT = 0.0\n"
VALUES = """
from typing import Any, NamedTuple

class Values(NamedTuple):
    values: Any
"""
USE = """
import json, sys
from pathlib import Path
import numpy as np
from seam_values import Values
from hiersched.core.compiled import kernel
from hiersched.core.pointer import Pointer
from hiersched.core.registry import load_plugin
from hiersched.core.seam import call_plug

@kernel()
def call(plug, constants, state, slot, env):
    call_plug(plug, constants, state, slot, env)

plugin = load_plugin(Path(sys.argv[1]))
for edit in sys.argv[2:]:  # FILE:OLD:NEW, after the file has been loaded
    file, old, new = edit.split(":")
    text = Path(file).read_text()
    assert old in text
    Path(file).write_text(text.replace(old, new))
world = [Pointer(Values(np.zeros(3))) for _ in range(3)]
plug, kept = plugin.TRY.plug(plugin.Words(10.0), *world)
call(plug, *world, 0)
stats = plugin.fill.stats
print(json.dumps({
    "values": world[2].value.values.tolist(),
    "hits": sum(stats.cache_hits.values()),
    "misses": sum(stats.cache_misses.values()),
}))
"""


@pytest.fixture
def processes(tmp_path):
    """Run a script in a process of its own, with a cache of its own; returns its last line."""
    cache = tmp_path / "cache"
    cache.mkdir()
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(cache),
        "PYTHONPATH": os.pathsep.join(sys.path),
        "PYTHONDONTWRITEBYTECODE": "1",  # Python tells edits within a second by the size alone
    }

    # A class of the script itself would be another one in every process.
    (tmp_path / "seam_values.py").write_text(VALUES, encoding="utf-8")

    def run(script, *arguments):
        path = tmp_path / "script.py"
        if not path.exists() or path.read_text(encoding="utf-8") != script:
            path.write_text(script, encoding="utf-8")
        done = subprocess.run(
            [sys.executable, str(path), *map(str, arguments)],
            env=environment, capture_output=True, text=True, check=False, cwd=tmp_path,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1]), done.stderr

    run.cache = cache
    return run


@pytest.fixture
def files(tmp_path):
    """A plug-in and what it imports, and a function that edits one of them."""
    folder = tmp_path / "plugins"
    folder.mkdir()
    texts = {"plugin": PLUGIN, "helper": HELPER, "numbers": NUMBERS}
    paths = {name: folder / f"seam_{name}.py" for name in texts}
    for name, text in texts.items():
        paths[name].write_text(text, encoding="utf-8")

    def edit(name, old, new):
        text = paths[name].read_text(encoding="utf-8")
        assert old in text
        assert len(old) == len(new)  # nothing but what is in the file tells them apart
        paths[name].write_text(text.replace(old, new), encoding="utf-8")

    return paths, edit


def result(values, *, cached):
    return {"values": values, "hits": int(cached), "misses": int(not cached)}


@pytest.mark.nightly
def test_a_plugin_is_compiled_once_and_anew_when_anything_of_it_changes(processes, files):
    paths, edit = files
    edits = [
        (None, [20.0, 40.0, 60.0]),
        (("plugin", "FACTOR = 2.0", "FACTOR = 3.0"), [30.0, 60.0, 90.0]),
        (("helper", "return user + 1.0", "return user + 2.0"), [60.0, 90.0, 120.0]),
        (("numbers", "SHIFT = 0.0", "SHIFT = 0.5"), [60.5, 90.5, 120.5]),
    ]
    for change, values in edits:
        if change is not None:
            edit(*change)
        assert processes(USE, paths["plugin"])[0] == result(values, cached=False)
        assert processes(USE, paths["plugin"])[0] == result(values, cached=True)


@pytest.mark.nightly
def test_an_edit_after_the_import_does_not_poison_the_cache(processes, files):
    """The process goes on with what it has loaded; the next one must not take that for the new."""
    paths, _ = files
    for name, change, before, after in (
        ("plugin", "FACTOR = 2.0:FACTOR = 5.0", [20.0, 40.0, 60.0], [50.0, 100.0, 150.0]),
        ("numbers", "SHIFT = 0.0:SHIFT = 7.0", [50.0, 100.0, 150.0], [57.0, 107.0, 157.0]),
    ):
        edit = f"{paths[name]}:{change}"
        assert processes(USE, paths["plugin"], edit)[0]["values"] == before
        assert processes(USE, paths["plugin"])[0]["values"] == after


RULE = """
from dataclasses import dataclass
from typing import Literal, NamedTuple
from hiersched.policies.registry import RULES, Rule
from hiersched.policies.seams import INDEX

class Words(NamedTuple):
    user: int

@RULES.model
@dataclass(frozen=True, kw_only=True)
class Favourite(Rule):
    model: Literal["favourite"] = "favourite"

    def words(self, setup):
        return Words(2)

@INDEX.kernel(Words)
def index_favourite(me, constants, state, slot, env):
    for user in range(state.index_weight.shape[1]):
        state.index_weight[env, user] = 1000.0 if user == me.user else 1.0
"""
RUN = """
import hashlib, json, sys
from pathlib import Path
import numpy as np
from hiersched.core.randomness import world_keys
from hiersched.core.registry import load_plugin
from hiersched.scenario import load_scenario
from hiersched.simulator import Simulator
from hiersched.simulator.loop_gains import Gains

config, plugins = Path(sys.argv[1]), sys.argv[2:]
scenario = load_scenario(config / "scenarios" / "smoke.yaml", defaults=config / "defaults.yaml")
n, m, _ = scenario.robot_sizes
gains = Gains.memoryless(np.zeros((scenario.max_delay_steps + 1, m, n)))
simulator = Simulator(scenario, gains, world_keys("cache", 1, 2), 10)
most = None
for file in plugins:
    record = simulator.run(load_plugin(Path(file)).Favourite())
    most = record.num_prb.min(axis=(0, 1)).tolist()
    simulator.reset(simulator.state.key)
bits = {name: hashlib.sha256(simulator.run(name).rows.tobytes()).hexdigest()
        for name in ("pf", "m_lwdf") if not simulator.reset(simulator.state.key)}
print(json.dumps({"most": most, "bits": bits}))
"""


@pytest.mark.nightly
def test_a_deleted_plugin_disturbs_no_other_run(processes, project_root, tmp_path):
    """With the cache that it left, the built-in models run as before, and from that cache."""
    file = tmp_path / "seam_rule.py"
    file.write_text(RULE, encoding="utf-8")
    if CACHE_FOLDER.is_dir():  # what is compiled already need not be compiled again
        shutil.copytree(CACHE_FOLDER, processes.cache / CACHE_FOLDER.name)
    config = project_root / "src/hiersched/config"
    with_it, _ = processes(RUN, config, file)
    assert with_it["most"] == [1, 1, 3, 1, 1, 1, 1, 1]
    assert list(processes.cache.rglob("*index_favourite*.nbc"))
    file.unlink()
    without, said = processes(RUN, config)
    assert without["bits"] == with_it["bits"]
    assert "compiling" not in said
