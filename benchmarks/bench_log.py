"""Speed of the log: our writer and reader against the stock ones of the mcap package.

    python benchmarks/bench_log.py [slots]

Two kinds of slots: recorded ones, of the paper scenario under PF, and random ones, in which every
mantissa is noise, the worst that compression can meet. Speeds are slots per CPU-second, medians of
rounds in which the contenders take turns; the ratios mean more than the speeds. Last, what share of
an evaluation's time goes into its logs.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from hiersched.control import GainSchedule
from hiersched.env.features import num_features
from hiersched.learning.networks import NETWORKS, Slices
from hiersched.learning.policy import Policy, rollout
from hiersched.log import TOPICS, LogDims, LogReader, LogWriter
from hiersched.log.schema import descriptor_set, topics_in
from hiersched.randomness import world_keys
from hiersched.runs.gains import design_gains, load_gains
from hiersched.runs.logging import RunLabel, log_block, open_log
from hiersched.scenario import Scenario, load_scenario
from hiersched.simulator import Simulator, SlotRecord
from hiersched.simulator.gains import LoopGains, plant_of

DIMS = LogDims(num_urllc=10, num_embb=10, num_prb=25)
SLOT_NS = 10_000_000
BLOCK = 256
ROUNDS = 5
INTEGERS = {"prb_owner": 20, "num_prb": 3, "arrivals_packets": 30, "due_packets": 30}


def random_fields(slots: int, dims: LogDims = DIMS, seed: int = 0) -> dict[str, Any]:
    """All fields of the `full` profile: integers as small as in a run, mantissas random."""
    rng = np.random.default_rng(seed)
    fields: dict[str, Any] = {}
    for topic in topics_in("full").values():
        for field in topic.fields[1:]:
            shape = (slots, *field.concrete_shape(dims))
            if field.dtype == "<u4":
                top = INTEGERS.get(field.name, 2)
                fields[field.name] = rng.integers(0, top, shape, dtype=np.uint32)
            else:
                fields[field.name] = rng.exponential(size=shape).astype(field.dtype)
    return fields


def paper_simulator(worlds: int, slots: int) -> Simulator:
    """Worlds of the paper scenario, with the nominal gain whatever the delay."""
    scenario = load_scenario("paper", defaults=Path("config/defaults.yaml"))
    gain = plant_of(scenario).nominal_gain
    network = np.repeat(gain[None], scenario.max_delay_steps + 1, axis=0)
    gains = LoopGains.memoryless(network)
    return Simulator(scenario, gains, world_keys("bench", 1, worlds), slots)


def recorded_fields(slots: int, run_slots: int = 1000) -> dict[str, Any]:
    """All fields of runs of the paper scenario, one behind the other."""
    record = paper_simulator(-(-slots // run_slots), run_slots).run("pf")
    fields = {name: getattr(record, name) for name in record._fields}
    return {name: v.reshape(-1, *v.shape[2:])[:slots] for name, v in fields.items()}


def write_ours(path: Path, fields: dict[str, Any], compression: str) -> None:
    slots = len(fields["prb_owner"])
    with LogWriter(path, DIMS, slot_ns=SLOT_NS, compression=compression) as log:
        for start in range(0, slots, BLOCK):
            block = {name: array[start : start + BLOCK] for name, array in fields.items()}
            log.write_block(start, block)


def message_classes() -> dict[str, Any]:
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set("hiersched.Channel")).file:
        pool.Add(file)
    return {t.name: GetMessageClass(pool.FindMessageTypeByName(t.message)) for t in TOPICS.values()}


def write_stock(path: Path, fields: dict[str, Any], compression: str) -> None:
    slots = len(fields["prb_owner"])
    kind = CompressionType.ZSTD if compression == "zstd" else CompressionType.NONE
    classes = message_classes()
    with path.open("wb") as stream:
        writer = Writer(stream, compression=kind, enable_data_crcs=True)
        writer.start(library="stock")
        ids = {}
        for topic in topics_in("full").values():
            schema = writer.register_schema(
                topic.message, "protobuf", descriptor_set(topic.message)
            )
            ids[topic.name] = writer.register_channel(topic.name, "protobuf", schema)
        for slot in range(slots):
            for topic in topics_in("full").values():
                message = classes[topic.name](slot=slot)
                for field in topic.fields[1:]:
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
            for field in TOPICS[channel.topic].fields:
                columns.setdefault(field.name, []).append(np.array(getattr(message, field.name)))
    for column in columns.values():
        np.stack(column)


def cpu_seconds(work: Callable[[], None]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def logging_times(worlds: int = 2, slots: int = 1400) -> dict[str, tuple[float, float]]:
    """CPU time [us a slot] of computing and of logging the evaluation of scenario `paper`.

    By policy, as the stage runs it: classical schedulers with all worlds side by side, each learned
    policy in a world of its own; full logs, with attachments and events.
    """
    scenario = load_scenario("paper", defaults=Path("config/defaults.yaml"))
    times: dict[str, list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        design_gains(scenario, "schedule", folder / "gains.json")
        schedule, gains = load_gains(folder / "gains.json", scenario)
        for _ in range(ROUNDS):
            for policy in scenario.evaluate.policies:
                side_by_side = 1 if policy in scenario.learned else worlds
                run = runner(scenario, policy)
                computing = logging = 0.0
                for first in range(0, worlds, side_by_side):
                    keys = world_keys("bench", 1 + first, side_by_side)
                    simulator = Simulator(scenario, gains, keys, slots)
                    records: list[SlotRecord] = []
                    computing += cpu_seconds(lambda r=records, s=simulator, w=run: r.append(w(s)))
                    logging += cpu_seconds(
                        lambda r=records: write_evaluation(folder, scenario, schedule, r[0])
                    )
                per_slot = 1e6 / (worlds * slots)
                times.setdefault(policy, []).append((computing * per_slot, logging * per_slot))
    return {
        name: (statistics.median(c for c, _ in rounds), statistics.median(t for _, t in rounds))
        for name, rounds in times.items()
    }


def runner(scenario: Scenario, policy: str) -> Callable[[Simulator], SlotRecord]:
    """What runs a policy of the evaluation to the horizon."""
    if policy in scenario.learned:
        learned = some_policy(scenario, policy)
        return lambda simulator: rollout(simulator, learned)
    return lambda simulator: simulator.run(policy)


def write_evaluation(
    folder: Path, scenario: Scenario, schedule: GainSchedule, record: SlotRecord
) -> None:
    """Log every world of a record as the stage does."""
    for world in range(len(record.prb_owner)):
        path = folder / f"{world}.mcap"
        path.unlink(missing_ok=True)  # replacing a file makes ext4 flush the new one
        label = RunLabel(stage="evaluate", policy="any", seed=world)
        with open_log(path, scenario, schedule, label, profile="full") as writer:
            log_block(writer, scenario, schedule, record.environment(world))


def some_policy(scenario: Scenario, learner: str) -> Policy:
    """A learner's policy with small random weights: it takes as long as a trained one."""
    learning, users = scenario.learned[learner], scenario.users
    network = NETWORKS[learning.network](
        Slices(users.num_urllc, users.num_embb),
        num_features(learning.observe_robots),
        learning.hidden,
    )
    shape = (2, network.actor.num_parameters)
    return Policy(
        parameters=np.random.default_rng(0).normal(scale=0.05, size=shape).astype(np.float32),
        network=learning.network,
        hidden=learning.hidden,
        start=learning.start,
        observe_robots=learning.observe_robots,
        num_embb=users.num_embb,
        weight_exponent=learning.weight_exponent,
        multipliers=np.zeros(users.num_urllc),
        seed=0,
        scenario_sha256="",
    )


