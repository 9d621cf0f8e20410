"""C1 on random split plants; HIERSCHED_RANDOM_SYSTEMS=1000 runs as many (2 minutes)."""

from __future__ import annotations

import collections
import logging
import os

import numpy as np
import pytest

from hiersched.control import design_gain, spectral_radius_by_delay, split_plant

COUNT = int(os.environ.get("HIERSCHED_RANDOM_SYSTEMS", "100"))
LONGEST = 40  # samples: C1 promises stability at any delay


def _random_plant(rng):
    n = int(rng.integers(1, 4))
    m = int(rng.integers(1, n + 1))
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.7, 1.15) / np.abs(np.linalg.eigvals(A)).max()
    return split_plant(
        A,
        rng.standard_normal((n, m)),
        np.eye(n),
        rng.uniform(0.01, 1.0) * np.eye(m),
        operator_share=rng.uniform(),
        operator_states=range(n),
        sampling_s=0.1,
    )


@pytest.mark.nightly
def test_c1_accepts_no_gain_that_a_delay_destabilises_and_rejects_none_silently(caplog):
    seen = collections.Counter()
    for index in range(COUNT):
        rng = np.random.default_rng((2024, index))
        plant, rate, T = _random_plant(rng), rng.uniform(0.005, 0.1), int(rng.integers(0, 8))
        caplog.clear()
        with caplog.at_level(logging.WARNING, logger="hiersched.control"):
            design = design_gain(plant, T, "razumikhin", decay_rate=rate)
        seen[design.status] += 1
        warned = f"no certified gain: method=razumikhin plant=split T={T};" in caplog.text
        assert warned == (design.status == "infeasible"), index
        assert design.certified == (design.status != "infeasible"), index
        if design.certified:
            loop = plant.closed_loop(design.gain)
            assert spectral_radius_by_delay(*loop, LONGEST).max() < 1.0, index
            # The promised rate holds for delays up to T.
            assert design.certificate.spectral_radii.max() <= np.sqrt(1.0 - rate) + 1e-9, index
    assert set(seen) == {"nominal", "adjusted", "infeasible"}, seen
