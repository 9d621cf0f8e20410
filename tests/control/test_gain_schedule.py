from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np
import pytest

import hiersched.control.gain_schedule as schedule_module
from hiersched.control import GainSchedule, build_schedule, certify, hold_delays, load_or_build
from hiersched.control.design import GainDesigner
from hiersched.core.sealed import seal_json, unseal_json

ADJUSTED = range(4, 13)
DEVIATIONS = (5.0, 9.1, 12.2, 15.8, 19.2, 22.0, 24.3, 26.0, 27.5)


def test_nominal_gain_up_to_3_then_adjusted(schedule):
    assert schedule.status == ("nominal",) * 4 + ("adjusted",) * 9
    assert schedule.certified.all()
    assert schedule.gains.shape == (13, 2, 5)
    assert schedule.gains.dtype == np.float64
    for delay in range(4):
        np.testing.assert_array_equal(schedule.gain(delay), schedule.nominal)


def test_deviations_of_the_gain_study(schedule):
    assert np.linalg.norm(schedule.nominal) == pytest.approx(35.4, abs=0.05)
    np.testing.assert_allclose(schedule.deviation[list(ADJUSTED)], DEVIATIONS, rtol=0.03)
    assert (np.diff(schedule.deviation[3:]) > 0).all()


def test_nominal_loop_is_unstable_from_4_samples_on(schedule, make_network_plant):
    plant = make_network_plant()
    radii = certify(*plant.closed_loop(plant.nominal_gain), 12, None).spectral_radii
    np.testing.assert_array_equal(radii < 1, np.arange(13) < 4)
    assert radii[6] == pytest.approx(1.056, abs=5e-4)


def test_each_gain_is_stable_at_each_delay_up_to_its_own(schedule, simulate, make_network_plant):
    plant, rng = make_network_plant(), np.random.default_rng(9)
    for delay in range(13):
        certificate = schedule.certificates[delay]
        assert certificate.spectral_radii.shape == (delay + 1,)
        assert (certificate.spectral_radii < 1).all()
        delays = rng.integers(0, delay + 1, 3000)
        loop = plant.closed_loop(schedule.gain(delay))
        states = simulate(*loop, delays, np.array([0.1, 0.1, 0.1, 0.0, 0.0]))
        assert np.linalg.norm(states[-1]) < 1e-3


@pytest.mark.parametrize(
    ("delays", "unheld", "held"),
    [
        ([3] * 6 + [12] * 10, 1.035, 0.974),
        ([1, 1, *range(2, 12), 12, 12], 1.054, 0.954),
        (list(range(1, 13)), 1.022, 0.964),
        (np.repeat(np.arange(1, 13), 2).tolist(), 1.005, 1.021),
    ],
)
def test_what_a_hold_of_five_samples_does_to_sawtooths(
    schedule, make_network_plant, delays, unheld, held
):
    """Growth a sample of the loop whose delays repeat themselves: the hold is no cure for all."""
    plant = make_network_plant()
    n, longest = plant.A.shape[0], schedule.max_delay_steps
    for samples, expected in ((0, unheld), (5, held), (25, None)):
        history = delays * 8  # long enough for the entries in force to repeat themselves too
        entries = hold_delays(history, samples)
        period = np.eye(n * (longest + 1))
        for delay, entry in list(zip(history, entries, strict=True))[-2 * len(delays) :]:
            A_c, A_d = plant.closed_loop(schedule.gain(int(entry)))
            step = np.eye(n * (longest + 1), k=-n)
            step[:n, :n] += A_c
            step[:n, n * delay : n * (delay + 1)] += A_d
            period = step @ period
        growth = np.abs(np.linalg.eigvals(period)).max() ** (0.5 / len(delays))
        if expected is None:
            assert growth < 0.98
        else:
            assert growth == pytest.approx(expected, abs=1e-3)


def test_json_is_lossless(schedule):
    text = schedule.to_json()
    back = GainSchedule.from_json(text)
    assert back.to_json() == text
    assert back.gains.tobytes() == schedule.gains.tobytes()
    assert back.nominal.tobytes() == schedule.nominal.tobytes()
    for old, new in zip(schedule.certificates, back.certificates, strict=True):
        assert old.margins == new.margins
        assert old.spectral_radii.tobytes() == new.spectral_radii.tobytes()
        assert old.witness.P.tobytes() == new.witness.P.tobytes()
    for name in ("status", "kind", "method", "decay_rate", "sampling_s", "key"):
        assert getattr(back, name) == getattr(schedule, name)


def test_verify_finds_a_changed_gain(schedule, make_network_plant):
    plant = make_network_plant()
    schedule.verify(plant)
    gains = schedule.gains.copy()
    gains[6] = 1.5 * gains[6]
    with pytest.raises(ValueError, match="gain for T=6 is recorded as certified"):
        replace(schedule, gains=gains).verify(plant)


def test_arrays_are_read_only(schedule):
    with pytest.raises(ValueError, match="read-only"):
        schedule.gains[0, 0, 0] = 1.0


