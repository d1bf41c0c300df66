"""Where navigation satellites say that they are: broadcast ephemerides, clocks, and what the atmosphere adds.

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

# The Earth's gravitation, m^3/s^2, as satellites of each system count it: GPS and QZSS; Galileo's is newer.
_GM = {"G": 3.986005e14, "J": 3.986005e14, "E": 3.986004418e14}
# Newton's steps for Kepler's equation: orbits here have eccentricities of at most 0.1, and four reach rounding.
_STEPS = 8
# Semicircles and seconds of day of Klobuchar's model; the least delay, seconds, and the time of the greatest, 14 h.
_LEAST, _NOON, _DAY = 5e-9, 50400.0, 86400.0


class Ephemeris(NamedTuple):
    """Broadcast elements of n satellites and times, arrays (n,): SI units, radians, seconds of GPS time since 1980.

    Named as in the interface document: `toe` and `toc` are the reference times of elements and clock, `af0` to `af2`
    the polynomial of the clock, `tgd` its delay for the first frequency, `week` seconds at which the week of `toe`
    begins.
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
    """Return where satellites are and what their clocks are ahead.

    Parameters
    ----------
    one : Ephemeris
        An entry for each time.
    system : "G", "E" or "J"
        GPS, Galileo or QZSS.
    t : array (n,)
        Seconds of GPS time since 1980.

    Returns
    -------
    position : array (n, 3)
        ECEF of that time, metres.
    clock : array (n,)
        Seconds, for users of the first frequency alone, the relativistic term included.
    """
    gm, a, since = _GM[system], one.root_a**2, t - one.toe
    mean = one.m0 + (np.sqrt(gm / a**3) + one.delta_n) * since
    anomaly = mean + one.e * np.sin(mean)
    for _ in range(_STEPS):
        anomaly = anomaly - (anomaly - one.e * np.sin(anomaly) - mean) / (1.0 - one.e * np.cos(anomaly))
    latitude = np.arctan2(np.sqrt(1.0 - one.e**2) * np.sin(anomaly), np.cos(anomaly) - one.e) + one.omega
    sine, cosine = np.sin(2.0 * latitude), np.cos(2.0 * latitude)
    u = latitude + one.cus * sine + one.cuc * cosine
    r = a * (1.0 - one.e * np.cos(anomaly)) + one.crs * sine + one.crc * cosine
    tilt = one.i0 + one.cis * sine + one.cic * cosine + one.idot * since
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
    # how much faster a clock runs where it is high and slow
    relativity = -2.0 * np.sqrt(gm) / SPEED_OF_LIGHT**2 * one.e * one.root_a * np.sin(anomaly)
    late = t - one.toc
    return position, one.af0 + one.af1 * late + one.af2 * late**2 + relativity - one.tgd


def turned(position: Array, seconds: Array) -> Array:
    """Return places (n, 3) in the Earth's axes of so many seconds (n,) later: Sagnac's correction."""
    angle = EARTH_RATE * seconds
    x, y = position[:, 0], position[:, 1]
    turn_x, turn_y = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    return np.stack([turn_x, turn_y, position[:, 2]], axis=-1)


def ionosphere(coefficients: Array, place: tuple[Array, Array], azimuth: Array, elevation: Array, t: Array) -> Array:
    """Return delays (n,) of the first frequency by Klobuchar's model, metres: about half of the true ones.

    Parameters
    ----------
    coefficients : array (8,)
        Alpha and beta, as broadcast.
    place : (latitude, longitude), arrays (n,)
        Of receivers, radians.
    azimuth, elevation : array (n,)
        Of satellites, radians, clockwise from north.
    t : array (n,)
        Seconds of GPS time.
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
    """Return delays (n,) by Saastamoinen's model in the standard atmosphere with 70 % humidity, metres.

    Parameters
    ----------
    latitude, height : array (n,)
        Of receivers, radians and metres; heights outside 0 to 10 km count as the nearer of these.
    elevation : array (n,)
        Of satellites, radians.
    """
    height = np.clip(height, 0.0, 1e4)
    pressure = 1013.25 * (1.0 - 2.2557e-5 * height) ** 5.2568  # hPa
    kelvin = 288.16 - 6.5e-3 * height
    vapour = 6.108 * 0.7 * np.exp((17.15 * kelvin - 4684.0) / (kelvin - 38.45))
    dry = 0.0022768 * pressure / (1.0 - 0.00266 * np.cos(2.0 * latitude) - 0.00028 * height / 1e3)
    return np.asarray((dry + 0.002277 * (1255.0 / kelvin + 0.05) * vapour) / np.sin(elevation))
