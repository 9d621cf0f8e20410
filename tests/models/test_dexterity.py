from __future__ import annotations

import math

import pytest

from hiersched.models.plant.dexterity import dexterity_index, window_index


@pytest.mark.parametrize(
    ("tracking_cm", "orientation_deg", "curvature_per_m", "index"),
    [
        (0.0, 0.0, 0.0, 1.0),
        (5.0, 0.0, 0.0, 0.8),  # 0.4 · 0.5 + 0.3 + 0.3
        (0.0, 90.0, 0.0, 0.85),
        (0.0, 0.0, 0.5, 0.85),
        (2.0, 18.0, 0.1, 0.4 * 0.8 + 0.3 * 0.9 + 0.3 * 0.9),
        (11.0, 0.0, 0.0, 0.6),  # each part stops at 0
        (0.0, 0.0, 7.0, 0.7),
        (1e3, 1e3, 1e3, 0.0),
    ],
)
def test_index_by_hand(tracking_cm, orientation_deg, curvature_per_m, index):
    got = dexterity_index(tracking_cm, orientation_deg, curvature_per_m)
    assert got == pytest.approx(index, abs=1e-15)


def test_window_sums_become_root_mean_square_and_means():
    """400 steps with errors of 3 and 4 cm (RMS √12.5 cm), 0.1 rad and 0.2 / m."""
    got = window_index(200 * (0.03**2 + 0.04**2), 400 * 0.1, 400 * 0.2, 400)
    expected = dexterity_index(math.sqrt(12.5), math.degrees(0.1), 0.2)
    assert got == pytest.approx(expected, abs=1e-14)
