"""What there is of each kind, by name: built in, or added by a plug-in.

A plug-in is a Python file that a scenario names under `plugins`, or a module that an installed
package names in the entry-point group `hiersched.models`. Importing it registers what it holds.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

ENTRY_POINTS = "hiersched.models"
"""Group of the entry points that name plug-in modules."""

T = TypeVar("T")


class PluginError(ValueError):
    """A plug-in that cannot be loaded: the message names it and says why."""


class UnknownNameError(ValueError):
    """A name that nothing has been registered under; the message lists those that there are."""


class Registry(Generic[T]):
    """Things of one kind by name.

    Parameters
    ----------
    kind
        What they are, for messages, such as ``"path loss"``.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._found: dict[str, T | str] = {}

    def add(self, name: str, thing: T | str) -> None:
        """Register a thing, or where to import it from when it is first asked for (``a.b:c``).

        Raises
        ------
        PluginError
            If the name is taken by something else.
        """
        old = self._found.get(name)
        if old is not None and not _same(old, thing):
            raise PluginError(f"{self.kind} {name!r}: the name is taken by {_origin(old)}")
        self._found[name] = thing

    def register(self, name: str) -> Callable[[T], T]:
        """Register the decorated thing."""

        def decorate(thing: T) -> T:
            self.add(name, thing)
            return thing

        return decorate

    def __getitem__(self, name: str) -> T:
        """Return the thing of a name.

        Raises
        ------
        UnknownNameError
            If there is none.
        """
        load_installed_plugins()
        if name not in self._found:
            raise UnknownNameError(
                f"{self.kind} {name!r}: must be one of {', '.join(self._found)} (a plug-in's are "
                "known where `plugins` names its file)"
            )
        thing = self._found[name]
        if isinstance(thing, str):
            module, _, attribute = thing.partition(":")
            thing = self._found[name] = getattr(importlib.import_module(module), attribute)
        return thing

    def __contains__(self, name: object) -> bool:
        load_installed_plugins()
        return name in self._found

    def __iter__(self) -> Iterator[str]:
        """Names in the order of their registration."""
        load_installed_plugins()
        return iter(self._found)


def _same(old: Any, new: Any) -> bool:
    """Whether a file was loaded once more, or an import was only announced before."""
    return _origin(old) == _origin(new)


def _origin(thing: Any) -> str:
    if isinstance(thing, str):
        return thing
    module = sys.modules.get(getattr(thing, "__module__", ""), None)
    file = getattr(module, "__file__", None)
    name = getattr(thing, "__qualname__", type(thing).__qualname__)
    return f"{file or getattr(thing, '__module__', '?')}:{name}"


@cache
def load_installed_plugins() -> tuple[str, ...]:
    """Import the modules that installed packages name; returns their names.

    Raises
    ------
    PluginError
        If one of them cannot be imported.
    """
    names = []
    for point in entry_points(group=ENTRY_POINTS):
        try:
            point.load()
        except Exception as error:
            raise PluginError(f"entry point {point.name} = {point.value}: {error}") from error
        names.append(point.name)
    return tuple(names)


def load_plugin(file: Path) -> ModuleType:
    """Import a plug-in file; one that is loaded already and has not changed is not run again.

    Its folder is on `sys.path` from then on, so that it can import its neighbours.

    Raises
    ------
    PluginError
        If there is no such file, or it raises.
    """
    path = file.resolve()
    if not path.is_file() or path.suffix != ".py":
        raise PluginError(f"{file}: no such Python file")
    name = path.stem
    text = path.read_bytes()
    loaded = sys.modules.get(name)
    if loaded is not None:
        if getattr(loaded, "__file__", None) != str(path):
            raise PluginError(
                f"{file}: there is another module {name!r} already "
                f"({getattr(loaded, '__file__', 'built in')}); give the plug-in another name"
            )
        if getattr(loaded, "__plugin_sha256__", None) == hashlib.sha256(text).hexdigest():
            return loaded
    folder = str(path.parent)
    if folder not in sys.path:
        sys.path.append(folder)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None  # it is a .py file
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    module.__plugin_sha256__ = hashlib.sha256(text).hexdigest()  # type: ignore[attr-defined]
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except PluginError:
        del sys.modules[name]
        raise
    except Exception as error:
        del sys.modules[name]
        raise PluginError(f"{file}: {type(error).__name__}: {error}") from error
    return module
