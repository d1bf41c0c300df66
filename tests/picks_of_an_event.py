"""Picks of an earthquake with a known focus, for tests of the readers of picks."""

from datetime import datetime, timedelta

import numpy as np

from optloc import Frame

NET = {
    "AQU": (42.354, 13.405, 710.0),
    "FIAM": (42.268, 13.117, 1070.0),
    "TERO": (42.623, 13.604, 673.0),
    "CAMP": (42.536, 13.409, 1283.0),
    "FAG": (42.266, 13.584, 761.0),
    "INTR": (42.011, 13.904, 924.0),
    "MAG": (42.380, 13.200, 1150.0),
}
"""Latitude, longitude (degrees) and height (metres) of the stations."""
FOCUS = (42.332, 13.360, -8600.0)
WITH_S = ("AQU", "CAMP", "MAG")
"""Stations with an S pick."""
S_ALONE = ("INTR",)
"""Stations without a P pick."""
VP, VS = 5600.0, 3200.0
ORIGIN = datetime(2024, 4, 6, 1, 32, 38, 200000)  # noqa: DTZ001  (UTC)


def place(lat: float, lon: float, height: float) -> np.ndarray:
    """Return the ECEF position of a point in degrees and metres."""
    return Frame("ecef").from_geodetic(np.radians(lat), np.radians(lon), height)


def picks() -> list[tuple[str, str, datetime]]:
    """Return station, wave and time (to 0.01 s) of the picks at constant speeds, by station."""
    found = []
    for name, at in NET.items():
        far = float(np.linalg.norm(place(*FOCUS) - place(*at)))
        waves = ("S",) if name in S_ALONE else ("P", "S") if name in WITH_S else ("P",)
        for wave in waves:
            seconds = round(far / (VP if wave == "P" else VS), 2)
            found.append((name, wave, ORIGIN + timedelta(seconds=seconds)))
    return found


def stations_csv() -> str:
    """Return the table of stations."""
    rows = "".join(f"{name},{lat},{lon},{height}\n" for name, (lat, lon, height) in NET.items())
    return "station,latitude,longitude,elevation_m\n" + rows
