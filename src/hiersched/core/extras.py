"""What the core does without: packages that an extra brings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

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
    "tabulate": "study",
    "jinja2": "study",
    "rerun": "viewer",
    "PIL": "render",
    "stable_baselines3": "sb3",
    "onnxruntime": "onnx",
}
"""Package that is imported -> the extra that brings it."""


class MissingExtraError(ImportError):
    """A package that an extra brings is not installed."""

    def __init__(self, package: str) -> None:
        extra = EXTRA_OF[package]
        super().__init__(
            f"this needs {package}, which is not installed: pip install 'hiersched[{extra}]'",
            name=package,
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
