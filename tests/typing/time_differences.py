"""An aircraft by time differences, with a known height in feet."""

import numpy as np

import optloc

receivers = {
    "Nord": (47.9, 11.1, 600.0),
    "Ost": (47.7, 11.6, 700.0),
    "West": (47.6, 10.8, 800.0),
    "Mitte": (47.75, 11.2, 650.0),
}
later = {"Ost": 1250.0, "West": -830.0, "Mitte": 410.0}
fix = optloc.locate(latlon=receivers, tdoa=later, reference="Nord", unit="ns", sigma=20, height="32800 ft")
if fix.status is optloc.Status.OK:
    lat, lon, height = fix.geodetic
    print(np.degrees(lat), np.degrees(lon), height)
