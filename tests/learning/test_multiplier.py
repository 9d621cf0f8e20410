from __future__ import annotations

from dataclasses import replace

import numpy as np

from hiersched.learning.multiplier import Multiplier, episode_constraint, step_multiplier


def test_two_steps_by_hand(scenario):
    objective = replace(
        scenario.objective,
        multiplier_step=10.0,
        multiplier_proportional=4.0,
        multiplier_max=20.0,
    )
    first = step_multiplier(Multiplier.zero((3,)), np.array([-0.5, 0.05, -3.0]), objective)
    np.testing.assert_allclose(first.integral, [5.0, 0.0, 20.0])
    np.testing.assert_allclose(first.value, [7.0, 0.0, 20.0])
    second = step_multiplier(first, np.array([0.1, -0.05, 0.1]), objective)
    # The third did not wind up: it leaves the cap at once.
    np.testing.assert_allclose(second.integral, [4.0, 0.5, 19.0])
    np.testing.assert_allclose(second.value, [3.6, 0.7, 18.6])


def test_the_measured_constraint_is_each_users_the_surrogate_the_mean(scenario):
    due, late = np.array([[100.0, 50.0, 0.0]]), np.array([[10.0, 0.0, 0.0]])
    surrogate = np.array([[0.02, -0.08, 0.0]])
    measured = episode_constraint(
        replace(scenario.objective, constraint="measured"), 0.95, due, late, surrogate
    )
    np.testing.assert_allclose(measured, [[-0.05, 0.05, 0.05]])
    mean = episode_constraint(
        replace(scenario.objective, constraint="surrogate"), 0.95, due, late, surrogate
    )
    np.testing.assert_allclose(mean, np.full((1, 3), -0.02))
