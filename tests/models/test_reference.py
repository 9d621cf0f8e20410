from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hiersched.core.randomness import world_keys
from hiersched.models.model import Setup
from hiersched.models.plant.operator import draw_references, operator_words
from hiersched.models.plant.reference import (
    Task,
    driven_table,
    greatest_turn_rate,
    reference_table,
    task_table,
    tasks_of,
)

STEP_S = 0.0025
SHAPE = SimpleNamespace(
    arc_radius_m=7.0,
    eight_half_width_m=3.0,
    zigzag_heading_deg=60.0,
    zigzag_period_m=1.6,
)


def table(name, length_m, speed_mps=1.0, robots=1):
    steps = math.ceil(length_m / speed_mps / STEP_S)
    robot = SimpleNamespace(
        reference=name, substep_s=STEP_S, speed_mps=speed_mps, **vars(SHAPE)
    )  # fmt: skip
    return reference_table(robot, steps, robots)


def test_straight_stays_on_its_line():
    pose = table("straight", 5.0)[0].pose
    np.testing.assert_allclose(pose[:, 0], np.arange(len(pose)) * STEP_S, atol=1e-12)
    assert not pose[:, 1:].any()


@pytest.mark.parametrize("speed_mps", [0.5, 1.0, 2.0])
def test_arc_keeps_its_radius_and_closes(speed_mps):
    made, _ = table("arc", 2 * math.pi * SHAPE.arc_radius_m, speed_mps)
    radius = np.hypot(made.pose[:, 0], made.pose[:, 1] - SHAPE.arc_radius_m)
    np.testing.assert_allclose(radius, SHAPE.arc_radius_m, atol=1e-9)
    np.testing.assert_allclose(made.turn_rate_radps, speed_mps / SHAPE.arc_radius_m, rtol=1e-12)
    assert np.hypot(*made.pose[-1, :2]) < 2 * speed_mps * STEP_S


def test_figure_eight_is_bernoullis_lemniscate():
    """(x² + y²)² = a² (x² − y²) about its node; the heading swings 135 degrees to either side."""
    length = SHAPE.eight_half_width_m * 5.244115108584239
    made, _ = table("figure_eight", length)
    end = round(length / STEP_S)
    pose = made.pose[: end + 1]
    np.testing.assert_allclose(pose[-1, :2], pose[0, :2], atol=5e-3)
    assert pose[-1, 2] == pytest.approx(pose[0, 2], abs=2e-3)
    # The path starts at its outermost point (a, 0) in the direction (0, 1), which in the table is
    # the origin and the direction (1, 0).
    x, y = SHAPE.eight_half_width_m - pose[:, 1], pose[:, 0]
    scale = SHAPE.eight_half_width_m**4
    residual = (x**2 + y**2) ** 2 - SHAPE.eight_half_width_m**2 * (x**2 - y**2)
    assert np.abs(residual).max() < 2e-3 * scale
    np.testing.assert_allclose([pose[:, 2].max(), -pose[:, 2].min()], 0.75 * math.pi, rtol=1e-4)
    assert np.abs(made.turn_rate_radps).max() == pytest.approx(
        3 / SHAPE.eight_half_width_m, rel=1e-4
    )


def test_zigzag_swings_sixty_degrees_to_either_side():
    pose = table("zigzag", 16.0)[0].pose
    assert np.degrees(pose[:, 2].max()) == pytest.approx(60.0, abs=1e-3)
    assert np.degrees(pose[:, 2].min()) == pytest.approx(-60.0, abs=1e-3)
    assert pose[-1, 0] > 5.0
    assert abs(pose[:, 1]).max() < 1.0


@pytest.mark.parametrize("name", ["straight", "arc", "figure_eight", "zigzag"])
def test_speed_and_turn_rate_are_those_of_the_poses(name):
    made, _ = table(name, 6.0, speed_mps=1.2)
    step = np.diff(made.pose, axis=0)
    np.testing.assert_allclose(step[:, 2] / STEP_S, made.turn_rate_radps, atol=1e-9)
    arc = 1.2 * STEP_S
    np.testing.assert_allclose(np.hypot(step[:, 0], step[:, 1]), arc, rtol=1e-4)
    direction = np.arctan2(step[:, 1], step[:, 0])
    np.testing.assert_allclose(direction, 0.5 * (made.pose[1:, 2] + made.pose[:-1, 2]), atol=1e-9)


def test_robots_start_evenly_spread_over_the_period():
    made, offset = table("figure_eight", 3.0, robots=4)
    period = SHAPE.eight_half_width_m * 5.244115108584239 / STEP_S
    np.testing.assert_allclose(offset, period * np.arange(4) / 4, atol=0.5)
    assert len(made.turn_rate_radps) == 1200 + offset[-1]
    assert len(made.pose) == len(made.turn_rate_radps) + 1


