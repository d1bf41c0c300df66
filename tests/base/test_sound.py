"""Speeds of sound against published tables."""

import math

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


# Dry air: share, molar mass (g/mol), and heat capacity (J/mol K) of the ideal gas at 200 K and 298.15 K. The heat
# capacities are of M. W. Chase, NIST-JANAF Thermochemical Tables (1998).
GASES = {
    "N2": (0.78084, 28.0134, 29.107, 29.124),
    "O2": (0.20946, 31.9988, 29.126, 29.376),
    "Ar": (0.00934, 39.948, 20.786, 20.786),
}
CARBON_DIOXIDE, WATER = (44.0095, 32.359, 37.129), (18.01528, 33.349, 33.590)
MOLAR_GAS, ATMOSPHERE = 8.314462618, 101_325.0


def humid(celsius: float, humidity: float, gas: float) -> float:
    """Return the speed of sound in humid air at one atmosphere, m/s, from properties of its gases.

    The speed of a real gas is c^2 = gamma R T / M (1 + 2 p K / (R T)), K = B + (gamma - 1) T B' + (gamma - 1)^2 / (2
    gamma) T^2 B'': J. O. Hirschfelder and others, "Molecular Theory of Gases and Liquids" (1954). The second
    virial coefficient B is of the compressibility of the CIPM (R. S. Davis, Metrologia 29, 1992), and the saturated
    vapour of ISO 9613-1 (1993), annex B. None of these formulas has a coefficient of Cramer's speed.
    """
    kelvin, t, p = celsius + 273.15, celsius, ATMOSPHERE
    x = humidity / 100.0 * 10.0 ** (4.6151 - 6.8346 * (273.16 / kelvin) ** 1.261)
    dry = (1.0 - x - gas) / sum(share for share, *_ in GASES.values())
    parts = [(dry * share, *more) for share, *more in GASES.values()] + [(gas, *CARBON_DIOXIDE), (x, *WATER)]
    mass = 1e-3 * sum(share * molar for share, molar, *_ in parts)
    capacity = sum(share * (low + (high - low) * (kelvin - 200.0) / 98.15) for share, _, low, high in parts)
    gamma = capacity / (capacity - MOLAR_GAS)
    virial = 1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t**2 + (5.707e-6 - 2.051e-8 * t) * x
    virial += (1.9898e-4 - 2.376e-6 * t) * x**2
    slope, bend = -2.9331e-8 + 2.2086e-10 * t - 2.051e-8 * x - 2.376e-6 * x**2, 2.2086e-10
    k = virial + (gamma - 1.0) * kelvin * slope + (gamma - 1.0) ** 2 / (2.0 * gamma) * kelvin**2 * bend
    return math.sqrt(gamma * MOLAR_GAS * kelvin / mass * (1.0 - 2.0 * p * k / kelvin))


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


@pytest.mark.parametrize("celsius", [0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0])
def test_humid_air_agrees_with_the_properties_of_its_gases(celsius):
    for humidity in (0.0, 25.0, 50.0, 75.0, 100.0):
        for gas in (314e-6, 400e-6, 1e-3):
            assert sound_in_air(celsius, humidity, gas) == pytest.approx(humid(celsius, humidity, gas), abs=0.06)


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
