"""Opens the log of a run and fills it: the same metadata, attachments and events in every stage."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hiersched.control import GainSchedule
from hiersched.core.fields import fields_to_text
from hiersched.experiments.events import slot_events
from hiersched.log import LogDims, LogWriter
from hiersched.log.schema import MODEL_FIELDS
from hiersched.models.model import model_fields, num_model_values
from hiersched.scenario import Scenario, scenario_sha256, scenario_to_yaml

if TYPE_CHECKING:
    from hiersched.experiments.worlds import WorldRun


@dataclass(frozen=True, kw_only=True)
class RunLabel:
    """What a run is: one of `logged.STAGES`, policy, seed, the point of a sweep."""

    stage: str
    policy: str
    seed: int
    axis: str = ""
    value: str = ""

    def metadata(self) -> dict[str, str]:
        """Return what a log says of it."""
        return {name: str(value) for name, value in vars(self).items()}


def open_log(
    path: Path,
    scenario: Scenario,
    schedule: GainSchedule,
    label: RunLabel,
    *,
    profile: str,
    metadata: Mapping[str, str] | None = None,
    attachments: Mapping[str, bytes] | None = None,
) -> LogWriter:
    """Open the log of one run; its folder is created.

    `scenario` has swept values in place. `label` goes into the metadata; further `metadata` and
    `attachments` are such as the weights of a policy.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    sha256, files = _attached(scenario, schedule)
    text = {
        "scenario": scenario.name,
        "scenario_sha256": sha256,
        **label.metadata(),
        "gain": scenario.control.gain,
        **(metadata or {}),
    }
    if fields := model_fields(scenario):
        text[MODEL_FIELDS] = fields_to_text(fields)
    return LogWriter(
        path,
        log_dims(scenario),
        profile,
        text,
        {**files, **(attachments or {})},
        slot_ns=round(scenario.radio.slot_s * 1e9),
        compression=scenario.log.compression,
        chunk_bytes=scenario.log.chunk_bytes,
    )


_last_attached: list[tuple[Scenario, GainSchedule, str, dict[str, bytes]]] = []


def _attached(scenario: Scenario, schedule: GainSchedule) -> tuple[str, dict[str, bytes]]:
    """Return the scenario's hash and the files of every log of a scenario and a schedule.

    They are written once for logs in a row that share these very objects: it takes longer than to
    simulate the 1400 slots of an evaluation and to log them.
    """
    if not any(own is scenario and gains is schedule for own, gains, *_ in _last_attached):
        text, design = scenario_to_yaml(scenario), schedule.to_json()
        files = {"scenario.yaml": text.encode(), "schedule.json": design.encode()}
        _last_attached[:] = [(scenario, schedule, scenario_sha256(scenario), files)]
    _, _, sha256, files = _last_attached[0]
    return sha256, files


def log_dims(scenario: Scenario) -> LogDims:
    """Sizes of a scenario's logs."""
    num_states, num_inputs, num_normals = scenario.robot_sizes
    return LogDims(
        num_urllc=scenario.users.num_urllc,
        num_embb=scenario.users.num_embb,
        num_prb=scenario.radio.num_prb,
        num_states=num_states,
        num_inputs=num_inputs,
        num_normals=num_normals,
        num_model_values=num_model_values(scenario),
    )


def log_block(
    writer: LogWriter,
    scenario: Scenario,
    schedule: GainSchedule,
    fields: Mapping[str, NDArray[Any]],
    first_slot: int = 0,
) -> None:
    """Write consecutive slots of one world and their events; `fields` have a leading axis (T,)."""
    writer.write_block(first_slot, logged_fields(writer.fields, scenario, fields))
    for event in slot_events(scenario, schedule, fields, first_slot):
        writer.event(*event)


def write_log(
    path: Path,
    scenario: Scenario,
    schedule: GainSchedule,
    label: RunLabel,
    run: WorldRun,
    *,
    profile: str,
) -> None:
    """Write the log of what a policy did in one world; see `open_log`."""
    with open_log(
        path,
        scenario,
        schedule,
        label,
        profile=profile,
        metadata=run.metadata,
        attachments=run.attachments,
    ) as writer:
        log_block(writer, scenario, schedule, run.fields)


def logged_fields(
    wanted: Collection[str], scenario: Scenario, fields: Mapping[str, NDArray[Any]]
) -> Mapping[str, NDArray[Any]]:
    """Add to the fields of a record those wanted that it does not have: sums of slices."""
    if fields.keys() >= set(wanted):
        return fields
    return {**fields, **slice_fields(fields, scenario.users.num_urllc)}


def slice_fields(fields: Mapping[str, NDArray[Any]], num_urllc: int) -> dict[str, NDArray[Any]]:
    """Sum users up to slices: what logs of decisions have in place of the users' numbers.

    `fields` has ``backlog_packets``, ``due_packets`` and ``late_packets`` of users, shape (..., U),
    URLLC users first. Returns name -> value of each slot, shape (...): mean backlogs [packets], 0
    where a slice has no user, and numbers of packets.
    """
    slices: dict[str, NDArray[Any]] = {}
    for name, users in (("urllc", slice(0, num_urllc)), ("embb", slice(num_urllc, None))):
        backlog = fields["backlog_packets"][..., users]
        # User by user: the order of NumPy's own sum, and so its bits, depends on memory layout.
        total = np.zeros(backlog.shape[:-1])
        for user in range(backlog.shape[-1]):
            total += backlog[..., user]
        slices[f"backlog_{name}_packets"] = total / max(1, backlog.shape[-1])
        for kind in ("due", "late"):
            packets = fields[f"{kind}_packets"][..., users]
            slices[f"{kind}_{name}_packets"] = packets.sum(axis=-1, dtype=np.uint32)
    return slices
