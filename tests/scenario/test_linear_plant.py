"""Robots that are linear plants: errors that name key, shape and property."""

from __future__ import annotations

import pytest
import yaml

from hiersched.scenario import ScenarioError, load_scenario, scenario_to_yaml

SECTION = {
    "A": [[1.0, 0.02], [0.0, 1.0]],
    "B": [[0.0002], [0.02]],
    "Q": [[1.0, 0.0], [0.0, 0.1]],
    "R": [[0.1]],
    "process_noise": [0.0, 0.01],
    "measurement_noise": [0.001, 0.001],
    "error_states": [0],
}


@pytest.fixture
def load_plant(load_text):
    def load(section=None, control=None, **others):
        data = {
            "control": control or {},
            "plant": {"model": "linear", **SECTION, **(section or {})},
            "sweeps": {"axes": {"sampling_s": None, "service_coefficient_mbps": None}},
            "gain_study": {"sampling_s": []},
            **others,
        }
        return load_text(yaml.safe_dump(data))

    return load


def test_sizes_follow_the_matrices(load_plant, load_text):
    scenario = load_plant()
    assert scenario.robot_sizes == (2, 1, 4)
    assert scenario.loop_kind == "network"
    assert load_text(scenario_to_yaml(scenario)) == scenario
    coupled = load_plant({"A_d": [[0.0, 0.0], [-0.01, 0.0]]}, {"method": "razumikhin"})
    assert coupled.loop_kind == "split"


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"A": None}, ["plant.A = None", "valid array"]),
        ({"A": [[1.0, 0.02], [0.0]]}, ["plant.A: rows of [1, 2] values"]),
        ({"A": [[1.0, 0.02]]}, ["plant.A has shape (1, 2)", "square"]),
        ({"B": [[0.02]]}, ["plant.B has shape (1, 1)", "(2, any)"]),
        ({"B": [[0.0], [0.0]]}, ["plant: (A, B) is not stabilisable"]),
        ({"Q": [[1.0, 0.0], [0.0, -1.0]]}, ["plant.Q", "positive semidefinite"]),
        ({"Q": [[1.0, 0.5], [0.0, 1.0]]}, ["plant.Q", "symmetric"]),
        ({"R": [[0.0]]}, ["plant.R", "positive definite"]),
        ({"R": [[1.0, 0.0], [0.0, 1.0]]}, ["plant.R has shape (2, 2)"]),
        ({"A_d": [[0.1]]}, ["plant.A_d has shape (1, 1)"]),
        ({"A": [[float("nan"), 0.0], [0.0, 1.0]]}, ["plant.A", "nan"]),
        ({"process_noise": [0.1]}, ["plant.process_noise = [0.1]: 1 values, must be 2"]),
        ({"measurement_noise": [0.1, -0.1]}, ["plant.measurement_noise.1 = -0.1"]),
        ({"input_limits": [1.0, 1.0]}, ["plant.input_limits", "2 values, must be 1"]),
        ({"error_states": [2]}, ["plant.error_states = [2]", "from 0 to 1"]),
        ({"error_states": [0, 0]}, ["plant.error_states = [0, 0]", "different"]),
        ({"C": [[1.0]]}, ["plant.C", "unknown key", "A, A_d, B"]),
    ],
)
def test_faulty_plants_are_refused(load_plant, section, words):
    with pytest.raises(ScenarioError) as caught:
        load_plant(section)
    for word in ["case.yaml", *words]:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"control": {"sampling_s": 0.025}}, ["control.sampling_s = 0.025", "radio.slot_s = 0.01"]),
        (
            {"sweeps": {"axes": {"sampling_s": {"vary": {"control.sampling_s": [0.02, 0.04]}}}}},
            ["sweeps.axes.sampling_s.vary.control.sampling_s = [0.02, 0.04]", "must be [0.02]"],
        ),
        (
            {"gain_study": {"sampling_s": [0.04]}},
            ["gain_study.sampling_s = [0.04]: must be [0.02] or none"],
        ),
        ({"control": {"method": "razumikhin"}}, ["'razumikhin'", "plant.A_d"]),
        (
            {"section": {"A_d": [[0.0, 0.0], [0.0, 0.0]]}, "control": {"method": "h2"}},
            ["'h2'", "without A_d"],
        ),
        ({"learning": {"observe_robots": True}}, ["learning.observe_robots = true", "linear"]),
    ],
)
def test_what_a_linear_plant_needs(load_plant, changes, words):
    with pytest.raises(ScenarioError) as caught:
        load_plant(**changes)
    for word in words:
        assert word in str(caught.value)


def test_the_example_is_stable_only_with_adjusted_gains(config):
    from hiersched.control import build_schedule, spectral_radius_by_delay
    from hiersched.simulator.loop_gains import plant_of

    scenario = load_scenario(config / "scenarios/linear_plant.yaml")
    plant, T = plant_of(scenario), scenario.max_delay_steps
    nominal = spectral_radius_by_delay(*plant.closed_loop(plant.nominal_gain), T)
    assert nominal[3] < 1 < nominal[4]
    schedule = build_schedule(plant, T)
    assert schedule.certified.all()
    assert schedule.status[-1] == "adjusted"
