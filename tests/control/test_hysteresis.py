from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hiersched.control import hold_delays, hold_step

delay_histories = arrays(np.int64, st.integers(1, 60), elements=st.integers(0, 5))


def test_by_hand():
    delays = [0, 4, 1, 1, 3, 1, 1, 5, 0]
    assert hold_delays(delays, 0).tolist() == delays
    # 4 at sample 1; shorter at samples 2, 3; released at 4, to what the delay is then.
    assert hold_delays(delays, 2).tolist() == [0, 4, 4, 4, 3, 3, 3, 5, 5]
    assert hold_delays(delays, 100).tolist() == [0, 4, 4, 4, 4, 4, 4, 5, 5]


def test_an_equal_delay_starts_the_count_anew():
    assert hold_delays([3, 1, 3, 1, 1, 1], 2).tolist() == [3, 3, 3, 3, 3, 1]


@given(delay_histories, st.integers(0, 8))
def test_holding_is_sound_and_lasts(delays, hold):
    """The entry in force covers the delay; one that is left for a shorter one was held."""
    levels = hold_delays(delays, hold)
    assert (levels >= delays).all()
    rises = np.flatnonzero(np.diff(levels) > 0) + 1
    np.testing.assert_array_equal(levels[rises], delays[rises])  # never longer than asked for
    since = 0
    for k in range(1, len(levels)):
        if levels[k] < levels[k - 1]:
            assert k - since > hold
            assert (delays[max(k - hold, 0) : k] < levels[k - 1]).all()
        if levels[k] != levels[k - 1]:
            since = k


def test_many_robots_at_once_equal_each_alone():
    rng = np.random.default_rng(3)
    delays = rng.integers(0, 13, (200, 4, 3))
    together = hold_delays(delays, 5)
    for index in np.ndindex(4, 3):
        np.testing.assert_array_equal(together[:, *index], hold_delays(delays[:, *index], 5))


@pytest.mark.parametrize(
    ("hold", "message"),
    [(-1, "hold_samples is -1; it must be at least 0"), (0.5, "hold_samples is 0.5; it must be a")],
)
def test_hold_rejects(hold, message):
    with pytest.raises(ValueError, match=message):
        hold_step(0, 0, 1, hold)
    with pytest.raises(ValueError, match=message):
        hold_delays([0, 1], hold)
