"""The robots' part of a slot where they are linear plants; unicycles are in `simulator.loop`."""

from __future__ import annotations

import math

from hiersched.core.compiled import kernel
from hiersched.models.plant.dexterity import window_index
from hiersched.models.plant.linear import LinearConstants, sample_linear, square_error
from hiersched.models.plant.unicycle import RobotConstants, hold_entry
from hiersched.simulator.record import SlotFields
from hiersched.simulator.setup import SlotState


@kernel()
def drive_linear(
    robots: RobotConstants,
    linear: LinearConstants,
    state: SlotState,
    record: SlotFields,
    env: int,
) -> None:
    """Move all plants through the slot with the delays that stand in the record.

    A sample begins with a slot. The state is held until the next sample; the record has it after
    the slot, as for unicycles. The window's index has the tracking error alone: no heading and no
    curvature.
    """
    slot = state.slot[env]
    slots_per_sample = robots.steps_per_sample // robots.steps_per_slot
    slots_per_window = robots.steps_per_window // robots.steps_per_slot
    motion, common = state.linear, state.robots
    for robot in range(record.delay_steps.shape[0]):
        body = motion.state[env, robot]
        if slot % slots_per_sample == 0:
            delay = int(record.delay_steps[robot])
            entry = min(delay, robots.max_delay_steps)
            if robots.hold_samples > 0:
                entry = hold_entry(entry, robots.hold_samples, common.held[env, robot])
            record.control_saturated[robot] += sample_linear(
                robots,
                linear,
                slot // slots_per_sample,
                delay,
                entry,
                record.robot_normal[robot],
                common.history[env, robot],
                common.commands[env, robot],
                body,
                motion.coming[env, robot],
                motion.past[env, robot],
                motion.control[env, robot],
            )
            common.gain_delay_steps[env, robot] = robots.adjusted_delay_steps[entry]
        square = square_error(linear, body)
        motion.window_square[env, robot] += square
        if (slot + 1) % slots_per_sample == 0:
            for j in range(body.shape[0]):
                body[j] = motion.coming[env, robot, j]
        if (slot + 1) % slots_per_window == 0:
            common.dexterity_index[env, robot] = window_index(
                motion.window_square[env, robot], 0.0, 0.0, slots_per_window
            )
            motion.window_square[env, robot] = 0.0
        record.tracking_error_m[robot] = math.sqrt(square)
        record.gain_delay_steps[robot] = common.gain_delay_steps[env, robot]
        for j in range(body.shape[0]):
            record.state[robot, j] = body[j]
        for i in range(motion.control.shape[2]):
            record.control[robot, i] = motion.control[env, robot, i]
