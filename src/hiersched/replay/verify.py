"""Computes a log again, slot by slot, compares every bit, and writes all that it left out."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.experiments.events import slot_events
from hiersched.experiments.logged import TOPIC_OF, Batch, LoggedRun, needed_field
from hiersched.experiments.logging import log_dims, logged_fields
from hiersched.experiments.points import logged_delays
from hiersched.log import LogReader, LogWriter
from hiersched.log.schema import MODELS_TOPIC
from hiersched.models.model import model_fields
from hiersched.policies.find import find_policy, is_rule
from hiersched.policies.policy import LoggedDecisions, LoggedWeights
from hiersched.simulator import Simulator, SlotRecord
from hiersched.simulator.simulator import AnyPolicy

Fields = dict[str, NDArray[Any]]
OnSlots = Callable[[Batch, SlotRecord], None]
_EVENT_FIELDS = ("hol_delay_s", "delay_capped", "delay_steps", "control_saturated")


@dataclass(frozen=True)
class Difference:
    """The first place at which a log is not what the simulator computes, and both values.

    ``field`` has the index of the element, as ``state[3,0]``, and in ``/models`` the name that its
    model gave it, as ``radio.fading/coherence[3]``.
    """

    slot: int
    topic: str
    field: str
    logged: Any
    computed: Any

    def __str__(self) -> str:
        return (
            f"slot {self.slot}, topic {self.topic}, field {self.field}: "
            f"{self.logged!r} in the log, {self.computed!r} computed"
        )


def verify(run: LoggedRun, on_slots: OnSlots | None = None) -> Difference | None:
    """Compute every slot of a log again and compare it bit for bit.

    The world and the forced delays of a gain study come from the seed and have to be the logged
    ones. Classical schedulers decide again; the decisions of learned policies are taken from the
    log, and all that follows from them is computed. So are those of policies in Python and in
    files, which are not opened. Decisions are weights and multipliers, so that who gets which PRB
    already follows; where the log does not have the weights, the owners are.
    Whether a learned policy's weights are its own, `rerun` says. Fields that the log does not have
    are not compared, nor are `run.unknown_fields`.

    `on_slots` is given a batch that has been compared and what it holds, all fields of the `full`
    profile with leading axes (E, T): weights that the log does not have are NaN. Returns the first
    slot that differs and, within it, the first field in the order of the table.

    Raises
    ------
    LogError
        If the log is damaged, or does not say what was decided.
    ValueError
        If its decisions are none that the simulator takes.
    """
    start: tuple[Simulator, NDArray[np.float64]] | None = None
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in _EVENT_FIELDS}
    with LogReader(run.path, verify="chunks") as log:
        for batch in run.batches():
            logged = _read(log, batch)
            if batch.begins:
                start = _start(run, batch, logged)
            assert start is not None  # the first batch begins
            record = _compute(*start, run, batch, logged)
            if (found := _first_difference(run, batch, logged, record)) is not None:
                return found
            for name in _EVENT_FIELDS:
                values = getattr(record, name)
                parts[name].append(values.reshape(-1, *values.shape[2:]).copy())
            if on_slots is not None:
                on_slots(batch, record)
        return _event_difference(run, log, {k: np.concatenate(v) for k, v in parts.items()})


def _read(log: LogReader, batch: Batch) -> Fields:
    """All known fields of a batch, leading axes (E, T)."""
    fields: Fields = {}
    for topic in log.topics:
        fields |= log.read(topic, log.known_fields(topic), batch.first_slot, batch.stop_slot)
    del fields["slot"]
    lead = batch.num_envs, batch.num_slots
    return {name: values.reshape(*lead, *values.shape[1:]) for name, values in fields.items()}


def _compute(
    simulator: Simulator,
    multipliers: NDArray[np.float64],
    run: LoggedRun,
    batch: Batch,
    logged: Fields,
) -> SlotRecord:
    """Compute a batch from its decisions."""
    if run.stage == "gain_study":
        forced = logged_delays(run.scenario, run.metadata)
        delays = forced.draw(run.scenario, run.keys, batch.stop_slot)
        return simulator.run_robots(delays[:, batch.first_slot :])
    record = simulator.new_record(batch.num_slots)
    policy = _decider(run, logged)
    simulator.run(policy, multipliers=multipliers, record=record)
    if isinstance(policy, LoggedDecisions):
        # Weights did not decide: they are what the log has of them.
        record.weight[...] = logged.get("weight", np.nan)
    return record


def decides_again(run: LoggedRun) -> bool:
    """Whether replay lets the run's policy decide again, or takes the decisions of the log."""
    if run.stage == "gain_study":
        return True  # there is nothing to decide
    return is_rule(run.scenario, run.policy)


def _decider(run: LoggedRun, logged: Fields) -> AnyPolicy:
    """Return what decides again: a rule, or the decisions of the log."""
    if decides_again(run):
        return find_policy(run.scenario, run.policy)
    if "start" not in run.metadata or np.isnan(logged.get("weight", np.nan)).any():
        return LoggedDecisions(needed_field(run, logged, "prb_owner"))
    start, weighs = run.metadata["start"], run.metadata.get("weighs", "utility")  # unless it says
    return LoggedWeights(logged["weight"].astype(np.float64), start, weighs)


