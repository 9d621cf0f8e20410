"""Seams: the slot loop calls the kernel of a model by its address and never sees the model's types.

A model is compiled alone and cached beside its own file; no cached kernel of the loop mentions it.
All kernels have one form::

    kernel(me, constants, state, slot, env)

`me` is what the model itself is made of: parameters, what evolves, work arrays. The other three
are those of the loop (`simulator.setup`, `simulator.record`). A further quantity is a further field
there, and changes no kernel's form.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import inspect
import re
import sys
import sysconfig
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numba import njit, types
from numba.core.errors import NumbaError
from numba.extending import intrinsic

from hiersched.core.compiled import PACKAGE, inner_kernel
from hiersched.core.pointer import Pointer

FORM = ("me", "constants", "state", "slot", "env")
"""Parameters of a model's kernel."""


class KernelError(TypeError, ValueError):
    """A kernel that cannot be plugged in: the message names its file, the seam and the reason."""


class Plug(NamedTuple):
    """A model in a seam: addresses of its kernel and of its words; kernel 0 is an unused seam."""

    kernel: int
    words: int


UNUSED = Plug(0, 0)


class Seam:
    """A place of the slot loop that a model fills; `name` is for messages.

    `reads` and `writes` tell the reader what a kernel here finds, and what it has to write.
    """

    def __init__(self, name: str, *, reads: str, writes: str) -> None:
        self.name = name
        self._kernels: dict[type, Any] = {}
        self._sources: dict[type, str] = {}

    def kernel(self, words: type) -> Callable[[Callable[..., Any]], Any]:
        """Register the decorated function as the kernel of a NamedTuple class.

        TypeError if it does not have the form of a kernel, or another file has a kernel for them.
        """

        def register(function: Callable[..., Any]) -> Any:
            given = tuple(inspect.signature(function).parameters)
            if given != FORM:
                raise TypeError(
                    f"{function.__qualname__}({', '.join(given)}): a kernel of the seam "
                    f"{self.name} must be {function.__qualname__}({', '.join(FORM)})"
                )
            other = self._kernels.get(words)
            if other is not None and _file_of(other.py_func) != _file_of(function):
                raise TypeError(
                    f"{function.__qualname__}: {words.__name__} has a kernel of the seam "
                    f"{self.name} already, in {_file_of(other.py_func)}: words of another file are "
                    "not to be plugged anew"
                )
            self._kernels[words] = inner_kernel(cache=True)(function)
            # Now, not when it is compiled: a file may have been edited by then.
            self._sources[words] = _outside_sources(function)
            return self._kernels[words]

        return register

    def plug(self, words: Any, *arguments: Pointer) -> tuple[Plug, Pointer]:
        """Compile the kernel of a model, a NamedTuple, or load it; the pointer has to be kept.

        `arguments` are pointers to constants, state and slot. KernelError if the seam has no kernel
        for this NamedTuple, or it does not compile.
        """
        if type(words) not in self._kernels:
            known = ", ".join(dict.fromkeys(kind.__name__ for kind in self._kernels)) or "none"
            raise KernelError(
                f"{_file_of(type(words))}: {type(words).__name__} has no kernel for the seam "
                f"{self.name}: a NamedTuple, and a function decorated with `kernel` of the seam "
                f"and this class (there are kernels for {known})"
            )
        _check_words(words, f"{_file_of(type(words))}: {type(words).__name__}")
        function = self._kernels[type(words)]
        me = Pointer(words, self._sources[type(words)])
        kinds = (me.kind, *(argument.kind for argument in arguments), types.int64)
        try:
            address = _address_of(function, kinds)
        except (NumbaError, NotImplementedError, KernelError) as error:
            python = getattr(function, "py_func", function)
            raise KernelError(
                f"{_file_of(python)}: {python.__name__}, the kernel of {type(words).__name__} for "
                f"the seam {self.name}, does not compile: {_reason(error)}"
            ) from error
        return Plug(address, me.address), me


