"""Shared settings: one thread, no display, repeatable property tests."""

from __future__ import annotations

import os
from pathlib import Path

# Before NumPy loads: the bits of a matrix product depend on the number of threads.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

# Compiling a Numba kernel takes seconds on its first call, so no deadline;
# derandomised, so that a run that passes here passes everywhere.
settings.register_profile(
    "hiersched",
    deadline=None,
    derandomize=True,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("hiersched")


@pytest.fixture(scope="session")
def project_root() -> Path:
    """The root folder of the checkout."""
    return Path(__file__).resolve().parents[1]
