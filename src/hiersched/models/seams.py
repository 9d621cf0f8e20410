"""The seams of a slot, in the order in which the loop comes to them.

A kernel here is `kernel(me, constants, state, slot, env)`: `simulator.setup.SlotConstants` and
`SlotState`, `simulator.record.SlotFields` of the slot, and the index of the world. Users come URLLC
first; U users, R robots (one a URLLC user), K PRBs. Whatever a model adds to the log its kernels
write into state.model_values[env] (`Model.log_fields`): slot is the slot in work of any world.
"""

from __future__ import annotations

from hiersched.core.seam import Seam

DRAW_FADING = Seam(
    "radio.fading",
    reads="state.key[env], state.slot[env]: the coming slot, 0 to setup.num_slots: the loop "
    "draws the channel of the next slot at the end of each",
    writes="state.fading_power[env] (U, K): squared amplitudes, float32",
)
MOVE_USERS = Seam(
    "radio.path_loss",
    reads="state.key[env], state.slot[env]; a path loss without such a kernel is drawn once",
    writes="state.snr[env] (U K): signal-to-noise ratio at unit fading power, each user's K times",
)
RATE_PRBS = Seam(
    "radio.link",
    reads="state.fading_power[env], state.snr[env]",
    writes="state.prb_rate_mbps[env] (U, K): what a PRB carries, float32",
)
REPORT = Seam(
    "radio.report",
    reads="state.prb_rate_mbps[env]",
    writes="state.reported_rate_mbps[env] (U, K): what policies are told, float32; without such a "
    "kernel it is the same memory as state.prb_rate_mbps",
)
DELIVER = Seam(
    "radio.link, delivery",
    reads="slot.prb_owner (K,), state.prb_rate_mbps[env], state.reported_rate_mbps[env]",
    writes="slot.rate_mbps (U,), slot.num_prb (U,): what arrives",
)
OFFER = Seam(
    "traffic.arrivals",
    reads="slot.arrival_uniform (U,): a uniform of the world for each user; slot.rate_mbps",
    writes="slot.arrivals_packets (U,), slot.arrival_clamped (U,): whether the mean was cut to 0",
)
SERVE = Seam(
    "traffic.queue",
    reads="slot.arrivals_packets, slot.service_packets (U,): offered; state.backlog_packets[env]",
    writes="state.backlog_packets[env], state.hol_delay_s[env] (U,) at the end of the slot; "
    "slot.delay_s, slot.due_packets, slot.late_packets, slot.superseded_packets (U,); where "
    "constants.tracks_age, state.held_step[env] (R, S): step of the world whose set-point is in "
    "force in each of the slot's steps",
)
DRIVE = Seam(
    "plant",
    reads="slot.delay_steps (R,): T_d in force; constants.loop: gains",
    writes="slot.robot_normal, state, reference, control, control_saturated, tracking_error_m, "
    "gain_delay_steps; state.robot_state[env] (R, N), state.gain_delay_steps[env] and, at the end "
    "of a window, state.dexterity_index[env] (R,)",
)
