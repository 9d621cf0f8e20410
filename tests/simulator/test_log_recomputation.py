"""From the log alone, by the stock reader alone: rates, service and queues, exactly.

Nothing of the library reads here: MCAP by `mcap`, messages by `mcap_protobuf`, parameters from the
scenario attached to the file.
"""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hiersched.log import LogDims, LogWriter
from hiersched.scenario import scenario_to_yaml

SLOTS = 150


@pytest.fixture(scope="module", params=["none", "zstd"])
def log(request, tmp_path_factory, make_simulator):
    """Log of a run that has queues, delays and late packets."""
    simulator = make_simulator(1, SLOTS, traffic={"load": 1.1})
    multipliers = np.array([[0.0, 0.5, 1.0, 2.0]])
    fields = simulator.run("pf", multipliers=multipliers).environment(0)
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    scenario = simulator.scenario
    attachments = {"scenario.yaml": scenario_to_yaml(scenario).encode()}
    with LogWriter(
        path,
        LogDims(
            num_urllc=scenario.users.num_urllc,
            num_embb=scenario.users.num_embb,
            num_prb=scenario.radio.num_prb,
        ),
        metadata={"policy": "pf", "seed": "1"},
        attachments=attachments,
        slot_ns=10_000_000,
        compression=request.param,
        chunk_bytes=50_000,
    ) as writer:
        for start in range(0, SLOTS, 64):
            block = {name: values[start : start + 64] for name, values in fields.items()}
            writer.write_block(start, block)
    return path


@pytest.fixture(scope="module")
def messages(log):
    """Messages by topic, in the order of their slots."""
    topics: dict[str, list] = {}
    with log.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            assert message.sequence * 10_000_000 == message.log_time == message.publish_time
            assert message.sequence == len(topics.setdefault(channel.topic, []))
            topics[channel.topic].append(decoded)
    assert {len(found) for topic, found in topics.items() if topic != "/events"} == {SLOTS}
    return topics


@pytest.fixture(scope="module")
def parameters(log):
    with log.open("rb") as stream:
        found = {a.name: a.data for a in make_reader(stream).iter_attachments()}
    return yaml.safe_load(found["scenario.yaml"])


def test_rates_come_from_channel_and_owner(messages, parameters):
    radio = parameters["radio"]
    num_prb = radio["num_prb"]
    prb_mhz = radio["bandwidth_hz"] / num_prb * 1e-6
    snr = 10 ** (radio["tx_power_dbm"] / 10) / 10 ** (radio["noise_dbm"] / 10)
    for channel, allocation in zip(messages["/channel"], messages["/allocation"], strict=True):
        h2 = np.array(channel.fading_power, dtype=np.float64).reshape(-1, num_prb)
        rate = [0.0] * len(h2)
        for prb, user in enumerate(allocation.prb_owner):
            rate[user] += float(np.float32(prb_mhz * np.log2(1.0 + snr * h2[user, prb])))
        assert list(allocation.rate_mbps) == rate
        assert (
            list(allocation.num_prb)
            == np.bincount(list(allocation.prb_owner), minlength=len(h2)).tolist()
        )


def test_service_comes_from_rate_and_dexterity_index(messages, parameters):
    traffic, slot_s = parameters["traffic"], parameters["radio"]["slot_s"]
    packets_per_mbps = slot_s / (traffic["packet_bits"] * 1e-6)
    beta = traffic["service_coefficient_mbps"]
    topics = (messages[topic] for topic in ("/allocation", "/queue", "/robots"))
    for allocation, queue, robots in zip(*topics, strict=True):
        index = [*robots.dexterity_index, *[0.0] * parameters["users"]["num_embb"]]
        service = [
            max(0.0, rate - beta * di) * packets_per_mbps
            for rate, di in zip(allocation.rate_mbps, index, strict=True)
        ]
        assert list(queue.service_packets) == service


def test_both_queues_come_from_arrivals_and_service(messages, parameters):
    queues = messages["/queue"]
    num_users = parameters["users"]["num_urllc"] + parameters["users"]["num_embb"]
    backlog = [0.0] * num_users
    largest = [0.0] * num_users
    for queue in queues:
        assert list(queue.backlog_packets) == backlog
        backlog = [
            max(0.0, f + a - mu)
            for f, a, mu in zip(backlog, queue.arrivals_packets, queue.service_packets, strict=True)
        ]
        largest = [max(pair) for pair in zip(largest, backlog, strict=True)]
    assert min(largest) > 0  # both slices queued


def test_rewards_come_from_their_parts(messages, parameters):
    n, m = parameters["users"]["num_urllc"], parameters["users"]["num_embb"]
    V, scale = parameters["objective"]["penalty_weight"], parameters["learning"]["reward_scale"]
    for delay in messages["/delay"]:
        price = sum(map(lambda a, b: a * b, delay.multiplier, delay.constraint))
        urllc = -(delay.drift_urllc + V * delay.penalty_urllc - price) / (n * scale)
        embb = -(delay.drift_embb + V * delay.penalty_embb) / (m * scale)
        assert delay.reward_urllc == pytest.approx(urllc, rel=1e-13, abs=1e-15)
        assert delay.reward_embb == pytest.approx(embb, rel=1e-13, abs=1e-15)
