"""Positions and clocks of navigation satellites from broadcast ephemerides, and delays of the atmosphere.

Sources: IS-GPS-200N (2022), 20.3.3.3.3 (clocks), 20.3.3.4.3 (ephemerides) and 20.3.3.5.2.5 (Klobuchar's ionosphere);
Galileo OS SIS ICD 2.1 (2023), 5.1, which has the same equations; J. Saastamoinen, "Contributions to the theory of
atmospheric refraction", Bulletin Geodesique 105-107 (1972-73), with the standard atmosphere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.base.units import SPEED_OF_LIGHT

EARTH_RATE = 7.2921151467e-5
"""Radians per second by which the Earth turns, as the ephemerides of all systems here count it."""

# Gravitational parameter of the Earth, m^3/s^2, in the definition of each system: GPS, QZSS and Galileo.
_GM = {"G": 3.986005e14, "J": 3.986005e14, "E": 3.986004418e14}
# Newton steps for Kepler's equation: eccentricities are at most 0.1, and four steps reach rounding.
_STEPS = 8
# Klobuchar's model: least delay (s), time of day of the greatest delay (s, 14 h), and seconds of a day.
_LEAST, _NOON, _DAY = 5e-9, 50400.0, 86400.0


class Ephemeris(NamedTuple):
    """Broadcast elements for n pairs of a satellite and a time, arrays (n,).

    SI units, radians, seconds of GPS time since 1980.

    Names are as in the interface document. `toe` and `toc` are the reference times of elements and clock, `af0` to
    `af2` the polynomial of the clock. `tgd` is the clock delay for the first frequency. `week` is the start of the
    week of `toe`, s.
    """

    toc: Array
    af0: Array
    af1: Array
    af2: Array
    crs: Array
    delta_n: Array
    m0: Array
    cuc: Array
    e: Array
    cus: Array
    root_a: Array
    toe: Array
    cic: Array
    omega0: Array
    cis: Array
    i0: Array
    crc: Array
    omega: Array
    omega_dot: Array
    idot: Array
    week: Array
    health: Array
    tgd: Array


def orbit(one: Ephemeris, system: str, t: Array) -> tuple[Array, Array]:
    """Return the ECEF positions (n, 3), m, and the clock errors (n,), s, of satellites.

    `one` has an entry for each time `t` (n,), seconds of GPS time since 1980. `system` is "G" (GPS), "E" (Galileo) or
    "J" (QZSS). Positions are in the ECEF axes at the times `t`. Clock errors are for users of the first frequency
    alone, and include the relativistic term.
    """
    gm, a, since = _GM[system], one.root_a**2, t - one.toe
    mean = one.m0 + (np.sqrt(gm / a**3) + one.delta_n) * since
    anomaly = mean + one.e * np.sin(mean)
    for _ in range(_STEPS):  # Newton's method for Kepler's equation: eccentric anomaly from mean anomaly
        anomaly = anomaly - (anomaly - one.e * np.sin(anomaly) - mean) / (1.0 - one.e * np.cos(anomaly))
    latitude = np.arctan2(np.sqrt(1.0 - one.e**2) * np.sin(anomaly), np.cos(anomaly) - one.e) + one.omega
    # Harmonic corrections: u is the argument of latitude, r the radius, and tilt the inclination of the orbit.
    sine, cosine = np.sin(2.0 * latitude), np.cos(2.0 * latitude)
    u = latitude + one.cus * sine + one.cuc * cosine
    r = a * (1.0 - one.e * np.cos(anomaly)) + one.crs * sine + one.crc * cosine
    tilt = one.i0 + one.cis * sine + one.cic * cosine + one.idot * since
    # Longitude of the ascending node, from which u counts, in axes that rotate with the Earth.
    node = one.omega0 + (one.omega_dot - EARTH_RATE) * since - EARTH_RATE * (one.toe - one.week)
    along, across = r * np.cos(u), r * np.sin(u)
    position = np.stack(
        [
            along * np.cos(node) - across * np.cos(tilt) * np.sin(node),
            along * np.sin(node) + across * np.cos(tilt) * np.cos(node),
            across * np.sin(tilt),
        ],
        axis=-1,
    )
    # the relativistic part of the clock error: an eccentric orbit changes speed and height
    relativity = -2.0 * np.sqrt(gm) / SPEED_OF_LIGHT**2 * one.e * one.root_a * np.sin(anomaly)
    late = t - one.toc
    return position, one.af0 + one.af1 * late + one.af2 * late**2 + relativity - one.tgd


def turned(position: Array, seconds: Array) -> Array:
    """Return positions (n, 3), m, in ECEF axes that are `seconds` (n,) later (Sagnac correction).

    The Earth turns while a signal travels, so the axes at the reception differ from the axes at the transmission.
    """
    angle = EARTH_RATE * seconds
    x, y = position[:, 0], position[:, 1]
    turn_x, turn_y = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    return np.stack([turn_x, turn_y, position[:, 2]], axis=-1)


def ionosphere(coefficients: Array, place: tuple[Array, Array], azimuth: Array, elevation: Array, t: Array) -> Array:
    """Return ionospheric delays (n,) of the first frequency by Klobuchar's model, m.

    They are about half of the true delays.

    `coefficients` (8,) are the broadcast alpha and beta. `place` is latitude and longitude (n,) of the receivers, rad.
    `azimuth` (clockwise from north) and `elevation` (n,) are of the satellites, rad. `t` (n,) is in seconds of GPS
    time.
    """
    lat, lon, high = place[0] / np.pi, place[1] / np.pi, elevation / np.pi
    angle = 0.0137 / (high + 0.11) - 0.022
    lat = np.clip(lat + angle * np.cos(azimuth), -0.416, 0.416)
    lon = lon + angle * np.sin(azimuth) / np.cos(lat * np.pi)
    magnetic = lat + 0.064 * np.cos((lon - 1.617) * np.pi)
    powers = magnetic[:, None] ** np.arange(4)
    height = np.maximum(powers @ coefficients[:4], 0.0)
    period = np.maximum(powers @ coefficients[4:], 72000.0)
    phase = 2.0 * np.pi * ((43200.0 * lon + t) % _DAY - _NOON) / period
    day = np.where(np.abs(phase) < 1.57, height * (1.0 - phase**2 / 2.0 + phase**4 / 24.0), 0.0)
    return np.asarray(SPEED_OF_LIGHT * (1.0 + 16.0 * (0.53 - high) ** 3) * (_LEAST + day))


def troposphere(latitude: Array, height: Array, elevation: Array) -> Array:
    """Return tropospheric delays (n,) by Saastamoinen's model, m: standard atmosphere, 70 % humidity.

    `latitude` (n,) and `height` (n,) are of the receivers, rad and m; heights are limited to 0 to 10 km. `elevation`
    (n,) is of the satellites, rad.
    """
    height = np.clip(height, 0.0, 1e4)
    pressure = 1013.25 * (1.0 - 2.2557e-5 * height) ** 5.2568  # hPa
    kelvin = 288.16 - 6.5e-3 * height
    vapour = 6.108 * 0.7 * np.exp((17.15 * kelvin - 4684.0) / (kelvin - 38.45))
    dry = 0.0022768 * pressure / (1.0 - 0.00266 * np.cos(2.0 * latitude) - 0.00028 * height / 1e3)
    return np.asarray((dry + 0.002277 * (1255.0 / kelvin + 0.05) * vapour) / np.sin(elevation))
