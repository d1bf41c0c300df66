"""Speeds of sound against published tables."""

import pytest

from optloc import InvalidProblem
from optloc.base.sound import pressure_at, sound_in_air, sound_in_water

# Pond and Pickard, "Introductory Dynamical Oceanography" (1983), table of the UNESCO algorithm: temperature, salinity,
# pressure in decibars, m/s.
SEA = [
    (0, 25, 0, 1435.789875), (10, 25, 5000, 1561.30635914), (20, 25, 10000, 1676.80967748), (30, 25, 0, 1535.21434752),
    (40, 25, 5000, 1638.02522336), (0, 35, 10000, 1623.15007097), (10, 35, 0, 1489.82233602),
    (20, 35, 5000, 1604.4762822), (30, 35, 10000, 1710.06294277), (40, 35, 0, 1563.20925247),
    (40, 40, 10000, 1731.995394),
]  # fmt: skip
# O. Cramer, J. Acoust. Soc. Am. 93 (1993), figure 1 as read by the authors of pyfar: temperature, humidity in percent,
# m/s, for 314 ppm of carbon dioxide.
AIR = [
    (0, 0.47, 331.5079), (0, 30.174, 331.627), (0, 60.032, 331.7063), (10, 0.632, 337.4603), (10, 30.332, 337.6984),
    (10, 60.19, 337.8571), (20, 0.79, 343.3333), (20, 30.174, 343.7302), (20, 60.19, 344.1667), (20, 98.736, 344.6825),
    (30, 0.474, 349.1667), (30, 30.332, 349.881), (30, 60.19, 350.5556), (30, 98.894, 351.5079),
]  # fmt: skip
# ISO 9613-1 (1993) and most textbooks: dry air, temperature and m/s.
DRY = [
    (-25, 315.77), (-20, 318.94), (-15, 322.07), (-10, 325.18), (-5, 328.25), (0, 331.30), (5, 334.32), (10, 337.31),
    (15, 340.27), (20, 343.21), (25, 346.13), (30, 349.02), (35, 351.88),
]  # fmt: skip
# V. A. Del Grosso and C. W. Mader, J. Acoust. Soc. Am. 52 (1972): pure water at one atmosphere, temperature and m/s.
PURE = [(0, 1402.388), (10, 1447.270), (20, 1482.343), (25, 1496.687), (30, 1509.127), (40, 1528.863)]


def pressed(decibars: float) -> float:
    """Return the depth (m) at a pressure, by bisection."""
    low, high = 0.0, 1.2e4
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if pressure_at(middle) < decibars else (low, middle)
    return low


def test_the_sea_agrees_with_the_unesco_table(monkeypatch):
    monkeypatch.setattr("optloc.base.sound._DEEP", (0.0, 1e4))  # the table ends at 10 000 decibars, 9 700 m
    for celsius, salt, decibars, speed in SEA:
        # the table is on the temperature scale of 1968
        assert sound_in_water(celsius / 1.00024, salt, pressed(decibars)) == pytest.approx(speed, abs=0.01)


def test_pure_water_agrees_with_del_grosso_and_mader():
    for celsius, speed in PURE:
        assert sound_in_water(celsius, 0.0) == pytest.approx(speed, abs=0.1)


def test_the_pressure_agrees_with_the_depth_of_saunders():
    # P. M. Saunders (1981): 7500 decibars at 30 degrees of latitude are 7321.45 m; 45 degrees differ by 0.13 %
    assert pressure_at(7321.45) == pytest.approx(7500.0, rel=0.002)


def test_humid_air_agrees_with_cramer():
    for celsius, humidity, speed in AIR:
        assert sound_in_air(celsius, humidity, 314e-6) == pytest.approx(speed, abs=0.1)


def test_dry_air_agrees_with_its_table():
    for celsius, speed in DRY:
        assert sound_in_air(celsius) == pytest.approx(speed, abs=0.02)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: sound_in_air(80.0), "temperature of air is 80"),
        (lambda: sound_in_air(-5.0, 50.0), "temperature of humid air is -5"),
        (lambda: sound_in_air(20.0, 120.0), "relative humidity is 120"),
        (lambda: sound_in_water(90.0), "temperature of water is 90"),
        (lambda: sound_in_water(9.0, 60.0), "salinity is 60"),
        (lambda: sound_in_water(9.0, 35.0, -3.0), "depth is -3"),
    ],
)
def test_values_outside_a_formula_are_named(call, words):
    with pytest.raises(InvalidProblem, match=words) as caught:
        call()
    assert len(str(caught.value)) <= 200
    assert "give the speed as a number" in str(caught.value)