def _start(run: LoggedRun, batch: Batch, logged: Fields) -> tuple[Simulator, NDArray[np.float64]]:
    """Episodes that begin, and their multipliers (E, R), which keep their first values."""
    keys = run.keys[batch.first_env : batch.first_env + batch.num_envs]
    multipliers = np.zeros((len(keys), run.scenario.users.num_urllc))
    if "multiplier" in logged or not decides_again(run):  # rules have none
        multipliers[:] = needed_field(run, logged, "multiplier")[:, 0]
    return Simulator(run.scenario, run.gains, keys, run.episode_slots), multipliers


def _first_difference(
    run: LoggedRun, batch: Batch, logged: Fields, record: SlotRecord
) -> Difference | None:
    """Compare a batch; the earliest slot wins, then the order of the topics."""
    computed = logged_fields(logged, run.scenario, record._asdict())
    found: tuple[int, str] | None = None
    for name in TOPIC_OF:
        if name in logged:
            differs = _bits(logged[name]) != _bits(computed[name])
            rows = np.flatnonzero(differs.reshape(batch.num_envs * batch.num_slots, -1).any(axis=1))
            if len(rows) and (found is None or rows[0] < found[0]):
                found = int(rows[0]), name
    if found is None:
        return None
    row, name = found
    env, slot = divmod(row, batch.num_slots)
    a, b = logged[name][env, slot], computed[name][env, slot]
    place = tuple(np.argwhere(_bits(a) != _bits(b))[0].tolist())
    return Difference(
        slot=batch.first_slot + row,
        topic=TOPIC_OF[name],
        field=_element(run, name, place),
        logged=a[place].item(),
        computed=b[place].item(),
    )


def _element(run: LoggedRun, name: str, place: tuple[int, ...]) -> str:
    """Name an element: ``state[3,0]``, ``radio.fading/coherence[3]``."""
    if TOPIC_OF[name] == MODELS_TOPIC:
        for field in model_fields(run.scenario):
            if field.start <= place[0] < field.start + field.count:
                return f"{field.name}[{place[0] - field.start}]"
    return name + (f"[{','.join(map(str, place))}]" if place else "")


def _bits(values: NDArray[Any]) -> NDArray[Any]:
    """View numbers as integers: NaNs and signed zeros are compared by their bits."""
    return np.asarray(values).view(f"u{values.itemsize}")


def _event_difference(run: LoggedRun, log: LogReader, fields: Fields) -> Difference | None:
    """Compare the events with those that follow from the slots, of which `fields` are (T, ...)."""
    computed = []
    for first in range(0, run.num_slots, run.episode_slots):
        episode = {k: v[first : first + run.episode_slots] for k, v in fields.items()}
        computed += slot_events(run.scenario, run.schedule, episode, first)
    logged = log.events()
    for a, b in zip(logged, computed, strict=False):
        for name, own, other in zip(a._fields, a, b, strict=True):
            if own != other:
                return Difference(min(a.slot, b.slot), "/events", name, own, other)
    if len(logged) != len(computed):
        longer = max(logged, computed, key=len)
        slot = longer[min(len(logged), len(computed))].slot
        return Difference(slot, "/events", "number", len(logged), len(computed))
    return None


def expand(run: LoggedRun, out: str | os.PathLike[str]) -> Difference | None:
    """Verify a log and write the same run in the profile ``full`` to `out`.

    Metadata and attachments stay as they are; of a full log this is a copy with the same digest.
    Weights that the log does not have are NaN in the new one, which has the schema of this version
    and so not the log's `unknown_fields`. Returns and raises as `verify`: there is no new log then.

    Raises
    ------
    FileExistsError
        If `out` exists.
    """
    path = Path(out)
    part = path.with_name(path.name + ".part")
    for taken in (path, part):
        if taken.exists():
            raise FileExistsError(f"{taken}: exists; expanding a log never overwrites a file")
    path.parent.mkdir(parents=True, exist_ok=True)
    scenario = run.scenario
    own = ("profile", "schema_version")
    writer = LogWriter(
        path,
        log_dims(scenario),
        "full",
        {key: text for key, text in run.metadata.items() if key not in own},
        run.attachments,
        slot_ns=round(scenario.radio.slot_s * 1e9),
        compression=scenario.log.compression,
        chunk_bytes=scenario.log.chunk_bytes,
    )

    def write(batch: Batch, record: SlotRecord) -> None:
        count = batch.num_envs * batch.num_slots
        fields = {
            name: np.ascontiguousarray(values).reshape(count, *values.shape[2:])
            for name, values in record._asdict().items()
        }
        writer.write_block(batch.first_slot, fields)

    try:
        difference = verify(run, write)
        if difference is None:
            with LogReader(run.path, verify="chunks") as log:
                for event in log.events():  # those that were computed, too
                    writer.event(*event)
            writer.close()
        return difference
    finally:
        writer.abort()  # nothing to do where it is closed
        part.unlink(missing_ok=True)
