from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hiersched.runs.gain_points import GAIN_SWEEPS, gain_points
from hiersched.runs.variants import (
    SWEPT_KEYS,
    baseline_method,
    check_variants,
    design_of,
    gain_designs,
    group_policies,
    learner_scenario,
    policy_groups,
    study_scenario,
    swept_scenario,
    swept_values,
    value_text,
    weighted_scenario,
)

from hiersched.runs import paths
from hiersched.scenario import (
    Scenario,
    ScenarioError,
    load_resolved,
    scenario_to_dict,
    scenario_to_yaml,
)
from hiersched.scenario.schema import Control, GainMethod


@pytest.mark.parametrize(
    ("value", "text"), [(0.005, "0.005"), (1.0, "1"), (0.1 + 0.2, "0.3"), ("zigzag", "zigzag")]
)
def test_value_text(value: float | str, text: str) -> None:
    assert value_text(value) == text


@pytest.mark.parametrize("axis", list(SWEPT_KEYS))
def test_a_sweep_changes_one_key(tiny: Scenario, axis: str) -> None:
    value = swept_values(tiny, axis)[-1]
    expected = scenario_to_dict(tiny)
    if axis == "load_ratio":  # eMBB over URLLC, 22 over 25 in the scenario: 1.5, and 47 together
        traffic = expected["traffic"]
        traffic["embb_offered_mbps"] = pytest.approx(28.2)
        traffic["urllc_offered_mbps"] = pytest.approx([18.8 * 20 / 25, 18.8 * 30 / 25])
    elif axis == "service_coefficient_mbps":  # the last: at the longest sampling interval
        assert value == "beta2_h0.04"
        expected["traffic"]["service_coefficient_mbps"] = 2.0
        expected["control"]["sampling_s"] = 0.04
    else:
        *sections, key = SWEPT_KEYS[axis].split(".")
        part = expected
        for section in sections:
            part = part[section]
        part[key] = value
    assert scenario_to_dict(swept_scenario(tiny, axis, value)) == expected


def test_unknown_axis(tiny: Scenario) -> None:
    with pytest.raises(ValueError, match="axis = 'speed': must be one of rayleigh_scale"):
        swept_values(tiny, "speed")


def test_a_swept_value_must_fit(tiny: Scenario) -> None:
    """0.03 s is a multiple of the substep, as the scenario asks, but does not divide a window."""
    scenario = replace(tiny, sweeps=replace(tiny.sweeps, sampling_s=(0.02, 0.03)))
    with pytest.raises(
        ScenarioError, match=r"sweeps.sampling_s = 0.03: robot.window_s = 1.0: must be"
    ):
        check_variants(scenario)
    check_variants(tiny)


def test_designs(tiny: Scenario) -> None:
    others = ("0.04", "razumikhin", "predictor", "q900")
    assert list(gain_designs(tiny)) == ["schedule", *(f"schedule_{name}" for name in others)]
    assert design_of(tiny, weighted_scenario(tiny, 900.0)) == "schedule_q900"
    assert design_of(tiny, swept_scenario(tiny, "sampling_s", 0.02)) == "schedule"
    assert design_of(tiny, swept_scenario(tiny, "sampling_s", 0.04)) == "schedule_0.04"
    assert design_of(tiny, study_scenario(tiny, "krasovskii", "nominal")) == "schedule"
    assert design_of(tiny, study_scenario(tiny, "razumikhin", "adjusted")) == "schedule_razumikhin"
    with pytest.raises(ValueError, match="no gain schedule"):
        design_of(tiny, replace(tiny, control=replace(tiny.control, weight=1.0)))


def test_predictors_are_not_held_and_what_replaces_one_is(tiny: Scenario) -> None:
    def hold(control: Control, method: GainMethod) -> int:
        return study_scenario(
            replace(tiny, control=control), method, "adjusted"
        ).control.hold_samples

    own, predictor = tiny.control, replace(tiny.control, method="predictor", hold_samples=0)
    assert hold(replace(own, hold_samples=3), "predictor") == 0
    assert hold(replace(own, hold_samples=3), "razumikhin") == 3
    assert hold(replace(own, hold_samples=0), "razumikhin") == 0
    assert hold(predictor, "predictor") == 0
    assert hold(predictor, "krasovskii") == 5


