"""Commands that cross the network: with their time of execution, or for the samples to come.

The operator's side knows measurements that are the core latency old, with what the robot applied
until then. What it sends waits in the queue. `playout`: every command carries the sample at which
the robot executes it, so that the delay stays the same unless it comes too late. `packetised`: a
packet carries commands for its own and the next samples, and the robot plays those of the newest
that has come. What it plays until the packet comes is in the packet as well: the controller expects
packets to be as old as the robot last said. A robot without a command in time holds the last one
for a while, then asks for no correction.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import inner_kernel
from hiersched.core.numerics import copy
from hiersched.models.plant.estimator import advance, regulate

LINKS = ("measurements", "playout", "packetised")
MEASUREMENTS, PLAYOUT, PACKETISED = range(3)

LINK_FIELDS = {"late_commands": "commands", "command_gap": "input"}
"""What a link of commands adds to the log, name -> unit: a number a robot.

Samples of the slot at which no command was in time; the norm of the difference between what the
controller took for applied at the last sample and what was.
"""


class LinkConstants(NamedTuple):
    """How commands come to robots, of m inputs."""

    kind: int  # code in `LINKS`
    latency_steps: int  # age of what the controller knows
    playout_steps: int  # from a command to its execution
    horizon: int  # samples for which a packet has commands, behind its own: H
    hold_steps: int  # samples without a command in time for which the last one is held
    first_value: int  # of `LINK_FIELDS` in `state.model_values[env]`


class LinkMemory(NamedTuple):
    """What the links of E worlds of R robots remember; empty where measurements cross."""

    assumed: NDArray[np.float64]  # (E, R, places, m) inputs that the controller takes for applied
    packets: NDArray[np.float64]  # (E, R, places, H + 1, m) ring of the newest: commands by age
    newest: NDArray[np.int64]  # (E, R) packets up to the newest that has come
    age: NDArray[np.int64]  # (E, R, samples + 1) samples, of the packet that was played
    ahead: NDArray[np.int64]  # (E, R) samples from now to the first command of the newest packet
    missing: NDArray[np.int64]  # (E, R) samples without a command in time, one after the other
    late: NDArray[np.int64]  # (E, R) of the slot


NO_LINK = LinkConstants(MEASUREMENTS, 0, 0, 0, 0, 0)
"""Of a loop whose measurements cross."""


def link_memory(
    of_robot: tuple[int, int],
    samples: int,
    inputs: int,
    playout_steps: int,
    horizon: int,
    latency_steps: int,
) -> LinkMemory:
    """Return the memory of links; a horizon of 0 is that of no packets.

    Packets are kept for as long as the controller asks what the robot played of them.
    """
    places = samples + 1 if playout_steps or horizon else 0
    ring = horizon + 1 + latency_steps if horizon else 0
    return LinkMemory(
        assumed=np.zeros((*of_robot, places + max(playout_steps, horizon), inputs)),
        packets=np.zeros((*of_robot, ring, horizon + 1, inputs)),
        newest=np.zeros(of_robot, np.int64),
        age=np.zeros((*of_robot, places), np.int64),
        ahead=np.zeros(of_robot, np.int64),
        missing=np.zeros(of_robot, np.int64),
        late=np.zeros(of_robot, np.int64),
    )


@inner_kernel()
def assume_inputs(loop: Any, memory: Any, sample: int, env: int, robot: int) -> None:
    """Say what a controller takes for applied since its newest measurement: `link.assumed`.

    With a time of execution that is what was planned, and stands there already. Where the packet
    that the robot played grew older at the last sample that it acknowledged, it is taken to go on
    with that, else with packets as old; the coming one is expected when it is as old as the
    youngest of the last H. Without a command for its age the robot is taken to go on as it did.
    """
    link, own = loop.link, memory.link
    own.ahead[env, robot] = link.playout_steps
    if link.kind != PACKETISED:
        return
    first = max(sample - link.latency_steps, 0)
    age = before = np.int64(0)
    if first > 0:
        age = own.age[env, robot, first - 1]
    if first > 1:
        before = own.age[env, robot, first - 2]
    grows = np.int64(1) if age > before else np.int64(0)
    youngest = age
    for known in range(max(first - 1 - link.horizon, 0), first):
        youngest = min(youngest, own.age[env, robot, known])
    own.ahead[env, robot] = youngest if youngest <= link.horizon else 0
    for stamp in range(first, sample + own.ahead[env, robot]):
        assumed = own.assumed[env, robot, stamp]
        played = age + grows * (stamp - first + 1)
        made = stamp - played
        if made < 0:
            for i in range(assumed.shape[0]):
                assumed[i] = 0.0
        elif played <= link.horizon:
            copy(own.packets[env, robot, made % own.packets.shape[2], played], assumed)
        else:
            copy(memory.commands[env, robot, first - 1], assumed)


@inner_kernel()
def send_commands(
    loop: Any, memory: Any, limits: NDArray[np.float64], sample: int, env: int, robot: int
) -> None:
    """Form the packet of a sample from what the filter predicts, within the limits (m,)."""
    link, own, me = loop.link, memory.link, memory.filter
    predicted, ahead = me.predicted[env, robot], own.ahead[env, robot]
    if link.kind == PLAYOUT:
        _regulate(loop, predicted, limits, own.assumed[env, robot, sample + ahead], robot)
        return
    packet = own.packets[env, robot, sample % own.packets.shape[2]]
    for age in range(ahead):
        copy(own.assumed[env, robot, sample + age], packet[age])
    copy(predicted, me.planned)
    for age in range(ahead, link.horizon + 1):
        _regulate(loop, me.planned, limits, packet[age], robot)
        advance(loop, me, me.planned, packet[age], sample, env, robot)


@inner_kernel()
def _regulate(
    loop: Any,
    state: NDArray[np.float64],
    limits: NDArray[np.float64],
    out: NDArray[np.float64],
    robot: int,
) -> None:
    """Write -K x, cut to the limits (m,)."""
    regulate(loop.filter.regulator[loop.kind[robot]], state, out)
    for i in range(limits.shape[0]):
        out[i] = min(max(out[i], -limits[i]), limits[i])


@inner_kernel()
def play_command(
    loop: Any, memory: Any, sample: int, delay_steps: int, env: int, robot: int
) -> None:
    """Set the inputs of a robot by the packets that have come: `memory.control`.

    Of the delay from measurement to input the core latency is that of the measurement.
    """
    link, own = loop.link, memory.link
    control = memory.control[env, robot]
    come = sample - max(delay_steps - link.latency_steps, 0)
    own.newest[env, robot] = max(own.newest[env, robot], come + 1)
    newest = own.newest[env, robot] - 1
    own.age[env, robot, sample] = sample - newest
    if link.kind == PLAYOUT:
        made = sample - link.playout_steps
        in_time = 0 <= made <= newest
        if in_time:
            copy(own.assumed[env, robot, sample], control)
    else:
        in_time = newest >= 0 and sample - newest <= link.horizon
        if in_time:
            packet = own.packets[env, robot, newest % own.packets.shape[2]]
            copy(packet[sample - newest], control)
    if in_time:
        own.missing[env, robot] = 0
        return
    if sample >= link.playout_steps + link.latency_steps:  # before, none has been sent
        own.late[env, robot] += 1
    own.missing[env, robot] += 1
    if own.missing[env, robot] > link.hold_steps:
        for i in range(control.shape[0]):
            control[i] = 0.0


@inner_kernel()
def note_link(
    loop: Any, memory: Any, values: NDArray[np.float64], sample: int, env: int, robot: int
) -> None:
    """Write what `LINK_FIELDS` names into a world's `values`; counts of late commands start anew.

    What was taken for applied at a sample is known when the next one has been planned: the gap is
    of the sample before the last.
    """
    own = memory.link
    num_robots, place = own.newest.shape[1], loop.link.first_value + robot
    values[place] = own.late[env, robot]
    own.late[env, robot] = 0
    before = sample - 1
    if before < 0 or (loop.link.kind == PACKETISED and loop.link.latency_steps == 0):
        return  # all is acknowledged
    square = 0.0
    for i in range(own.assumed.shape[3]):
        gap = own.assumed[env, robot, before, i] - memory.commands[env, robot, before, i]
        square += gap * gap
    values[place + num_robots] = np.sqrt(square)
