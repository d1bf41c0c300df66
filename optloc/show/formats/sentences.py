"""Line formats: NMEA 0183 for instruments, poses with covariance for ROS, vertices and priors for g2o.

Sources: NMEA 0183 4.10 (2012), GGA and GST; geometry_msgs/PoseWithCovarianceStamped and REP 103, 105 of ROS;
R. Kuemmerle et al., "g2o: a general framework for graph optimization", ICRA (2011), and its types slam2d and slam3d.
"""

from __future__ import annotations

import json
from functools import reduce
from typing import Any

import numpy as np

from optloc.base.outputs import visible
from optloc.base.types import Array
from optloc.show.formats.marks import Mark, Results, ellipse

# NMEA 0183.

# Talker "several navigation systems". The talker of other positioning systems, SN, is exact, but gpsd and many displays
# read positions of satellite receivers only.
_TALKER = "GN"
# Largest number of sources in a sentence: the field has two digits, and readers refuse more than 12.
_SOURCES = 12
# Decimals of a minute of arc: a resolution of 0.2 mm.
_MINUTES = 7


def nmea(results: Results) -> str:
    """Return a GGA sentence for each mark, and a GST sentence for each mark with a valid covariance.

    The last line has no line feed, because the writer of a text file adds it.
    """
    return "".join(map(sentences, results.marks())).removesuffix("\n")


def sentences(mark: Mark) -> str:
    """Return the GGA sentence of a mark, and the GST sentence if the covariance is valid.

    If the status is in doubt, the GGA sentence has fix quality 0 and no position.
    """
    clock = "" if mark.date is None else mark.date.strftime("%H%M%S.") + f"{mark.date.microsecond // 10000:02d}"
    if not mark.sure:
        return _sentence("GGA", clock, "", "", "", "", "0", "00", "", "", "M", "", "M", "", "")
    lon, lat, height = mark.place
    place = (_angle(lat, 2), "N" if lat >= 0.0 else "S", _angle(lon, 3), "E" if lon >= 0.0 else "W")
    # optloc has no geoid model: the height is above the ellipsoid, and the geoid separation field is 0.0.
    height_fields = (f"{height:.3f}", "M", "0.0", "M") if len(mark.position) == 3 else ("", "M", "", "M")
    line = _sentence("GGA", clock, *place, "1", f"{_sources(mark):02d}", "", *height_fields, "", "")
    if not mark.covers:
        return line
    major, minor, bearing = ellipse(mark.level)
    sigma = np.sqrt(np.maximum(np.diagonal(mark.level), 0.0))
    # The fields of GST are latitude, longitude and height; the axes of the covariance are east, north and up.
    sizes = [f"{v:.3f}" for v in (sigma[1], sigma[0], *sigma[2:])]
    rise = [] if len(sigma) == 3 else [""]
    return line + _sentence("GST", clock, "", f"{major:.3f}", f"{minor:.3f}", f"{bearing:.1f}", *sizes, *rise)


def _sources(mark: Mark) -> int:
    """Return the number of measurements of a position: its coordinates plus its redundancy, if known.

    Readers ignore a position without satellites, so this number is written in their field.
    """
    known = mark.row.columns.get("dof")
    redundancy = 0 if known is None or known[mark.row.number] is None else float(known[mark.row.number])
    return min(len(mark.position) + (int(redundancy) if redundancy > 0 else 0), _SOURCES)


def _angle(degrees: float, digits: int) -> str:
    """Return an angle in degrees as the NMEA number dddmm.mmmmmmm.

    `digits` is the number of digits of the degrees. The angle is rounded before it is split into degrees and minutes,
    so that minutes stay below 60.
    """
    units = round(abs(float(degrees)) * 60.0 * 10**_MINUTES)
    whole, rest = divmod(units, 60 * 10**_MINUTES)
    minutes, part = divmod(rest, 10**_MINUTES)
    return f"{whole:0{digits}d}{minutes:02d}.{part:0{_MINUTES}d}"


