"""Speed of the log: our writer and reader against the stock ones of the mcap package.

python benchmarks/bench_log.py [--short]

Two kinds of slots: recorded ones, of the scenario `paper` under PF, and random ones, in which every
mantissa is noise, the worst that compression can meet. Speeds are slots per CPU-second, medians of
rounds in which the contenders take turns. Last, what share of an evaluation's time goes into its
logs: the stage itself runs, in half of the scenario's worlds.
"""

from __future__ import annotations

import contextlib
import io
import math
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

from common import Figure, cpu_seconds, main, paper, some_policy

# isort: split
import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from hiersched.core.randomness import world_keys
from hiersched.experiments import files
from hiersched.experiments import run as stage
from hiersched.experiments.gains import design_gains
from hiersched.experiments.learned import learned_policies
from hiersched.experiments.worlds import PolicySource, untrained_policies
from hiersched.log import TOPICS, LogDims, LogReader, LogWriter
from hiersched.log.schema import descriptors, message_class, topics_in
from hiersched.scenario import Scenario
from hiersched.simulator import Simulator
from hiersched.simulator.loop_gains import Gains, plant_of
from hiersched.study.metrics import measured_row

DIMS = LogDims(num_urllc=10, num_embb=10, num_prb=25)
SLOT_NS = 10_000_000
BLOCK = 256
INTEGERS = {"prb_owner": 20, "num_prb": 3, "arrivals_packets": 30, "due_packets": 30}
LEAST = {
    ("write", "zstd"): 4.0,
    ("read", "zstd"): 7.0,
    ("write", "none"): 7.0,
    ("read", "none"): 10.0,
}
"""Least speed of ours, as a multiple of the stock one's."""
SHARES = {"classical": 0.3, "learned": 0.06, "all policies": 0.09}
"""Most of an evaluation's time that its logs may take."""


def random_fields(slots: int, dims: LogDims = DIMS, seed: int = 0) -> dict[str, Any]:
    """All fields of the `full` profile: integers as small as in a run, mantissas random."""
    rng = np.random.default_rng(seed)
    fields: dict[str, Any] = {}
    for topic in topics_in("full").values():
        for field in topic.fields_in("full"):
            shape = (slots, *field.sized(dims.sizes))
            if field.dtype == "<u4":
                top = INTEGERS.get(field.name, 2)
                fields[field.name] = rng.integers(0, top, shape, dtype=np.uint32)
            else:
                fields[field.name] = rng.exponential(size=shape).astype(field.dtype)
    return fields


def paper_simulator(worlds: int, slots: int) -> Simulator:
    """Worlds of the scenario `paper`, with the nominal gain whatever the delay."""
    scenario = paper()
    gain = plant_of(scenario).nominal_gain
    network = np.repeat(gain[None], scenario.max_delay_steps + 1, axis=0)
    gains = Gains.memoryless(network)
    return Simulator(scenario, gains, world_keys("bench", 1, worlds), slots)


