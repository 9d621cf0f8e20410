"""What the core does without: packages that an extra brings."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import packages_distributions
from typing import Any

from hiersched.core.faults import did_you_mean

EXTRA_OF = {
    "torch": "learn",
    "tqdm": "learn",
    "pettingzoo": "pettingzoo",
    "cvxpy": "control",
    "clarabel": "control",
    "matplotlib": "study",
    "pandas": "study",
    "pyarrow": "study",
    "snakemake": "study",
    "jinja2": "study",
    "rerun": "viewer",
    "PIL": "render",
    "stable_baselines3": "sb3",
    "onnxruntime": "onnx",
}
"""Package that is imported -> the extra that brings it."""


class MissingExtraError(ModuleNotFoundError):
    """A package that an extra brings is not installed."""

    def __init__(self, package: str) -> None:
        super().__init__(
            f"this needs {package}, which is not installed: {install_command(package)}",
            name=package,
        )


def install_command(package: str) -> str:
    """Return what to type for a package of `EXTRA_OF`."""
    return f"pip install 'hiersched[{EXTRA_OF[package]}]'"


def import_fault(error: Exception) -> str:
    """Say why a file of a user's cannot be imported, and what to install where a package lacks."""
    what = f"{type(error).__name__}: {error}"
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return what
    if isinstance(error, MissingExtraError):
        return what  # says it
    package = error.name.partition(".")[0]
    if package in EXTRA_OF:
        return f"{what}: {install_command(package)}"
    known = {*sys.stdlib_module_names, *packages_distributions()}
    return (
        f"{what}{did_you_mean(package, known)} (a package is installed where hiersched is: python "
        "-m pip install PACKAGE; a file of your own lies beside the plug-in that imports it, or is "
        f"a plug-in itself: `plugins: [{package}.py]`)"
    )


@contextmanager
def naming_extras() -> Iterator[None]:
    """Raise MissingExtraError, which names the extra, where an import within fails without it."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRA_OF:
            raise
        raise MissingExtraError(package) from error


def lazy_names(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package, some of whose names are imported on first use.

    `modules`: name -> the module of the package that has it. Where an extra lacks, the error is a
    MissingExtraError.
    """

    def load(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with naming_extras():
            return getattr(import_module(f"{package}.{modules[name]}"), name)

    return load