def _sentence(name: str, *fields: str) -> str:
    """Return an NMEA sentence with its checksum: the exclusive or of all characters between $ and *."""
    text = f"{_TALKER}{name},{','.join(fields)}"
    return f"${text}*{reduce(lambda sum_, letter: sum_ ^ ord(letter), text, 0):02X}\r\n"


# ROS.

# Variance of coordinates that are not estimated, m^2 and rad^2. ROS programs treat variances from 1e4 on as unknown.
_OPEN = 1e6
_FRAMES = {"ecef": "earth", "enu": "map", "cartesian": "map"}


def ros(results: Results) -> str:
    """Return YAML documents: a PoseWithCovarianceStamped for each mark with a valid covariance, else a comment."""
    frame = _FRAMES[results.frame.kind]
    return "\n".join(_pose(mark, frame) for mark in results.marks())


def _pose(mark: Mark, frame: str) -> str:
    """Return the YAML document of a mark; comment lines if its status is not `ok` or it has no valid covariance.

    `frame` is the name of the frame in ROS. The orientation is the identity, with an unknown variance.
    """
    if not (mark.sure and mark.covers):
        return _comment(mark)
    d = len(mark.position)
    # The axes of a pose are x, y, z and three rotations.
    covariance = np.diag(np.full(6, _OPEN))
    covariance[:d, :d] = mark.covariance
    when = mark.time if np.isfinite(mark.time) else 0.0
    seconds = int(np.floor(when))
    message: dict[str, Any] = {
        "header": {
            "stamp": {"sec": seconds, "nanosec": min(round((when - seconds) * 1e9), 999_999_999)},
            "frame_id": frame,
        },
        "pose": {
            "pose": {
                "position": dict(zip("xyz", [*mark.position.tolist(), 0.0][:3], strict=True)),
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            },
            "covariance": covariance.ravel().tolist(),
        },
    }
    return f"# {visible(mark.name)}\n{json.dumps(message, allow_nan=False)}\n---"


def _comment(mark: Mark) -> str:
    """Return comment lines with the name, the status and the position of a mark, and with its alternatives."""
    lines = [f"{mark.name}: {mark.words}" + (f" Position: {_spelled(mark.position)} m." if mark.known else "")]
    lines += [
        f"alternative at {_spelled(other.position)}, probability {other.probability:.2g}" for other in mark.others
    ]
    return "\n".join(f"# {visible(line)}".replace("\n", " ") for line in lines)


def _spelled(position: Array) -> str:
    """Return the coordinates of a position as text, m."""
    return " ".join(f"{v:.6f}" for v in position)


# g2o.

# Minimum standard deviation of a prior, m: an exactly fixed coordinate has no finite information matrix.
_HELD = 1e-4
_POINTS = {2: ("VERTEX_XY", "EDGE_PRIOR_XY"), 3: ("VERTEX_TRACKXYZ", "EDGE_POINTXYZ_PRIOR")}


def g2o(results: Results) -> str:
    """Return a vertex for each mark, and a prior with its information matrix if the covariance is valid."""
    lines = []
    vertex, prior = _POINTS[len(results.axes)]
    for number, mark in enumerate(results.marks()):
        lines.append(_comment(mark))
        if not mark.known:
            continue
        place = " ".join(f"{v:.12g}" for v in mark.position)
        lines.append(f"{vertex} {number} {place}")
        if mark.sure and mark.covers:
            triangle = _information(mark.covariance)[np.triu_indices(len(mark.position))]
            lines.append(f"{prior} {number} {place} {' '.join(f'{v:.12g}' for v in triangle)}")
    return "\n".join(lines)


def _information(covariance: Array) -> Array:
    """Return the inverse of a covariance (d, d), m^-2; standard deviations along its axes are at least 0.1 mm."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors / np.maximum(values, _HELD**2)) @ vectors.T)
