"""What there is of each kind, by name: built in, or added by a plug-in.

A plug-in is a Python file that a scenario names under `plugins`, or a module that an installed
package names in the entry-point group `hiersched.models`. Importing it registers what it holds.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar
from weakref import WeakSet

from hiersched.core.extras import import_fault
from hiersched.core.faults import did_you_mean

ENTRY_POINTS = "hiersched.models"
"""Group of the entry points that name plug-in modules."""

T = TypeVar("T")


class PluginError(ValueError):
    """A plug-in that cannot be loaded: the message names it and says why."""


class UnknownNameError(ValueError):
    """A name that nothing has been registered under; the message lists those that there are."""


_REGISTRIES: WeakSet[Registry[Any]] = WeakSet()


class Registry(Generic[T]):
    """Things of one kind by name.

    `kind` says in messages what they are; `part` is ``"study"`` for what shows results, on which no
    run depends.
    """

    def __init__(self, kind: str, part: str = "") -> None:
        self.kind, self.part = kind, part
        self._found: dict[str, T | str] = {}
        self._origins: dict[str, str] = {}
        _REGISTRIES.add(self)

    def add(self, name: str, thing: T | str, source: Any = None) -> None:
        """Register a thing, or where to import it from when it is first asked for (``a.b:c``).

        What it was made of, if that is something else, is its `source`. A name that is taken by
        something else raises PluginError.
        """
        origin = _origin(thing if source is None else source)
        old = self._origins.get(name, origin)
        if old != origin:
            raise PluginError(f"{self.kind} {name!r}: the name is taken by {old}")
        self._found[name], self._origins[name] = thing, origin

    def register(self, name: str) -> Callable[[T], T]:
        """Register the decorated thing."""

        def decorate(thing: T) -> T:
            self.add(name, thing)
            return thing

        return decorate

    def __getitem__(self, name: str) -> T:
        """Return the thing of a name; UnknownNameError, which lists the names, if there is none."""
        load_installed_plugins()
        if name not in self._found:
            raise UnknownNameError(f"{self.kind} {name!r}: {self.allowed(name)}")
        thing = self._found[name]
        if isinstance(thing, str):
            module, _, attribute = thing.partition(":")
            thing = self._found[name] = getattr(importlib.import_module(module), attribute)
        return thing

    def loaded(self, name: str) -> T | None:
        """Return the thing of a name, or None where it is not there or not imported yet."""
        thing = self._found.get(name)
        return None if isinstance(thing, str) else thing

    def allowed(self, name: object) -> str:
        """Say which names there are, for a message about another one."""
        return (
            f"must be one of {', '.join(self)}{did_you_mean(str(name), self)} (one of a plug-in "
            "needs its file: `plugins: [file.py]`)"
        )

    def __contains__(self, name: object) -> bool:
        load_installed_plugins()
        return name in self._found

    def __iter__(self) -> Iterator[str]:
        """Names in the order of their registration."""
        load_installed_plugins()
        return iter(tuple(self._found))

    def origin(self, name: str) -> str:
        """Return the file that registered a thing."""
        return self._origins[name].rpartition(":")[0]


def registered_files(part: str) -> set[str]:
    """Return the files that have registered something in a part of the registries."""
    return {
        registry.origin(name)
        for registry in _REGISTRIES
        if registry.part == part
        for name in registry
    }


def _origin(thing: Any) -> str:
    """Return file and name of a thing: the same where the file is run once more."""
    if isinstance(thing, str):
        return thing
    name = getattr(thing, "__qualname__", type(thing).__qualname__)
    module = getattr(thing, "__module__", "?")
    file = getattr(sys.modules.get(module), "__file__", None)
    return f"{file or module}:{name}"


@cache
def _installed() -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=ENTRY_POINTS))


@cache
def _import_entry_point(point: EntryPoint) -> ModuleType:
    try:
        found = point.load()
    except Exception as error:
        raise PluginError(
            f"entry point {point.name} = {point.value}: {import_fault(error)}"
        ) from error
    return found if isinstance(found, ModuleType) else sys.modules[found.__module__]


_LOADING: list[str] = []


def load_installed_plugins() -> dict[str, ModuleType]:
    """Import the modules that installed packages name; returns them by the name of the entry point.

    One that cannot be imported raises PluginError.
    """
    if _LOADING:  # one of them asks a registry while it is imported
        return {}
    modules = {}
    for point in _installed():
        _LOADING.append(point.name)
        try:
            modules[point.name] = _import_entry_point(point)
        finally:
            _LOADING.pop()
    return modules


def load_plugin(file: Path) -> ModuleType:
    """Import a plug-in file; one that is loaded already and has not changed is not run again.

    Its folder is on `sys.path` from then on, so that it can import its neighbours. What an older
    version of the file has registered is forgotten. PluginError if there is no such file, it
    raises, or its name is that of another module.
    """
    path = file.resolve()
    if not path.is_file() or path.suffix != ".py":
        raise PluginError(f"{file}: no such Python file")
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    loaded = sys.modules.get(path.stem)
    if getattr(loaded, "__plugin_sha256__", None) == sha256 and _file_of(loaded) == path:
        assert loaded is not None  # it has a hash
        return loaded
    _check_name(file, path, loaded)
    folder = str(path.parent)
    if folder not in sys.path:
        sys.path.append(folder)
    return _run(file, path, sha256)


def is_plugin_file(module: ModuleType) -> bool:
    """Whether a module is a file that a scenario has named under `plugins`."""
    return hasattr(module, "__plugin_sha256__")


def _file_of(module: ModuleType | None) -> Path | None:
    file = getattr(module, "__file__", None)
    return None if file is None else Path(file).resolve()


def _check_name(file: Path, path: Path, loaded: ModuleType | None) -> None:
    """Refuse a plug-in that would stand in the way of another module, loaded or not."""
    name = path.stem
    if not name.isidentifier():
        raise PluginError(f"{file}: {name!r} cannot be the name of a module")
    if loaded is not None:
        other: object = _file_of(loaded) or "built in"
    else:
        spec = importlib.util.find_spec(name)
        other = path if spec is None or spec.origin is None else spec.origin
    if other not in (path, str(path)):
        raise PluginError(
            f"{file}: there is another module {name!r} already ({other}); give the plug-in "
            "another name"
        )


def _run(file: Path, path: Path, sha256: str) -> ModuleType:
    """Run a plug-in as a module; nothing of it stays behind where it raises."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None  # it is a .py file
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    module.__plugin_sha256__ = sha256  # type: ignore[attr-defined]
    _forget(path)
    sys.modules[path.stem] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        _forget(path)
        del sys.modules[path.stem]
        what = str(error) if isinstance(error, PluginError) else import_fault(error)
        raise PluginError(f"{file}{_line(error, path)}: {what}") from error
    return module


def _line(error: Exception, path: Path) -> str:
    """Return ``, line N``: the last one of a file that an error passed, if it passed any."""
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if Path(frame.filename) == path
    ]
    return f", line {lines[-1]}" if lines else ""


def _forget(path: Path) -> None:
    """Remove what a file has registered."""
    for registry in _REGISTRIES:
        for name, origin in list(registry._origins.items()):
            if origin.startswith(f"{path}:"):
                del registry._found[name], registry._origins[name]


ALGORITHMS: Registry[Any] = Registry("learning.algorithm")
"""Learning algorithms: callables (scenario, generators) -> `learning.algorithm.Algorithm`.

A class may have an attribute `Parameters`, a dataclass: what `learning.parameters` has to be."""
BUILT_IN_ALGORITHMS = ("ddpg", "a2c", "es")
ALGORITHMS.add("ddpg", "hiersched.learning.ddpg:Ddpg")
ALGORITHMS.add("a2c", "hiersched.learning.a2c:A2c")
ALGORITHMS.add("es", "hiersched.learning.es:EvolutionStrategy")
