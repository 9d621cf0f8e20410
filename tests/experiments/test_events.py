from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hiersched.control import Certificate, build_schedule
from hiersched.experiments.events import slot_events, stretches
from hiersched.experiments.gains import load_gains
from hiersched.scenario import Scenario
from hiersched.simulator.loop_gains import plant_of


@given(arrays(np.bool_, st.tuples(st.integers(0, 12), st.integers(0, 3))))
def test_stretches_are_maximal_and_cover(mask: np.ndarray) -> None:
    rebuilt = np.zeros_like(mask)
    for column, start, stop in stretches(mask):
        assert start < stop
        assert start == 0 or not mask[start - 1, column]
        assert stop == len(mask) or not mask[stop, column]
        rebuilt[start:stop, column] = True
    assert (rebuilt == mask).all()


def quiet(slots: int) -> dict[str, np.ndarray]:
    """Fields of four users and two robots with nothing to report."""
    return {
        "hol_delay_s": np.zeros((slots, 4)),
        "delay_capped": np.zeros((slots, 2), np.uint32),
        "delay_steps": np.zeros((slots, 2), np.uint32),
        "control_saturated": np.zeros((slots, 2), np.uint32),
    }


def test_events_say_where_trouble_begins(tiny: Scenario, designed) -> None:
    schedule, _ = load_gains(designed / "gains" / "schedule.json", tiny)
    fields = quiet(8)
    assert slot_events(tiny, schedule, fields) == []
    fields["hol_delay_s"][:, 1] = [0, 0.02, 0.03, 0.05, 0.02, 0, 0.03, 0]
    fields["hol_delay_s"][:, 2] = 0.2  # an eMBB user has 0.3 s
    fields["delay_capped"][4:6, 0] = 1
    fields["delay_steps"][4:6, 0] = 3, 4
    fields["control_saturated"][7, 1] = 2
    found = [(e.slot, e.level, e.name, e.message) for e in slot_events(tiny, schedule, fields, 100)]
    assert found == [
        (102, "WARNING", "queue", "user 1: head-of-line delay past 20 ms for 2 slots, up to 50 ms"),
        (
            104,
            "WARNING",
            "delay",
            "robot 0: measurements up to 4 samples old for 2 slots: beyond the 2 samples that "
            "gains are designed for",
        ),
        (106, "WARNING", "queue", "user 1: head-of-line delay past 20 ms for 1 slots, up to 30 ms"),
        (107, "INFO", "control", "robot 1: 2 saturated commands in 1 slots"),
    ]


def test_uncertified_gains_are_reported_while_they_are_in_force(tiny: Scenario) -> None:
    control = replace(tiny.control, method="predictor", hold_samples=0)
    scenario = replace(tiny, control=control)
    schedule = build_schedule(plant_of(scenario), scenario.max_delay_steps, "predictor")
    assert schedule.status == ("nominal", "uncertified", "uncertified")
    fields = quiet(4)
    fields["delay_steps"][1:3, 0] = 1  # samples in slots 0 and 2: in force in slots 2 and 3
    (event,) = slot_events(scenario, schedule, fields)
    assert (event.slot, event.level, event.name) == (2, "WARNING", "gain")
    assert event.message == (
        "robot 0: no certified gain for T = 1, a gain without certificate in force for 2 slots"
    )
    nominal = replace(scenario, control=replace(control, gain="nominal"))
    assert slot_events(nominal, schedule, fields) == []


def test_gains_without_certificate_are_reported(tiny: Scenario, designed) -> None:
    schedule, _ = load_gains(designed / "gains" / "schedule.json", tiny)
    unproven = Certificate(spectral_radii=schedule.certificates[2].spectral_radii)
    broken = replace(
        schedule,
        status=("nominal", "nominal", "infeasible"),
        certificates=(*schedule.certificates[:2], unproven),
    )
    fields = quiet(4)
    fields["delay_steps"][1:, 1] = 2  # a sample every second slot
    (event,) = slot_events(tiny, broken, fields)
    assert (event.slot, event.name) == (2, "gain")
    assert event.message == (
        "robot 1: no certified gain for T = 2, nominal gain in force for 2 slots"
    )
    assert slot_events(tiny, schedule, fields) == []
