"""Gains that are not those of the design are refused, whether their checksum fits or not."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from hiersched.control import GainSchedule
from hiersched.core.sealed import seal_json, unseal_json
from hiersched.experiments.gains import load_gains
from hiersched.experiments.logged import _schedule
from hiersched.scenario import Scenario, load_scenario
from hiersched.simulator.gain_source import design_schedule, read_gains, scenario_schedule
from hiersched.study import study

METHODS = ("krasovskii", "razumikhin", "predictor", "lqg", "latency_compensated", "h2")
LATER = [pytest.param(method, marks=pytest.mark.nightly) for method in METHODS[4:]]
Document = dict[str, Any]


@cache
def designed(method: str) -> tuple[Scenario, str]:
    """A scenario, and its gains as their file has them."""
    scenario = load_scenario("smoke")
    if method == "krasovskii":
        return scenario, scenario_schedule(scenario).to_json()
    loop = "split" if method == "razumikhin" else "network"
    control = replace(scenario.control, method=method, loop=loop, max_delay_s=0.08, hold_samples=0)
    scenario = replace(scenario, control=control)
    return scenario, design_schedule(scenario).to_json()


def scaled(value: Any, factor: float) -> Any:
    return [scaled(v, factor) for v in value] if isinstance(value, list) else factor * value


def scale_all(factor: float) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        for place in (document, *document["entries"]):
            for name in {"nominal", "operator_gain", "gain", "input_gains"} & set(place):
                if place[name] is not None:
                    place[name] = scaled(place[name], factor)

    return change


def scale_last(factor: float) -> Callable[[Document], None]:
    """Change the gain for the longest delay alone: the one in force where it is most needed."""

    def change(document: Document) -> None:
        last = document["entries"][-1]
        last["gain"] = scaled(last["gain"], factor)
        last["input_gains"] = scaled(last["input_gains"], factor)

    return change


def swap(*names: str) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        one, other = document["entries"][-1], document["entries"][-2]
        for name in names:
            one[name], other[name] = other[name], one[name]

    return change


def put(name: str, value: Any) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        assert document[name] != value
        document[name] = value

    return change


def put_status(status: str) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        entry = document["entries"][-1]
        entry["status"] = status if entry["status"] != status else "uncertified"

    return change


def claim_certificate(document: Document) -> None:
    """Say that a gain is certified, or is not."""
    entry = document["entries"][-1]
    certified = entry["certificate"]["certified"]
    entry["certificate"]["certified"] = not certified
    entry["status"] = "infeasible" if certified else "adjusted"


CHANGES: dict[str, Callable[[Document], None]] = {
    **{f"all x {factor:g}": scale_all(factor) for factor in (1.01, 10.0, -1.0)},
    **{f"last x {factor:g}": scale_last(factor) for factor in (1.0001, 1.01, 10.0, -1.0)},
    "gains swapped": swap("gain"),
    "gains and certificates swapped": swap("gain", "certificate", "status"),
    "witnesses swapped": swap("certificate"),
    "kind": put("kind", "other"),
    "sampling": put("sampling_s", 0.021),
    "key": put("key", "0" * 64),
    **{f"status {name}": put_status(name) for name in ("nominal", "adjusted", "infeasible", "x")},
    "another verdict": claim_certificate,
    "one entry less": lambda document: document["entries"].pop(),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("method", [*METHODS[:4], *LATER])
def test_other_gains_are_refused_though_the_checksum_is_right(
    tmp_path: Path, method: str, change: str
) -> None:
    scenario, text = designed(method)
    path = tmp_path / "schedule.json"
    path.write_text(text)
    read_gains(path, scenario)
    document = unseal_json(text.encode())
    before = json.dumps(document)
    CHANGES[change](document)
    if json.dumps(document) == before:
        pytest.skip("two gains are the same")
    path.write_text(seal_json(document))
    with pytest.raises(ValueError, match=r"schedule\.json: not the gains of scenario smoke: "):
        read_gains(path, scenario)


@pytest.mark.parametrize("name", ["regulator", "filter_gain", "covariance", "model"])
@pytest.mark.parametrize("factor", [1.01, -1.0])
def test_another_filter_is_refused_though_the_checksum_is_right(
    tmp_path: Path, name: str, factor: float
) -> None:
    scenario, text = designed("lqg")
    path = tmp_path / "schedule.json"
    document = unseal_json(text.encode())
    place, key = (document["lqg"], name) if name != "model" else (document["lqg"]["model"], "A")
    place[key] = scaled(place[key], factor)
    path.write_text(seal_json(document))
    with pytest.raises(ValueError, match=r"schedule\.json: not the gains of scenario smoke: "):
        read_gains(path, scenario)
    del document["lqg"]
    path.write_text(seal_json(document))
    with pytest.raises(ValueError, match="lqg is there, or not, against the method 'lqg'"):
        read_gains(path, scenario)


@pytest.mark.nightly
@pytest.mark.parametrize("wanted", METHODS)
@pytest.mark.parametrize("given", METHODS)
def test_gains_of_another_method_are_refused(tmp_path: Path, given: str, wanted: str) -> None:
    """Also where key and method say that they are the ones wanted."""
    if given == wanted:
        return
    scenario, text = designed(wanted)
    right = unseal_json(text.encode())
    document = unseal_json(designed(given)[1].encode())
    for name in ("key", "method", "decay_rate", "kind", "operator_gain"):
        document[name] = right[name]
    document["entries"] = document["entries"][: len(right["entries"])]
    path = tmp_path / "schedule.json"
    path.write_text(seal_json(document))
    with pytest.raises(ValueError, match=r"schedule\.json: not the gains of scenario smoke: "):
        read_gains(path, scenario)


def test_every_way_to_load_gains_checks_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stages of the study; a log; tables. What the package ships is read by `read_gains`."""
    monkeypatch.setattr(study, "read_gains", read_gains)  # tests of the study replace it
    scenario, text = designed("krasovskii")
    document = unseal_json(text.encode())
    scale_last(1.01)(document)
    path = tmp_path / "gains/schedule.json"
    path.parent.mkdir()
    for content in (seal_json(document), text.replace("1", "2", 1)):
        path.write_text(content)
        for load in (
            lambda: load_gains(path, scenario),
            lambda: _schedule(path.read_bytes(), scenario),
            lambda: study.Study(scenario, tmp_path).schedule(scenario),
        ):
            with pytest.raises(ValueError, match=r"certificate for T=\d|checksum"):
                load()


