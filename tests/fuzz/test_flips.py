"""Flipped bits in weights: every one is noticed, before anything is read from them."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hiersched.core.faults import InputError
from hiersched.learning.checkpoint import load_checkpoint, save_checkpoint
from hiersched.policies.trained import TrainedPolicy

SHA256 = "ab" * 32


def write_policy(path: Path) -> None:
    rng = np.random.default_rng(1)
    TrainedPolicy(
        parameters=rng.normal(size=(2, 24 * 64 + 64 + 65 * 64 + 65)).astype(np.float32),
        network="shared",
        hidden=(64, 64),
        rule="pf",
        weighs="utility",
        observe_robots=False,
        observe_demand=False,
        num_embb=4,
        weight_exponent=3.0,
        multipliers=np.array([0.1, 2.0, 0.0]),
        seed=9,
        scenario_sha256=SHA256,
    ).save(path)


def write_checkpoint(path: Path) -> None:
    state = {"trainer": {"actor": torch.randn(4, 5000), "round": 3}, "rows": [{"a": 1.0}]}
    save_checkpoint(path, SHA256, state)


@pytest.mark.parametrize(
    ("write", "read"),
    [
        (write_policy, TrainedPolicy.load),
        (write_checkpoint, lambda path: load_checkpoint(path, SHA256)),
    ],
)
def test_two_hundred_flips_are_noticed(
    tmp_path: Path, write: Callable[[Path], None], read: Callable[[Path], Any]
) -> None:
    path, rng = tmp_path / "weights", random.Random(5)
    write(path)
    data = path.read_bytes()
    read(path)
    for _ in range(200):
        damaged = bytearray(data)
        damaged[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="weights: not a "):
            read(path)


class Malicious:
    """Would run a command where it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return print, ("unpickled",)


def test_a_pickle_that_runs_code_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a checkpoint whose checksum is right, and in place of a policy."""
    path = tmp_path / "weights"
    save_checkpoint(path, SHA256, {"trainer": Malicious()})
    with pytest.raises(InputError, match="weights: not a checkpoint"):
        load_checkpoint(path, SHA256)
    torch.save({"parameters": Malicious()}, path)
    with pytest.raises(InputError, match="weights: not a policy"):
        TrainedPolicy.load(path)
    assert "unpickled" not in capsys.readouterr().out