def measure(fields: dict[str, Any], folder: Path) -> dict[str, float]:
    """Slots per CPU-second, and bytes a slot, by contender."""
    slots = len(fields["prb_owner"])
    few = slots // 20
    short = {name: array[:few] for name, array in fields.items()}
    speeds: dict[str, list[float]] = {}
    ours, stock = folder / "ours.mcap", folder / "stock.mcap"
    for _ in range(ROUNDS):
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
                seconds = cpu_seconds(work)
                speeds.setdefault(f"{name} {packing}", []).append(count / seconds)
            speeds.setdefault(f"bytes {packing}", []).append(ours.stat().st_size / slots)
    return {name: statistics.median(values) for name, values in speeds.items()}


def run(slots: int = 20_000) -> dict[str, float]:
    """Print tables and return slots per CPU-second by contender, for recorded slots."""
    kinds = {"random": random_fields(slots), "recorded": recorded_fields(slots)}
    result: dict[str, float] = {}
    for kind, fields in kinds.items():
        with tempfile.TemporaryDirectory() as folder:
            result = measure(fields, Path(folder))
        print(f"log, {slots} {kind} slots of 20 users, 25 PRBs, 10 robots, profile full")
        for packing in ("zstd", "none"):
            for what in ("write", "read"):
                ours_speed = result[f"{what} {packing}"]
                ratio = ours_speed / result[f"stock {what} {packing}"]
                print(
                    f"  {what:5} {packing:4} {ours_speed:10,.0f} slots/s  {ratio:6.1f} x stock  "
                    f"{result[f'bytes {packing}']:6.0f} B/slot"
                )
    print("evaluation of scenario paper [CPU us a slot]: computing, logging, share of logging")
    times = logging_times()
    whole = tuple(sum(column) for column in zip(*times.values(), strict=True))
    for policy, (computing, logging) in {**times, "all policies": whole}.items():
        share = logging / (computing + logging)
        result[f"share {policy}"] = share
        print(f"  {policy:20}{computing:8.1f}{logging:8.1f}{100 * share:6.0f} %")
    return result


if __name__ == "__main__":
    run(*map(int, sys.argv[1:2]))
