import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from optloc.base.errors import InvalidProblem
from optloc.base.units import SI_UNIT, SPEED_OF_LIGHT, UNITS, conversion, sigma_to_si, to_si

KNOWN = [
    (2.5, "km", "length", {}, 2500.0),
    (1.0, "nmi", "length", {}, 1852.0),
    (10.0, "ft", "length", {}, 3.048),
    (1.0, "mi", "length", {}, 1609.344),
    (100.0, "ns", "length", {}, 29.9792458),
    (2.0, "ms", "length", {"propagation_speed": 343.0}, 0.686),
    (180.0, "deg", "angle", {}, math.pi),
    (3600.0, "arcsec", "angle", {}, math.pi / 180),
    (90.0, "deg", "angle", {"convention": "north-clockwise"}, 0.0),
    (0.0, "mrad", "angle", {"convention": "north-clockwise"}, math.pi / 2),
    (20.0, "dB", "ratio", {}, 10.0),
    (1.5, "1", "ratio", {}, 1.5),
    (36.0, "km/h", "speed", {}, 10.0),
    (1.0, "kn", "speed", {}, 1852 / 3600),
    (10.0, "Hz", "speed", {"carrier": 1e9}, -2.99792458),
    (3.0, "us", "time", {}, 3e-6),
    (7.0, "1", "plain", {}, 7.0),
]


@pytest.mark.parametrize(("value", "unit", "quantity", "options", "si"), KNOWN)
def test_known_values(value, unit, quantity, options, si):
    assert to_si([value], unit, quantity, **options) == pytest.approx([si], rel=1e-15, abs=1e-15)


EVERY = [(unit, quantity) for quantity, table in UNITS.items() for unit in table]


@pytest.mark.parametrize(("unit", "quantity"), EVERY)
@settings(max_examples=30)
@given(value=st.floats(-300, 300))
def test_every_unit_comes_back_and_slope_is_the_derivative(unit, quantity, value):
    step = 1e-4
    change = conversion(unit, quantity, carrier=2.4e9)
    si = change.to_si(value)
    assert change.from_si(si) == pytest.approx(value, rel=1e-12, abs=1e-11)
    numeric = (change.to_si(value + step) - change.to_si(value - step)) / (2 * step)
    assert change.slope(si) == pytest.approx(numeric, rel=1e-6)


def test_si_units_change_nothing():
    for quantity, unit in SI_UNIT.items():
        assert to_si(3.25, unit, quantity) == 3.25


def test_a_decibel_is_a_ratio_of_ranges():
    # Twice as near is 6.02 dB louder.
    assert to_si(20 * math.log10(2), "dB", "ratio") == pytest.approx(2)


def test_a_receding_emitter_lowers_the_frequency():
    carrier, rate_a, rate_b = 1e9, 30.0, -20.0
    received = carrier * (1 - np.array([rate_a, rate_b]) / SPEED_OF_LIGHT)
    assert to_si(received[0] - received[1], "Hz", "speed", carrier=carrier) == pytest.approx(rate_a - rate_b, rel=1e-8)


def test_sigma_is_positive_and_scaled_at_the_value():
    assert sigma_to_si([1.0, 2.0], "ns", "length") == pytest.approx([0.299792458, 0.599584916])
    assert sigma_to_si(1.0, "Hz", "speed", carrier=1e9) == pytest.approx(0.299792458)
    assert conversion("deg", "angle", convention="north-clockwise").sigma_to_si(1.0) == pytest.approx(math.pi / 180)
    ratio = np.array([0.5, 4.0])
    sample = np.random.default_rng(0).normal(20 * np.log10(ratio), 0.1, (200_000, 2))
    spread = to_si(sample, "dB", "ratio").std(axis=0)
    assert sigma_to_si(0.1, "dB", "ratio", values_si=ratio) == pytest.approx(spread, rel=0.01)


WRONG = [
    (("kms", "length"), {"where": "rows.csv"}, "rows.csv: unknown unit 'kms' .*; did you mean .*'km'"),
    (("KM", "length"), {}, "did you mean 'km'"),
    (("db", "ratio"), {}, "did you mean 'dB'"),
    (("deg", "length"), {}, "unknown unit 'deg' for the quantity 'length'; .*known are m, km"),
    (("m", "lenght"), {}, "unknown quantity 'lenght'; did you mean 'length'"),
    (("Hz", "speed"), {}, "carrier frequency is missing"),
    (("Hz", "speed"), {"carrier": -1.0}, "carrier frequency must be positive"),
    (("ns", "length"), {"propagation_speed": math.nan}, "propagation speed is nan"),
    (("deg", "angle"), {"convention": "north"}, "did you mean 'north-clockwise'"),
]


@pytest.mark.parametrize(("arguments", "options", "message"), WRONG)
def test_errors_name_the_culprit(arguments, options, message):
    with pytest.raises(InvalidProblem, match=message):
        conversion(*arguments, **options)


def test_a_sigma_in_decibels_needs_the_value():
    with pytest.raises(InvalidProblem, match="dB"):
        sigma_to_si(0.5, "dB", "ratio")
