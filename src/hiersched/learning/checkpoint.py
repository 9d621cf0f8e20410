"""Checkpoints between two rounds: what goes on from one is what would have been, bit for bit."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import torch

from hiersched.core.faults import InputError
from hiersched.core.files import write_bytes
from hiersched.core.sealed import SealError, seal, unseal
from hiersched.policies.features import FEATURE_VERSION

_FORMAT = 4


class CheckpointError(InputError, ValueError):
    """A checkpoint that cannot be resumed: the message says what differs."""


def _identity(scenario_sha256: str) -> dict[str, Any]:
    """List what must be the same for the bits to be the same; the thread count is always 1."""
    return {
        "format": _FORMAT,
        "scenario_sha256": scenario_sha256,
        "feature_version": FEATURE_VERSION,
        "torch": str(torch.__version__),
    }


def save_checkpoint(path: Path, scenario_sha256: str, state: dict[str, Any]) -> None:
    """Write a checkpoint; the file appears whole or not at all."""
    content = BytesIO()
    torch.save({"identity": _identity(scenario_sha256), "state": state}, content)
    write_bytes(path, seal(content.getvalue()))


def load_checkpoint(path: Path, scenario_sha256: str) -> dict[str, Any]:
    """Read what `save_checkpoint` wrote.

    CheckpointError if it is no checkpoint, damaged, or one of another scenario or version.
    """
    try:
        saved = torch.load(BytesIO(unseal(path.read_bytes())), weights_only=True)
        found = {str(name): str(value) for name, value in saved["identity"].items()}
        state: dict[str, Any] = saved["state"]
        if not isinstance(state, dict):
            raise TypeError("no state")
    except Exception as error:
        what = error if isinstance(error, SealError) else "its content is none"
        text = f"{path}: not a checkpoint: {what}; delete it to start anew"
        raise CheckpointError(text) from error
    for name, wanted in _identity(scenario_sha256).items():
        if found.get(name) != str(wanted):
            raise CheckpointError(
                f"{path}: {name} = {found.get(name)!r}: must be {wanted!r}; delete it to start anew"
            )
    return state
