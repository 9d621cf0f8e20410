"""How the kernels are compiled, and where the machine code is kept."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba import njit, types
from numba.core import event
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    _CacheLocator,
)
from numba.core.registry import CPUDispatcher

PACKAGE = Path(__file__).resolve().parents[1]
_SOURCES = ("core", "allocation", "models", "policies", "simulator")


def _cache_folder() -> Path:
    """Folder of the machine code, one for each state of the kernels' sources.

    Numba looks at the file of a function alone: a change in a function that it calls from another
    file would go unnoticed. The hash of all the kernels' sources in the folder's name takes care of
    that. Sources outside the package are not part of it: `core.seam` takes care of theirs.
    The folder lies in Numba's `CACHE_DIR` where that is set.
    """
    digest = hashlib.sha256()
    for name in _SOURCES:
        for file in sorted((PACKAGE / name).rglob("*.py")):
            digest.update(file.read_bytes())
    home = PACKAGE / "__pycache__"
    if numba.config.CACHE_DIR:
        home = Path(numba.config.CACHE_DIR)
    elif not os.access(home if home.exists() else PACKAGE, os.W_OK):
        home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hiersched"
    return home / f"kernels-{digest.hexdigest()[:16]}"


CACHE_FOLDER = _cache_folder()


class _Locator(_CacheLocator):
    """Says where the machine code of a kernel lies: Numba's settings stay as they are."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._py_file = py_file  # Numba's warnings name it
        self._line = py_func.__code__.co_firstlineno
        self._folder = CACHE_FOLDER / self.get_suitable_cache_subpath(py_file)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _Locator | None:
        locator = cls(py_func, py_file)
        try:
            locator.ensure_cache_path()
        except OSError:
            return None
        return locator

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return hashlib.sha256(Path(self._py_file).read_bytes()).hexdigest()

    def get_disambiguator(self) -> str:
        return str(self._line)


class _IndexByClasses(IndexDataCacheFile):
    """Index of a kernel's machine code: one for each set of NamedTuples from outside the package.

    Numba reads an index as a whole: where it mentions a class that is not there, of a plug-in that
    this process has not imported or whose class has another name now, not even the entries of our
    own types could be read.
    """

    def load(self, key: Any) -> Any:
        """Load the machine code of a signature, None where there is none."""
        return IndexDataCacheFile.load(self._of(key), key)

    def save(self, key: Any, data: Any) -> None:
        """Keep the machine code of a signature."""
        IndexDataCacheFile.save(self._of(key), key, data)

    def _of(self, key: Any) -> IndexDataCacheFile:
        classes = sorted(set(_outside_classes(key[0])))
        if not classes:
            return self
        base = self._index_name.removesuffix(".nbi")
        digest = hashlib.sha256("\n".join(classes).encode()).hexdigest()[:16]
        return IndexDataCacheFile(self._cache_path, f"{base}.{digest}", self._source_stamp)


class _CacheImpl(CompileResultCacheImpl):
    _locator_classes = (_Locator,)


class _KernelCache(FunctionCache):
    _impl_class = _CacheImpl

    def __init__(self, py_func: Any) -> None:
        super().__init__(py_func)
        self._cache_file.__class__ = _IndexByClasses


def _outside_classes(kinds: Any) -> Iterator[str]:
    """Names of the NamedTuples in Numba's types that are not of this package."""
    for kind in kinds:
        struct = getattr(kind, "struct", kind)  # of a pointer
        found = getattr(struct, "instance_class", None)
        if found is not None and not found.__module__.startswith(f"{PACKAGE.name}."):
            yield f"{found.__module__}.{found.__qualname__}"
        if isinstance(struct, types.BaseTuple):
            yield from _outside_classes(struct.types)


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a kernel, compiled once a machine.

    No reference counting: the kernels allocate nothing, and counting every view of an array took a
    third of the slot loop's time. Division by zero is that of IEEE 754. No entry for C callbacks,
    which nobody uses and whose compilation takes a tenth of the whole.

    Machine code is kept on disk for the package and, since `core.seam` hashes their sources, for
    plugged kernels: of others outside nobody would notice that what they call has changed.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        is_ours = Path(function.__code__.co_filename).resolve().is_relative_to(PACKAGE)
        cache = options.pop("cache", is_ours)
        dispatcher = njit(error_model="numpy", _nrt=False, no_cfunc_wrapper=True, **options)(
            function
        )
        if cache and isinstance(dispatcher, CPUDispatcher):  # else NUMBA_DISABLE_JIT is set
            dispatcher._cache = _KernelCache(function)
        return dispatcher

    return decorate


class _InnerKernel(CPUDispatcher):
    """A kernel without an entry for Python: a call from there would end the process."""

    __slots__ = ()

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        raise TypeError(f"{self.py_func.__qualname__} is called by other kernels only")


def inner_kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a kernel that other kernels call: it has no entry for Python, which costs time."""

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = kernel(no_cpython_wrapper=True, **options)(function)
        if isinstance(dispatcher, CPUDispatcher):  # else NUMBA_DISABLE_JIT is set
            dispatcher.__class__ = _InnerKernel
        return dispatcher

    return decorate


class _Notice(event.Listener):
    """Says once a process that kernels are being compiled, which takes a while."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: Any) -> None:
        """Numba begins to compile: not told where the cache has the kernel."""
        dispatcher = event.data["dispatcher"]
        if self._said or not dispatcher.targetoptions.get("no_cfunc_wrapper"):
            return
        self._said = True
        print(
            "hiersched: compiling kernels, once per machine and version (up to half a minute)",
            file=sys.stderr,
            flush=True,
        )

    def on_end(self, event: Any) -> None:
        """Nothing more to say."""


event.register("numba:compile", _Notice())