def test_groups(tiny: Scenario) -> None:
    two = replace(tiny, learners={"flat": replace(tiny.learning, network="mlp")})
    policies = ("pf", "flat", "ddpg", "edf")
    assert policy_groups(two) == ("classical", "ddpg", "flat")
    assert group_policies(two, policies, "classical") == ("pf", "edf")
    assert group_policies(two, policies, "ddpg") == ("ddpg",)
    assert group_policies(two, policies, "flat") == ("flat",)


def test_no_two_logs_share_a_path(tiny: Scenario) -> None:
    names = [
        *paths.training_logs(tiny, "ddpg"),
        *paths.policy_files(tiny, "ddpg"),
        *paths.gain_study_logs(tiny),
        *paths.all_gain_files(tiny),
        *(
            name
            for group in ("classical", "ddpg")
            for name in paths.evaluation_outputs(tiny, group)
        ),
        *(
            name
            for axis in SWEPT_KEYS
            for group in ("classical", "ddpg")
            for name in paths.sweep_outputs(tiny, axis, group)
        ),
    ]
    names += [name for axis in GAIN_SWEEPS for name in paths.gain_sweep_logs(tiny, axis)]
    gain_logs = 5 * 2 + (4 + 2 + 1) * 2 * 2
    assert len(set(names)) == len(names) == 2 + 2 + gain_logs + 5 + 10 + 13 + 9 + (1 + 2) * 2


def test_methods_on_one_plant_share_the_runs_with_the_nominal_gain(tiny: Scenario) -> None:
    logs = paths.gain_study_logs(tiny)
    assert "gain_study/predictor_adjusted_seed31.mcap" in logs
    assert not [name for name in logs if "predictor_nominal" in name]
    assert baseline_method(tiny, "predictor") == "krasovskii"
    assert baseline_method(tiny, "razumikhin") == "razumikhin"


def test_points_of_the_gain_sweeps(tiny: Scenario) -> None:
    grid = gain_points(tiny, "grid")
    assert [point.value for point in grid] == ["q700_0.02", "q700_0.04", "q900_0.02", "q900_0.04"]
    assert grid[2].violation_delay_s == (0.02, 0.02)
    assert grid[2].scenario == weighted_scenario(tiny, 900.0)
    (noise,) = gain_points(tiny, "noise")
    robot = replace(tiny.robot, noise_position_m=0.0, noise_heading_rad=0.01)
    assert noise.scenario == replace(tiny, robot=robot)
    variant = noise.variant("nominal")
    assert (variant.users.num_urllc, variant.control.gain) == (2, "nominal")
    with pytest.raises(ValueError, match="axis = 'load': must be one of grid, sampling_s, noise"):
        gain_points(tiny, "load")


def test_a_learner_trains_in_a_scenario_of_its_own(tiny: Scenario) -> None:
    """Nothing of the others is left in it, and it can be read back from a log."""
    flat = replace(tiny.learning, network="mlp", seeds=(7, 8))
    named = replace(tiny.evaluate, policies=("ddpg", "flat", "pf", "slow"))
    slow = replace(tiny.learning, actor_lr=1e-5)
    two = replace(tiny, learners={"flat": flat, "slow": slow}, evaluate=named)
    own = learner_scenario(two, "flat")
    assert (own.learning, own.learners) == (flat, {})
    assert own.evaluate.policies == ("ddpg", "pf")
    faster = replace(two, learners={"flat": flat, "slow": tiny.learning})
    assert learner_scenario(faster, "flat") == own
    assert load_resolved(scenario_to_yaml(own), Path("log"))[0] == own
    assert paths.training_logs(two, "flat") == ["train/flat/seed7.mcap", "train/flat/seed8.mcap"]
    with pytest.raises(ValueError, match="'fast': must be one of ddpg, flat, slow"):
        learner_scenario(two, "fast")
