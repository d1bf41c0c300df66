"""A page that holds one interactive map."""

from __future__ import annotations

from optloc.errors import InvalidProblem
from optloc.maps import BoundMap
from optloc.report.geo import map_element
from optloc.report.page import page, paragraph


def map_page(found: BoundMap, title: str) -> str:
    """Return an HTML page with the interactive map of a bound; it needs no network.

    Raises
    ------
    InvalidProblem
        Where the frame is not on Earth, or matplotlib is missing.
    """
    if not found.geodetic:
        advice = "write a picture (.png, .svg, .pdf), or give a frame of the Earth"
        raise InvalidProblem("an interactive map needs positions on Earth", "map", advice)
    text = "Root of the trace of the Cramer-Rao bound of the position, in metres. Shores: Natural Earth."
    parts = [("map", "Bound of the position error", paragraph(text) + map_element(found, "map-1", title))]
    return page(title, parts, "", "", maps=True)
