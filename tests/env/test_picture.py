from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from hiersched.core.colours import user_colours
from hiersched.core.extras import MissingExtraError
from hiersched.env import SlicingEnv, SlicingParallelEnv, SlicingVectorEnv

pytest.importorskip("PIL")

from hiersched.env import picture


def run(env, slots, shape, seed=1):
    """Random actions; returns the owners of each slot, shape (slots, E, K)."""
    rng = np.random.default_rng(seed)
    owners = []
    for _ in range(slots):
        env.step(rng.uniform(-1, 1, shape).astype(np.float32))
        owners.append(env._loop.record.prb_owner[:, 0].copy())
    return np.array(owners)


def fields(frame, slots, num_prb):
    """Colours at the middle of each field of the allocation, shape (slots, K, 3)."""
    x = picture._LEFT + picture._slot_width() * (np.arange(slots) + 0.5)
    top, height = picture._ALLOCATION.top, picture._ALLOCATION.height
    y = top + height * (np.arange(num_prb) + 0.5) / num_prb
    return frame[y.astype(int)[None, :], x.astype(int)[:, None]]


@pytest.mark.parametrize("slots", [3, picture.WINDOW + 7])
def test_each_prb_has_the_colour_of_its_owner_in_each_of_the_last_slots(scenario, gains, slots):
    env = SlicingVectorEnv(scenario, gains, 2, num_slots=slots + 1, render_mode="rgb_array")
    env.reset(seed=1)
    owners = run(env, slots, (2, 5))[-picture.WINDOW :]
    frames = env.render()
    assert len(frames) == 2
    colours = user_colours(3, 2)
    for world, frame in enumerate(frames):
        assert (frame.shape, frame.dtype) == ((*picture.SIZE[::-1], 3), np.uint8)
        seen = fields(frame, len(owners), scenario.radio.num_prb)
        np.testing.assert_array_equal(seen, colours[owners[:, world]])
    assert not np.array_equal(*frames)


def curve_height(frame, panel, slot, colour):
    """Where a curve of one colour crosses a slot's middle, 0 at the panel's foot and 1 at top."""
    x = int(picture._LEFT + picture._slot_width() * (slot + 0.5))
    column = frame[panel.top + 1 : panel.top + panel.height, x].astype(int)
    return 1.0 - (np.abs(column - colour).sum(axis=-1).argmin() + 1.5) / panel.height


def test_curves_lie_at_their_values(scenario, gains):
    """Of the one user whose value is the largest, which nothing hides."""
    env = SlicingEnv(scenario, gains, num_slots=30, render_mode="rgb_array")
    env.reset(seed=1)
    backlog, error_cm = [], []
    for _ in range(30):
        env.step(np.array([1, 1, 1, -1, -1], np.float32))
        backlog.append(env._loop.record.backlog_packets[0, 0].copy())
        error_cm.append(100.0 * env._loop.record.tracking_error_m[0, 0])
    frame = env.render()
    panels = (picture._QUEUES, np.array(backlog)), (picture._ERRORS, np.array(error_cm))
    for panel, values in panels:
        slot, user = np.unravel_index(values.argmax(), values.shape)
        colour = user_colours(3, 2)[user].astype(int)
        _, end = picture._axis(values.max())
        found = curve_height(frame, panel, slot, colour)
        assert found == pytest.approx(values[slot, user] / end, abs=0.03)


@pytest.mark.parametrize(
    ("top", "axis"),
    [(0.0, (0.5, 1.0)), (3.9, (1.0, 4.0)), (4.0, (1.0, 4.0)), (263.0, (100.0, 300.0)),
     (0.021, (0.01, 0.03)), (9.0, (5.0, 10.0))],
)  # fmt: skip
def test_axes_have_round_steps_and_hold_their_values(top, axis):
    assert picture._axis(top) == pytest.approx(axis)


def test_an_episode_begins_with_empty_panels(scenario, gains):
    env = SlicingParallelEnv(scenario, gains, num_slots=4, render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match="render: the first episode has not begun"):
        env.render()
    env.reset(seed=1)
    empty = env.render()
    assert (fields(empty, picture.WINDOW, scenario.radio.num_prb) == 255).all()
    env.step({"urllc": np.zeros(3, np.float32), "embb": np.zeros(2, np.float32)})
    assert not np.array_equal(env.render(), empty)
    env.reset()
    np.testing.assert_array_equal(env.render(), empty)


def test_many_users_fit_into_a_picture(scenario, gains):
    """The last field of the legend is that of the last user, and inside the picture."""
    pictures = picture.Pictures(
        replace(scenario, users=replace(scenario.users, num_urllc=40, num_embb=60)), 1, 10
    )
    frame = pictures.draw(0)
    height = picture._LEGEND_HEIGHT / 100
    y = int(picture._LEGEND_TOP + 99.5 * height)
    np.testing.assert_array_equal(frame[y, picture._LEGEND_LEFT + 5], user_colours(40, 60)[-1])


def test_other_modes_are_refused_and_none_draws_nothing(scenario, gains):
    with pytest.raises(ValueError, match="render_mode = 'human': must be rgb_array or None"):
        SlicingEnv(scenario, gains, render_mode="human")
    env = SlicingEnv(scenario, gains)
    env.reset(seed=1)
    with pytest.warns(UserWarning, match="no render_mode was given; must be rgb_array"):
        assert env.render() is None


def test_without_its_library_a_picture_names_the_extra(scenario, gains, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.delitem(sys.modules, "hiersched.env.picture")
    with pytest.raises(MissingExtraError, match=r"pip install 'hiersched\[render\]'"):
        SlicingEnv(scenario, gains, render_mode="rgb_array")