@pytest.mark.parametrize("delay", [-1, 13])
def test_lookup_outside_the_table_is_an_error(schedule, delay):
    with pytest.raises(ValueError, match=rf"delay_steps is {delay}; it must lie in 0..12"):
        schedule.gain(delay)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format="other"), "not a gain schedule"),
        (lambda d: d.pop("entries"), "entries is None; it must be a list"),
        (lambda d: d["entries"].pop(1), r"entries\[1\] must be an object with delay_steps 1"),
        (lambda d: d["entries"][2].update(status="fine"), r"status\[2\] is 'fine'"),
        (lambda d: d["entries"][2].update(gain="x"), "gain is 'x'; it must be a list"),
        (lambda d: d["entries"][2].update(gain=[["a"]]), "gain is no array of numbers"),
        (
            lambda d: d["entries"][1]["gain"][0].__setitem__(0, 0.5),
            r"gains\[1\] is not the nominal",
        ),
        (
            lambda d: d["entries"][6]["certificate"].update(certified=False),
            r"status\[6\] is 'adjusted', but its certificate is not certified",
        ),
        (
            lambda d: d["entries"][6].update(status="uncertified"),
            r"status\[6\] is 'uncertified', but its certificate is certified",
        ),
        (
            lambda d: d["entries"][1]["input_gains"][0][0].__setitem__(0, 0.5),
            r"gains\[1\] is not the nominal",
        ),
        (
            lambda d: d["entries"][6]["input_gains"][0][0].__setitem__(0, 0.5),
            r"input_gains\[6\] is not zero; no certificate covers it",
        ),
        (
            lambda d: d["entries"][6]["input_gains"].pop(),
            r"entries\[6\].input_gains has shape \(5, 2, 2\); it must be \(6, 2, 2\)",
        ),
        (lambda d: d.update(operator_gain=[[1.0]]), r"operator_gain has shape \(1, 1\)"),
        (lambda d: d.update(sampling_s="0.02"), "sampling_s is '0.02'"),
        (lambda d: d["entries"][0]["certificate"].update(criterion="hope"), "criterion is 'hope'"),
    ],
)
def test_from_json_names_the_field(schedule, change, message):
    document = unseal_json(schedule.to_json().encode())
    change(document)
    with pytest.raises(ValueError, match=message):
        GainSchedule.from_json(seal_json(document))


def test_cache_is_used_rebuilt_and_repaired(tmp_path, make_network_plant, monkeypatch, caplog):
    plant, path = make_network_plant(), tmp_path / "gains" / "schedule.json"
    first = load_or_build(path, plant, 1)
    assert [entry.name for entry in path.parent.iterdir()] == ["schedule.json"]
    written = path.read_bytes()

    def unexpected(*args, **kwargs):
        raise AssertionError("designed anew")

    with monkeypatch.context() as patch:
        patch.setattr(schedule_module, "build_schedule", unexpected)
        again = load_or_build(path, plant, 1)
        assert again.to_json() == first.to_json()
        with pytest.raises(AssertionError, match="designed anew"):
            load_or_build(path, make_network_plant(701.0), 1)
        with pytest.raises(AssertionError, match="designed anew"):
            load_or_build(path, plant, 2)
    path.write_text(written.decode()[:-40])
    with caplog.at_level(logging.WARNING):
        load_or_build(path, plant, 1)
    assert "is not usable" in caplog.text
    assert path.read_bytes() == written


def test_infeasible_delays_are_explicit(make_network_plant):
    plant = make_network_plant()
    table = build_schedule(plant, 1, "razumikhin", decay_rate=0.01)
    assert table.status == ("infeasible", "infeasible")
    assert not table.certified.any()
    assert GainSchedule.from_json(table.to_json()).to_json() == table.to_json()
    np.testing.assert_array_equal(table.gains, np.stack([plant.nominal_gain] * 2))


@pytest.mark.nightly
def test_c1_schedule_of_the_split_plant(make_split_plant):
    table = build_schedule(make_split_plant(100.0, 0.3), 12, "razumikhin", decay_rate=0.03)
    assert table.certified.all()
    assert set(table.status) == {"adjusted"}
    assert (table.deviation < 2.76).all()
    assert GainSchedule.from_json(table.to_json()).to_json() == table.to_json()


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("sampling_s", "first_unstable_s"),
    [(0.005, 0.075), (0.010, 0.080), (0.050, 0.100), (0.100, 0.100)],
)
def test_other_sampling_intervals(make_network_plant, sampling_s, first_unstable_s):
    plant = make_network_plant(sampling_s=sampling_s)
    first, longest = round(first_unstable_s / sampling_s), math.ceil(round(0.24 / sampling_s, 9))
    designer = GainDesigner(plant)
    # Within 2 samples of the limit C3 moves a gain that constant delays would leave stable.
    for delay in sorted({max(first - 3, 0), first, (first + longest) // 2, longest}):
        design = designer.design(delay)
        assert design.certified
        assert design.status == ("adjusted" if delay >= first else "nominal")


@pytest.mark.nightly
def test_long_table_of_a_short_sampling_interval(make_network_plant):
    table = build_schedule(make_network_plant(sampling_s=0.01), 24)
    assert table.certified.all()
    assert table.status.index("adjusted") in (7, 8)
    assert (np.diff(table.deviation[7:]) > 0).all()