@njit(inline="always")
def call_plug(plug: Any, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Call the kernel in a plug."""
    _call_at(plug.kernel, plug.words, constants, state, slot, np.int64(env))


@intrinsic
def _call_at(
    typing_context: Any, kernel: Any, words: Any, constants: Any, state: Any, slot: Any, env: Any
) -> Any:
    """Call the kernel at an address; an error in it is an error of the caller."""
    kinds = (words, constants, state, slot, env)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        convention = context.call_conv
        kind = convention.get_function_type(types.none, kinds)
        pointer = builder.inttoptr(values[0], kind.as_pointer())
        status, _ = convention.call_function(builder, pointer, types.none, kinds, values[1:])
        with builder.if_then(status.is_error, likely=False):
            convention.return_status_propagate(builder, status)
        return context.get_dummy_value()

    return types.none(kernel, *kinds), generate


def _address_of(function: Any, kinds: tuple[types.Type, ...]) -> int:
    """Compile a kernel for argument types, or load it, and say where it lies."""
    function.compile(kinds)
    result = function.overloads[kinds]
    if result.signature.return_type != types.none:
        raise KernelError(f"it returns {result.signature.return_type}; a kernel returns nothing")
    return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))


def _file_of(thing: Any) -> str:
    """Return the name of the file in which something is defined, for messages."""
    file = getattr(sys.modules.get(thing.__module__), "__file__", None)
    return thing.__module__ if file is None else Path(file).name


def _check_words(words: Any, place: str) -> None:
    """Raise where a field of a NamedTuple is none that a kernel can read."""
    for name, value in zip(words._fields, words, strict=True):
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            _check_words(value, f"{place}.{name}")
        elif not isinstance(value, bool | int | float | np.generic | np.ndarray):
            raise KernelError(
                f"{place}.{name} is of type {type(value).__name__}: must be a number, a NumPy "
                "array, or a NamedTuple of these"
            )


def _reason(error: Exception) -> str:
    """Return what Numba says in one line; its own text follows in the traceback."""
    lines = [line.strip() for line in _short_types(str(error)).splitlines()]
    said = [line for line in lines if line and not line.startswith(_PREAMBLE)]
    places = re.findall(r'File "[^"]*", line \d+', str(error))
    reason = said[0].rstrip(":") if said else type(error).__name__
    reason += next((f" ({hint})" for part, hint in _HINTS.items() if part in reason), "")
    return f"{reason} (line {places[-1].split()[-1]})" if places else reason


_PREAMBLE = ("Failed in", "During:", "File ", "Internal error")
"""Lines of Numba's messages that say where it was at work."""

_ARRAYS = "a kernel cannot make arrays: work arrays belong to its words"
_HINTS = {
    "No definition for lowering": "a kernel cannot change a number: keep what evolves in an array",
    "No implementation of function Function(<built-in function zeros>": _ARRAYS,
    "No implementation of function Function(<built-in function empty>": _ARRAYS,
}


def _short_types(text: str) -> str:
    """Leave of a pointer's type the name of the NamedTuple: all its fields follow otherwise."""
    short, start = "", 0
    for found in re.finditer(r"Pointer\((\w+)\(", text):
        if found.start() < start:
            continue
        short += text[start : found.start()] + found[1]
        start, depth = found.end(), 2
        while start < len(text) and depth:
            depth += {"(": 1, ")": -1}.get(text[start], 0)
            start += 1
    return short + text[start:]


def _outside_sources(function: Callable[..., Any]) -> str:
    """Hash of a kernel's module and of all that it imports, where that is not ours; else "".

    Numba looks at the file of a kernel alone: what the kernel calls from another file of a plug-in
    has to be part of its type, so that a change there compiles it anew.
    """
    files = sorted(outside_files(sys.modules[function.__module__]))
    digest = hashlib.sha256()
    for file in files:
        digest.update(Path(file).read_bytes())
    return digest.hexdigest()[:16] if files else ""


def outside_files(module: ModuleType) -> set[str]:
    """Python files of a module and of all that it uses, but for installed packages and ours."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        used = waiting.pop()
        file = getattr(used, "__file__", None)
        if file is None or file in found or not _is_outside(Path(file).resolve()):
            continue
        found.add(file)
        names = {_module_of(value) for value in vars(used).values()}
        names.update(_imports(used, Path(file)))
        waiting.extend(sys.modules[name] for name in names if name in sys.modules)
    return found


def _imports(module: ModuleType, file: Path) -> Iterator[str]:
    """Names that a module imports: a number taken from another module does not say whose it is."""
    if file.suffix != ".py":
        return
    for node in ast.walk(ast.parse(file.read_bytes(), filename=str(file))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from _with_parents(alias.name)
        elif isinstance(node, ast.ImportFrom):
            if node.level and not module.__package__:
                continue  # it would raise
            relative = "." * node.level + (node.module or "")
            name = importlib.util.resolve_name(relative, module.__package__)
            yield from _with_parents(name)
            yield from (f"{name}.{alias.name}" for alias in node.names)


def _with_parents(name: str) -> Iterator[str]:
    """Return a.b and a for a.b: to import a module runs the packages that it lies in."""
    parts = name.split(".")
    return (".".join(parts[:count]) for count in range(1, len(parts) + 1))


def _module_of(value: Any) -> str:
    if isinstance(value, ModuleType):
        return value.__name__
    name = getattr(getattr(value, "py_func", value), "__module__", None)
    return name if isinstance(name, str) else ""


_INSTALLED = tuple(
    Path(sysconfig.get_path(name)).resolve()
    for name in ("stdlib", "platstdlib", "purelib", "platlib")
)


def _is_outside(file: Path) -> bool:
    """Whether a file is neither installed nor of this package."""
    return not any(file.is_relative_to(folder) for folder in (PACKAGE, *_INSTALLED))