def recorded_fields(slots: int, run_slots: int = 1000) -> dict[str, Any]:
    """All fields of runs of the paper scenario, one behind the other."""
    record = paper_simulator(-(-slots // run_slots), run_slots).run("pf")
    fields = {name: getattr(record, name) for name in record._fields}
    rows = math.prod(record.prb_owner.shape[:2])
    return {name: v.reshape(rows, *v.shape[2:])[:slots] for name, v in fields.items()}


def write_ours(path: Path, fields: dict[str, Any], compression: str) -> None:
    slots = len(fields["prb_owner"])
    with LogWriter(path, DIMS, slot_ns=SLOT_NS, compression=compression) as log:
        for start in range(0, slots, BLOCK):
            block = {name: array[start : start + BLOCK] for name, array in fields.items()}
            log.write_block(start, block)


def write_stock(path: Path, fields: dict[str, Any], compression: str) -> None:
    slots = len(fields["prb_owner"])
    kind = CompressionType.ZSTD if compression == "zstd" else CompressionType.NONE
    classes = {t.name: message_class(descriptors(), t.message) for t in TOPICS.values()}
    with path.open("wb") as stream:
        writer = Writer(stream, compression=kind, enable_data_crcs=True)
        writer.start(library="stock")
        ids = {}
        for topic in topics_in("full").values():
            schema = writer.register_schema(topic.message, "protobuf", descriptors())
            ids[topic.name] = writer.register_channel(topic.name, "protobuf", schema)
        for slot in range(slots):
            for topic in topics_in("full").values():
                message = classes[topic.name](slot=slot)
                for field in topic.fields_in("full"):
                    values = fields[field.name][slot]
                    if field.shape:
                        getattr(message, field.name).extend(values.ravel().tolist())
                    else:
                        setattr(message, field.name, float(values))
                writer.add_message(
                    ids[topic.name], slot * SLOT_NS, message.SerializeToString(),
                    slot * SLOT_NS, slot,
                )  # fmt: skip
        writer.finish()


def read_ours(path: Path) -> None:
    with LogReader(path) as log:
        for topic in log.topics:
            log.read(topic)


def read_stock(path: Path) -> None:
    columns: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(log_time_order=False):
            for field in TOPICS[channel.topic].fields_in("full"):
                columns.setdefault(field.name, []).append(np.array(getattr(message, field.name)))
    for column in columns.values():
        np.stack(column)


def evaluation_of(seeds: int, length: float) -> Scenario:
    """Scenario `paper` with so many evaluated worlds, and their length as a multiple of its own."""
    scenario = paper()
    own = scenario.evaluate
    evaluation = replace(
        own,
        seeds=tuple(range(1, seeds + 1)),
        warmup_s=round(length * own.warmup_s, 2),
        duration_s=round(length * own.duration_s, 2),
        full_logs=max(1, round(seeds / len(own.seeds) * own.full_logs)),
        full_log_s=round(length * own.full_log_s, 2),
    )
    return replace(scenario, evaluate=evaluation)


def evaluation_seconds(scenario: Scenario, folder: Path) -> dict[str, tuple[float, float]]:
    """CPU-seconds of the stage by policy: all of it, and what goes into its logs."""
    seconds = {}
    evaluation = scenario.evaluate
    for policy in evaluation.policies:
        group, run = "classical", untrained_policies
        if policy in scenario.learned:
            group, run = policy, learned_runner(scenario, policy, folder)
        alone = replace(scenario, evaluate=replace(evaluation, policies=(policy,)))
        seconds[policy] = stage_seconds(alone, folder, group, run)
    return seconds


def stage_seconds(
    scenario: Scenario, folder: Path, group: str, run: PolicySource
) -> tuple[float, float]:
    """CPU-seconds of one call of the stage: all of it, and its calls of `write_log`."""
    logs: list[float] = []

    def timed(*args: Any, **kwargs: Any) -> None:
        logs.append(cpu_seconds(lambda: write_log(*args, **kwargs)))

    write_log = stage.write_log
    with (
        mock.patch.object(stage, "write_log", timed),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        whole = cpu_seconds(
            lambda: stage.run_experiment(scenario, folder, "evaluate", group, run, measured_row)
        )
    return whole, sum(logs)


def learned_runner(scenario: Scenario, learner: str, folder: Path) -> PolicySource:
    """As many policies as were trained, each of which every world runs; one a world is logged."""
    path = folder / f"{learner}.json"
    some_policy(scenario, learner).save(path)
    return learned_policies([path] * len(scenario.learned[learner].seeds))


def speeds(fields: dict[str, Any], folder: Path, rounds: int) -> dict[str, float]:
    """Slots per CPU-second, and bytes a slot, by contender."""
    slots = len(fields["prb_owner"])
    few = slots // 20
    short = {name: array[:few] for name, array in fields.items()}
    seen: dict[str, list[float]] = {}
    ours, stock = folder / "ours.mcap", folder / "stock.mcap"
    for _ in range(rounds):
        for packing in ("zstd", "none"):
            contenders: list[tuple[str, int, Callable[[], None]]] = [
                ("write", slots, lambda p=packing: write_ours(ours, fields, p)),
                ("read", slots, lambda: read_ours(ours)),
                ("stock write", few, lambda p=packing: write_stock(stock, short, p)),
                ("stock read", few, lambda: read_stock(stock)),
            ]
            for name, count, work in contenders:
                if "write" in name:  # replacing a file makes ext4 flush the new one
                    (stock if "stock" in name else ours).unlink(missing_ok=True)
                seen.setdefault(f"{name} {packing}", []).append(count / cpu_seconds(work))
            seen.setdefault(f"bytes {packing}", []).append(ours.stat().st_size / slots)
    return {name: statistics.median(values) for name, values in seen.items()}


def against_stock(kind: str, fields: dict[str, Any], rounds: int) -> list[Figure]:
    """Writing and reading full logs of slots of one kind."""
    with tempfile.TemporaryDirectory() as folder:
        result = speeds(fields, Path(folder), rounds)
    size = {packing: result[f"bytes {packing}"] for packing in ("zstd", "none")}
    return [
        Figure(
            name=f"{what} a full log, {kind} slots, {packing} ({size[packing]:.0f} B/slot)",
            value=result[f"{what} {packing}"],
            unit="slots/s",
            reference=f"mcap package, {what}, {packing}",
            ratio=result[f"{what} {packing}"] / result[f"stock {what} {packing}"],
            at_least=least,
        )
        for (what, packing), least in LEAST.items()
    ]


def logging_shares(scenario: Scenario) -> list[Figure]:
    """What the logs cost an evaluation: of schedulers, of learners, and of all.

    Times are a slot that ran, under each of a learner's policies; one run a world is logged.
    """
    evaluation = scenario.evaluate
    seeds = len(evaluation.seeds)
    slots = seeds * round((evaluation.warmup_s + evaluation.duration_s) / scenario.radio.slot_s)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        design_gains(scenario, "schedule", folder / files.gain_file("schedule"))
        seconds = evaluation_seconds(scenario, folder)
    groups = {
        "classical": [p for p in evaluation.policies if p not in scenario.learned],
        "learned": [p for p in evaluation.policies if p in scenario.learned],
        "all policies": list(evaluation.policies),
    }
    figures = []
    for group, policies in groups.items():
        whole, logs = (sum(seconds[policy][part] for policy in policies) for part in (0, 1))
        learners = [scenario.learned.get(policy) for policy in policies]
        ran = slots * sum(1 if learner is None else len(learner.seeds) for learner in learners)
        figures.append(
            Figure(
                name=f"logs of an evaluation, {group}, profile {scenario.log.evaluate_profile}",
                value=1e6 * logs / ran,
                unit="us a slot",
                reference=f"the evaluation, {1e6 * whole / ran:.1f} us",
                ratio=logs / whole,
                at_most=SHARES[group],
            )
        )
    return figures


def run(short: bool) -> list[Figure]:
    """Slots per CPU-second by contender, and the logs' share of an evaluation."""
    slots, rounds = (1000, 1) if short else (20_000, 5)
    return [
        *against_stock("random", random_fields(slots), rounds),
        *against_stock("recorded", recorded_fields(slots), rounds),
        *logging_shares(evaluation_of(seeds=1 if short else 5, length=0.1 if short else 1.0)),
    ]


if __name__ == "__main__":
    main(run, __doc__)
