"""Reference paths of the user: what is accepted, and errors that name file, row and column."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest

from hiersched.experiments import dependencies
from hiersched.experiments.points import experiments
from hiersched.scenario import ScenarioError, scenario_sha256, scenario_to_yaml

SHORT = """
evaluate: {warmup_s: 0.5, duration_s: 1.5, full_log_s: 1.0}
sweeps: {warmup_s: 0.0, duration_s: 2.0}
generalise: {warmup_s: 0.0, duration_s: 2.0}
gain_study: {num_windows: 2, violation_windows: [2]}
"""
FILE = SHORT + "robot: {reference: file, reference_file: track.csv}\n"


def rows(*changes, end_s=2.0, step_s=0.1):
    """A circle of radius 2 at 1 m/s, as text; changes are (row, column, value)."""
    lines = [["t", "x", "y", "theta"]]
    for i in range(round(end_s / step_s) + 1):
        angle = 0.5 * i * step_s
        values = (i * step_s, 2 * math.sin(angle), 2 - 2 * math.cos(angle), angle)
        lines.append([f"{value:.9g}" for value in values])
    for row, column, value in changes:
        lines[row - 1]["txyh".index(column)] = value
    return "\n".join(",".join(line) for line in lines) + "\n"


@pytest.fixture
def load_track(load_text):
    def load(track, overlay=FILE):
        load.path.write_text(track, encoding="utf-8")
        return load_text(overlay)

    load.path = load_text.path.parent / "track.csv"
    return load


def test_points_become_part_of_the_scenario(load_track, load_text):
    scenario = load_track(rows())
    points = np.array(scenario.robot.reference_points)
    assert points.shape == (21, 4)
    np.testing.assert_allclose(points[7], [0.7, 2 * math.sin(0.35), 2 - 2 * math.cos(0.35), 0.35])
    experiments(scenario)  # every point can run
    # A resolved scenario needs no file: that is what a log carries.
    load_track.path.unlink()
    assert load_text(scenario_to_yaml(scenario)) == scenario


def run_values(scenario, name, group="classical"):
    return dependencies.run_values(scenario, experiments(scenario)[name], group)


def test_another_path_is_another_scenario_and_runs_its_jobs_anew(load_track):
    one, other = load_track(rows()), load_track(rows((5, "x", "0.2988")))
    assert scenario_sha256(one) != scenario_sha256(other)
    for values in (
        partial(dependencies.train_values, learner="ddpg"),
        partial(run_values, name="gain_study", group="gains"),
        partial(run_values, name="evaluate"),
    ):
        assert values(one) != values(other)
    # The gains are designed for robot.speed_mps, whatever the path.
    assert dependencies.gains_values(one, "schedule") == dependencies.gains_values(
        other, "schedule"
    )


@pytest.mark.parametrize("turn", [2 * math.pi, -2 * math.pi])
def test_headings_are_unwrapped(load_track, turn):
    scenario = load_track(rows((9, "h", repr(0.35 + turn))))
    assert scenario.robot.reference_points[7][3] == 0.35 + turn


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([(1, "h", "heading")], ["row 1", "'t,x,y,heading'", "must be 't,x,y,theta'"]),
        ([(4, "x", "0.3,1")], ["row 4", "5 values, must be 4"]),
        ([(4, "y", "left")], ["row 4, column y: 'left'", "finite number"]),
        ([(4, "y", "nan")], ["row 4, column y: 'nan'", "finite number"]),
        ([(4, "x", "")], ["row 4, column x: ''", "finite number"]),
        ([(2, "t", "0.05")], ["row 2, column t: 0.05", "first time must be 0"]),
        ([(6, "t", "0.3")], ["row 6, column t: 0.3: must be greater than 0.3 of the row above"]),
        ([(6, "t", "0.2")], ["row 6, column t: 0.2: must be greater than 0.3"]),
        ([(8, "h", "2.0")], ["row 8, column theta: 2: turns by 1.75 rad", "at most 1.5708"]),
        ([(8, "h", "0.5")], ["row 8, columns x, y", "m sideways", "at most 0.00", "unicycle"]),
        ([(8, "x", "-0.5"), (8, "y", "-0.1")], ["row 8, columns x, y", "sideways"]),
        ([(9, "t", "0.61")], ["row 9: 10 m/s from the row above, must be at most 3 m/s"]),
    ],
)
def test_what_no_unicycle_drives_is_refused(load_track, changes, words):
    with pytest.raises(ScenarioError) as caught:
        load_track(rows(*changes))
    for word in ["case.yaml", "robot.reference_file", "track.csv", *words]:
        assert word in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def line(*points):
    return "t,x,y,theta\n" + "".join(f"{t},{x},{y},{theta}\n" for t, x, y, theta in points)


@pytest.mark.parametrize(
    ("track", "words"),
    [
        ("", ["row 1: ''"]),
        ("t,x,y,theta\n", ["0 rows below the header, must be 2 or more"]),
        (line((0, 0, 0, 0), (1, -0.5, 0, 0), (2, 0, 0, 0)), ["row 3", "0.5 m backwards"]),
        # Each step is within its sideways tolerance; all of them to the same side are not.
        (
            line(*((0.1 * i, 0.1 * i, 0.0055 * i, 0.0) for i in range(31))),
            ["row 14, columns x, y: 1.2, 0.066", "ends 0.066 m away, must be at most 0.062 m"],
        ),
    ],
)
def test_other_faulty_files(load_track, track, words):
    with pytest.raises(ScenarioError) as caught:
        load_track(track)
    for word in ["track.csv", *words]:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("overlay", "word"),
    [
        (SHORT + "robot: {reference: file}\n", "needs robot.reference_file"),
        (SHORT + "robot: {reference_file: track.csv}\n", "needs robot.reference: file"),
        (FILE.replace("track", "lost"), "lost.csv: cannot be read"),
        (
            FILE.replace("duration_s: 1.5", "duration_s: 2", 1),
            r"ends after 2 s, but evaluate.warmup_s \+ evaluate.duration_s asks for 2.5 s",
        ),
        (FILE + "learning: {slots_per_episode: 300}\n", "learning.slots_per_episode asks for 3 s"),
        (FILE.replace("num_windows: 2", "num_windows: 3"), "gain_study.num_windows asks for 3 s"),
        (
            FILE.replace("generalise: {warmup_s: 0.0, duration_s: 2.0}\n", ""),
            r"generalise.warmup_s \+ generalise.duration_s asks for 10 s",
        ),
        (
            "sweeps: {duration_s: 8.0, axes: {robot.reference: [arc, file]}}\n"
            "robot: {reference_file: track.csv}",
            r"with robot.reference = 'file': robot.reference_file = track.csv: ends after 2 s, "
            r"but sweeps.warmup_s \+ sweeps.duration_s asks for 13 s",
        ),
    ],
)
def test_file_and_scenario_have_to_fit(load_track, overlay, word):
    with pytest.raises(ScenarioError, match=word):
        experiments(load_track(rows(), overlay))


def test_a_path_is_as_long_as_the_parts_that_follow_it(load_track):
    """Those that are left out need none, and a point of a sweep needs that of the sweep alone."""
    parts = "generalise: {cells: []}\ngain_study: {methods: []}\n"
    path = "robot: {reference: file, reference_file: track.csv}\n"
    durations = SHORT.splitlines()[1:3]
    load_track(rows(), "\n".join((*durations, parts, path)))
    swept = "sweeps: {warmup_s: 0.0, duration_s: 2.0, axes: {robot.reference: [arc, file]}}\n"
    scenario = load_track(rows(), swept + "robot: {reference_file: track.csv}\n")
    arc, file = experiments(scenario)["robot.reference"].points
    assert (arc.scenario.robot.reference, file.scenario.robot.reference) == ("arc", "file")


def test_a_path_that_repeats_is_long_enough(load_track):
    scenario = load_track(
        rows(), "robot: {reference: file, reference_file: track.csv, reference_repeat: true}"
    )
    assert scenario.evaluate.duration_s > 2.0
