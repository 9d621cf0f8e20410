from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiersched.core.units import db_to_linear, dbm_to_w, linear_to_db, w_to_dbm


@pytest.mark.parametrize(
    ("value_db", "ratio"), [(0.0, 1.0), (10.0, 10.0), (-30.0, 1e-3), (3.0, 1.9952623149688795)]
)
def test_known_decibels(value_db, ratio):
    assert db_to_linear(value_db) == pytest.approx(ratio, rel=1e-15)
    assert linear_to_db(ratio) == pytest.approx(value_db, abs=1e-12)


@pytest.mark.parametrize(("power_dbm", "power_w"), [(0.0, 1e-3), (30.0, 1.0), (-110.0, 1e-14)])
def test_known_powers(power_dbm, power_w):
    assert dbm_to_w(power_dbm) == pytest.approx(power_w, rel=1e-14)
    assert w_to_dbm(power_w) == pytest.approx(power_dbm, abs=1e-12)


@given(st.floats(-200.0, 200.0))
def test_there_and_back(value):
    assert linear_to_db(db_to_linear(value)) == pytest.approx(value, abs=1e-11)
    assert w_to_dbm(dbm_to_w(value)) == pytest.approx(value, abs=1e-11)


@pytest.mark.parametrize("ratio", [0.0, -1.0, math.nan])
def test_what_has_no_decibels_is_refused(ratio):
    with pytest.raises(ValueError, match=rf"must be positive.*got {ratio}"):
        linear_to_db(ratio)