def test_two_hundred_flips_are_noticed(tmp_path: Path) -> None:
    scenario, text = designed("krasovskii")
    data, rng = text.encode(), random.Random(7)
    path = tmp_path / "schedule.json"
    for _ in range(200):
        damaged = bytearray(data)
        damaged[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"schedule\.json"):
            read_gains(path, scenario)


def test_gains_that_another_processor_rounded_are_accepted(tmp_path: Path) -> None:
    """In the last bits alone: a Riccati solution to 1e-12 of it."""
    scenario, text = designed("krasovskii")
    document = unseal_json(text.encode())
    scale_all(1.0 + 1e-12)(document)
    path = tmp_path / "schedule.json"
    path.write_text(seal_json(document))
    assert isinstance(read_gains(path, scenario), GainSchedule)


def put_margins(value: Any) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        document["entries"][-1]["certificate"]["margins"] = value

    return change


@pytest.mark.parametrize(
    "change",
    [
        *(put_margins(value) for value in ({"inequality": "x"}, {"inequality": None}, {"P": [1]})),
        lambda document: document.update(nominal=[0.0] * 100_000),
        lambda document: document.update(nominal=[[10**400]]),
        lambda document: document["entries"][3].update(gain=[[1e308] * 5] * 2),
        lambda document: document.update(entries=document["entries"] * 200),
        lambda document: document.update(entries=[[]]),
        lambda document: document.update(key=None),
        lambda document: document.pop("kind"),
    ],
)
def test_content_that_is_no_schedule_is_one_message(
    tmp_path: Path, change: Callable[[Document], None], recwarn: pytest.WarningsRecorder
) -> None:
    scenario, text = designed("krasovskii")
    document = unseal_json(text.encode())
    change(document)
    path = tmp_path / "schedule.json"
    path.write_text(seal_json(document))
    with pytest.raises(ValueError, match=r"schedule\.json: not the gains of scenario smoke: "):
        read_gains(path, scenario)
    assert not list(recwarn)


@pytest.mark.parametrize("core", ["Prescott", "Haswell", "SkylakeX"])
def test_gains_serve_on_another_processor(core: str) -> None:
    """The shipped gains are verified under the matrix kernels of other processors.

    Those of SkylakeX end the process where the processor has no AVX-512.
    """
    processor = Path("/proc/cpuinfo")
    if core == "SkylakeX" and not (
        processor.exists() and "avx512f" in processor.read_text(encoding="utf-8")
    ):
        pytest.skip("this processor has no AVX-512")
    code = (
        "from hiersched.scenario import load_scenario\n"
        "from hiersched.simulator.gain_source import read_gains, shipped_file\n"
        "for name in ('paper', 'linear_plant'):\n"
        "    scenario = load_scenario(name)\n"
        "    read_gains(shipped_file(scenario), scenario)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "OPENBLAS_CORETYPE": core},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
