from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hiersched.core.fields import ModelField, fields_to_text
from hiersched.log import LogDims, LogWriter
from hiersched.log.schema import topics_in

SLOT_NS = 10_000_000
MODEL_FIELDS = fields_to_text(
    [
        ModelField("radio.fading/coherence", "1", 0, 5),
        ModelField("plant/slip", "m/s", 5, 3),
    ]
)
Fields = dict[str, Any]


def make_fields(slots: int, dims: LogDims, seed: int = 0) -> Fields:
    """Random bits in every field of the full profile: NaNs, infinities and denormals too."""
    rng = np.random.default_rng(seed)
    fields: Fields = {}
    for topic in topics_in("full", dims.num_model_values).values():
        for field in topic.fields_in("full"):
            shape = (slots, *field.sized(dims.sizes))
            raw = rng.bytes(int(np.prod(shape)) * np.dtype(field.dtype).itemsize)
            fields[field.name] = np.frombuffer(raw, field.dtype).reshape(shape)
    return fields


@pytest.fixture(scope="session")
def dims() -> LogDims:
    return LogDims(num_urllc=3, num_embb=2, num_prb=7)


@pytest.fixture(scope="session")
def model_dims(dims: LogDims) -> LogDims:
    """With two fields of models: of each user, and of each robot."""
    return replace(dims, num_model_values=8)


@pytest.fixture(scope="session")
def random_fields(dims: LogDims) -> Callable[..., Fields]:
    return lambda slots, seed=0, dims=dims: make_fields(slots, dims, seed)


@pytest.fixture(scope="session")
def write_log(dims: LogDims) -> Callable[..., Path]:
    """Write a log of several blocks and chunks with some events."""

    def write(path: Path, fields: Fields, *, block: int = 30, **settings: Any) -> Path:
        settings = {
            "dims": dims,
            "slot_ns": SLOT_NS,
            "chunk_bytes": 5000,
            "metadata": {"scenario": "test", "seed": "1", "policy": "pf"},
            "attachments": {"scenario.yaml": b"name: test\n", "policy.pt": bytes(range(256))},
            **settings,
        }
        if settings["dims"].num_model_values:
            settings["metadata"] = {"model_fields": MODEL_FIELDS, **settings["metadata"]}
        slots = len(fields["prb_owner"])
        with LogWriter(path, **settings) as log:
            log.event(0, "INFO", "run", "starts")
            for start in range(0, slots, block):
                log.write_block(start, {k: v[start : start + block] for k, v in fields.items()})
            log.event(70, "WARNING", "control", "gain for T = 12 infeasible: α² ≥ 1")
            log.event(70, "DEBUG", "control", "second of its slot")
            log.event(41, "ERROR", "network", "deadline violated")
        return path

    return write