def driven(time_s, arc_m, heading_rad, *, num_steps, repeat=False, robots=1):
    arrays = (np.asarray(values, float) for values in (time_s, arc_m, heading_rad))
    return driven_table(*arrays, np.array([1.0, -2.0]), repeat=repeat, step_s=STEP_S,
                        num_steps=num_steps, num_robots=robots)  # fmt: skip


def test_points_on_an_arc_give_the_arc():
    """Two points suffice: between them lies an arc, from wherever it starts."""
    arc, _ = table("arc", 6.0)
    made, offset = driven([0.0, 6.0], [0.0, 6.0], [0.5, 0.5 + 6.0 / 7.0], num_steps=2400, robots=3)
    assert offset.tolist() == [0, 0, 0]
    np.testing.assert_allclose(made.rows(), arc.rows(), rtol=1e-9)
    c, s = math.cos(0.5), math.sin(0.5)
    turned = arc.pose[:, :2] @ np.array([[c, s], [-s, c]]) + [1.0, -2.0]
    np.testing.assert_allclose(made.pose[:, :2], turned, atol=1e-9)
    np.testing.assert_allclose(made.pose[:, 2], 0.5 + arc.pose[:, 2], atol=1e-12)


def test_speed_between_points_is_that_of_the_points():
    """A standstill, 2 m/s, 0.5 m/s; the corners need not be ends of steps."""
    time_s, arc_m = [0.0, 0.101, 1.1, 2.0], [0.0, 0.0, 1.998, 2.448]
    made, _ = driven(time_s, arc_m, np.zeros(4), num_steps=800)
    ends = np.arange(801) * STEP_S
    np.testing.assert_allclose(made.pose[:, 0], 1.0 + np.interp(ends, time_s, arc_m), atol=1e-12)
    assert not made.speed_mps[:40].any()
    np.testing.assert_allclose(made.speed_mps[41:440], 2.0, rtol=1e-9)
    np.testing.assert_allclose(made.speed_mps[440:], 0.5, rtol=1e-9)
    assert made.speed_mps[40] == pytest.approx(2.0 * 0.0015 / 0.0025)


def test_a_path_starts_over_from_where_it_ends():
    """Half a circle, repeated, is a circle; robots are spread over the half."""
    made, offset = driven([0.0, 3.1], [0.0, 3.1], [0.0, math.pi], num_steps=2480, repeat=True,
                          robots=2)  # fmt: skip
    assert offset.tolist() == [0, 620]
    np.testing.assert_allclose(made.speed_mps, 1.0, rtol=1e-9)
    np.testing.assert_allclose(made.turn_rate_radps, math.pi / 3.1, rtol=1e-9)
    np.testing.assert_allclose(made.pose[2480, :2], [1.0, -2.0], atol=1e-9)
    with pytest.raises(ValueError, match=r"ends after 3.1 s, before 3.1025 s"):
        driven([0.0, 3.1], [0.0, 3.1], [0.0, math.pi], num_steps=1241)


def test_unknown_reference_is_named():
    with pytest.raises(ValueError, match=r"reference = 'spiral': must be one of straight, arc"):
        table("spiral", 1.0)


@pytest.mark.parametrize("pace", [1.0, 2.5])
@pytest.mark.parametrize("name", ["straight", "arc", "figure_eight", "zigzag", "file"])
def test_the_greatest_turn_rate_is_that_of_the_table(name, pace, smoke_scenario):
    points = (
        (0.0, 0.0, 0.0, 0.0),
        (1.0, 1.0, 0.1, 0.2),
        (1.5, 1.4, 0.3, 0.7),
        (3.0, 2.0, 0.9, 0.8),
    )
    robot = replace(smoke_scenario.robot, reference_points=points, reference_repeat=True)
    task = Task(reference=name, scale=0.5, pace=pace)
    made, _ = task_table(robot, task, 4000, 1)
    rate, keys = greatest_turn_rate(robot, task)
    assert rate == pytest.approx(np.abs(made.turn_rate_radps).max(), rel=1e-3)
    assert name == "straight" or set(keys) > {"reference_pace"}


def test_the_bound_of_reaches_holds_in_every_world(smoke_scenario):
    """Close to it where a turn is nearly the greatest and the duration nearly the least."""
    robot = replace(
        smoke_scenario.robot,
        **{"reference": "reach", "reach_duration_s": (0.05, 0.06), "reach_pause_s": (0.0, 0.0)},
        reference_pace=1.7,
    )
    scenario = replace(smoke_scenario, robot=robot)
    words = operator_words(Setup(scenario=scenario, num_envs=4, num_slots=800))
    draw_references(words, world_keys("check", 1, 4))
    rate, _ = greatest_turn_rate(robot, tasks_of(robot, scenario.users.num_urllc)[0])
    drawn = np.abs(words.path[:, 0]).max()
    assert 0.9 * rate < drawn <= rate * (1.0 + 1e-12)
