"""XML formats: KML for maps, GPX for receivers, Cursor on Target for situation displays.

Sources: OGC 07-147r2, OGC KML 2.2; GPX 1.1 Schema, Topografix (2004); M. J. Kristan et al., Cursor-on-Target Message
Router User's Guide, MITRE MP090284 (2009), and its base event schema.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from itertools import groupby
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring  # only writes XML: no unsafe input

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.outputs import visible
from optloc.base.types import Array
from optloc.show.formats.marks import Area, Mark, Other, Results, ellipse

# Decimals of a degree and of a metre: a resolution of 0.1 mm and of 1 mm.
_DEGREES, _METRES = 9, 3
_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'


def _add(parent: Element, tag: str, text: str | None = None, /, **attributes: str) -> Element:
    """Return a new last child of an element; characters that XML cannot contain are escaped.

    `text` is the content of the child, and `attributes` are its attributes.
    """
    child = SubElement(parent, tag, {key: visible(value) for key, value in attributes.items()})
    child.text = None if text is None else visible(text)
    return child


def _document(root: Element) -> str:
    """Return an XML tree as an indented document with the XML declaration."""
    indent(root)
    return _HEAD + tostring(root, encoding="unicode")


def _iso(when: datetime) -> str:
    """Return a date in UTC as ISO 8601 text with milliseconds and the suffix Z."""
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _number(value: float, digits: int = _METRES) -> str:
    """Return a number as decimal text without an exponent, as XML schemas require."""
    # Adding 0.0 after rounding turns -0.0 into 0.0.
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _courses(marks: Sequence[Mark]) -> Iterator[tuple[str, list[list[Mark]]]]:
    """Yield each target with the parts of its track.

    A part is a sequence of marks that are `sure`. It ends at the first mark that is not, where the track is lost.
    """
    for target in dict.fromkeys(mark.target for mark in marks):
        marks_of_target = (mark for mark in marks if mark.target == target)
        yield target, [list(part) for sure, part in groupby(marks_of_target, key=lambda mark: mark.sure) if sure]


def _covariance(level: Array) -> str:
    """Return the upper triangle of a level covariance, m^2, as text: ee en eu nn nu uu."""
    return " ".join(f"{value:.9g}" for value in level[np.triu_indices(len(level))])


# KML.

# Colours aabbggrr: green, amber and grey as on the maps of optloc; areas are half transparent.
_STYLES = {"ok": "ff50a030", "doubtful": "ff00a0f0", "alternative": "ff909090", "station": "ffb06020"}
_PADDLE = {"PolyStyle": "60", "LineStyle": "ff", "IconStyle": "ff"}


def kml(results: Results) -> str:
    """Return the results as KML 2.2: fixes and alternatives as points, 95 % regions as areas, tracks as lines."""
    root = Element("kml", {"xmlns": "http://www.opengis.net/kml/2.2"})
    document = _add(root, "Document")
    _add(document, "name", results.title)
    for name, colour in _STYLES.items():
        style = _add(document, "Style", id=name)
        for part in ("IconStyle", "LineStyle", "PolyStyle"):
            _add(_add(style, part), "color", _PADDLE[part] + colour[2:])
    for name, place in results.stations():
        _point(_placemark(document, name, "station", "station"), place, len(results.axes))
    marks = results.marks()
    for mark, area, known in zip(marks, results.areas(), results.known(), strict=True):
        _kml_mark(document, mark, area)
        for geometry, about in known:
            _kml_known(document, mark, geometry, about)
    for target, parts in _courses(marks) if results.course else ():
        line = _add(_placemark(document, f"{target}: track", "ok scans, in order", "ok"), "MultiGeometry")
        for run in (run for run in parts if len(run) > 1):
            string = _add(line, "LineString")
            _height(string, len(results.axes))
            _add(string, "coordinates", _line(mark.place for mark in run))
    return _document(root)


def _kml_mark(document: Element, mark: Mark, area: Area | None) -> None:
    """Add a mark to a KML document: its position, its 95 % region and its alternatives.

    A mark without a position is a placemark without a geometry. `area` is the region; None if it is not known.
    """
    words = mark.words
    if not mark.known:
        _placemark(document, mark.name, words, "doubtful", mark)
        return
    style, dimension = "ok" if mark.sure else "doubtful", len(mark.position)
    label = mark.name if mark.sure else f"{mark.name}: {mark.status}"
    _point(_placemark(document, label, words, style, mark), mark.place, dimension)
    if area is not None:
        word = area.role.replace("95", ", 95 %, cut off" if area.cut else ", 95 %")
        _polygons(_placemark(document, f"{mark.name}: {word}", words, style), area)
    for number, other in enumerate(mark.others, 1):
        place = _placemark(document, _alternative_name(mark, number), _alternative_text(mark, other), "alternative")
        _point(place, other.place, dimension)


def _kml_known(document: Element, mark: Mark, geometry: dict[str, Any], about: dict[str, Any]) -> None:
    """Add the wedge, ray or curve of a fix that has no valid position.

    `geometry` is a GeoJSON geometry, and `about` its properties from `known_features`.
    """
    words = {
        "direction95": "direction, 95 %" + (", cut off" if about.get("cut") else ""),
        "ray": "most likely direction",
    }
    name = words.get(about["role"], about.get("name", ""))
    placemark = _placemark(document, f"{mark.name}: {name}", mark.words, "doubtful")
    if geometry["type"] != "MultiLineString":
        _polygons(placemark, Area(about["role"], geometry))
        return
    parent = _add(placemark, "MultiGeometry")
    for part in geometry["coordinates"]:
        line = _add(parent, "LineString")
        _add(line, "tessellate", "1")
        _add(line, "altitudeMode", "clampToGround")
        _add(line, "coordinates", _line(np.array(part)))


def _alternative_name(mark: Mark, number: int) -> str:
    return f"{mark.name}: alternative {number}"


def _alternative_text(mark: Mark, other: Other) -> str:
    return f"alternative to the position of {mark.name}; probability {other.probability:.2g}"


def _placemark(document: Element, name: str, about: str, style: str, mark: Mark | None = None) -> Element:
    """Return a new placemark without a geometry; the caller appends the geometry, which the schema requires last.

    `about` is its description, and `style` a name in `_STYLES`. With `mark`, it also has time, status and covariance.
    """
    placemark = _add(document, "Placemark")
    _add(placemark, "name", name)
    _add(placemark, "description", about)
    if mark is not None and mark.date is not None:
        _add(_add(placemark, "TimeStamp"), "when", _iso(mark.date))
    _add(placemark, "styleUrl", f"#{style}")
    if mark is not None:
        data = {"status": mark.status} | ({"time": repr(mark.time)} if np.isfinite(mark.time) else {})
        data |= {"covariance_enu_m2": _covariance(mark.level)} if mark.covers else {}
        extended = _add(placemark, "ExtendedData")
        for key, value in data.items():
            _add(_add(extended, "Data", name=key), "value", value)
    return placemark


def _height(geometry: Element, dimension: int) -> None:
    """Add the altitude mode to a geometry: absolute heights for three coordinates, else points on the ground."""
    _add(geometry, "altitudeMode", "absolute" if dimension == 3 else "clampToGround")


def _point(placemark: Element, place: Array, dimension: int) -> None:
    """Add a point at longitude, latitude (degrees) and height (m) to a placemark; `dimension` is 2 or 3."""
    point = _add(placemark, "Point")
    _height(point, dimension)
    _add(point, "coordinates", _line([place]))


def _line(places: Iterable[Array]) -> str:
    """Return places (2,) or (3,) as KML coordinates "lon,lat,height", in degrees and m; a missing height is 0."""
    return " ".join(
        f"{_number(p[0], _DEGREES)},{_number(p[1], _DEGREES)},{_number(p[2] if len(p) > 2 else 0.0)}" for p in places
    )


def _polygons(placemark: Element, area: Area) -> None:
    """Add the polygons of a region to a placemark, with their holes."""
    several, coordinates = area.geometry["type"] == "MultiPolygon", area.geometry["coordinates"]
    parent = _add(placemark, "MultiGeometry") if several else placemark
    for rings in coordinates if several else [coordinates]:
        polygon = _add(parent, "Polygon")
        _add(polygon, "tessellate", "1")
        _add(polygon, "altitudeMode", "clampToGround")
        for i, ring in enumerate(rings):
            edge = _add(_add(polygon, "innerBoundaryIs" if i else "outerBoundaryIs"), "LinearRing")
            _add(edge, "coordinates", _line(np.array(ring)))


# GPX.

_OWN = "urn:optloc:fix"


def gpx(results: Results) -> str:
    """Return the results as GPX 1.1: fixes and alternatives as waypoints, tracks as segments.

    A segment ends where the track is lost.
    """
    names = {"xmlns": "http://www.topografix.com/GPX/1/1", "xmlns:optloc": _OWN, "version": "1.1", "creator": "optloc"}
    root, marks, dimension = Element("gpx", names), results.marks(), len(results.axes)
    _add(_add(root, "metadata"), "name", results.title)
    for name, place in results.stations():
        _gpx_point(root, "wpt", place, dimension, name=name, type="station")
    for mark in marks:
        if mark.known and not (results.course and mark.sure):
            label = mark.name if mark.sure else f"{mark.name}: {mark.status}"
            _add_extensions(
                _gpx_point(root, "wpt", mark.place, dimension, _time(mark), name=label, desc=mark.words, type="fix"),
                mark,
            )
        for number, other in enumerate(mark.others, 1):
            texts = {
                "name": _alternative_name(mark, number),
                "desc": _alternative_text(mark, other),
                "type": "alternative",
            }
            _gpx_point(root, "wpt", other.place, dimension, _time(mark), **texts)
    for target, parts in _courses(marks) if results.course else ():
        track = _add(root, "trk")
        _add(track, "name", target)
        for part in parts:
            segment = _add(track, "trkseg")
            for mark in part:
                _add_extensions(_gpx_point(segment, "trkpt", mark.place, dimension, _time(mark)), mark)
    return _document(root)


def _time(mark: Mark) -> str | None:
    """Return the time of a mark as text; None if it has no date."""
    return None if mark.date is None else _iso(mark.date)


def _gpx_point(
    parent: Element, tag: str, place: Array, dimension: int, when: str | None = None, /, **about: str
) -> Element:
    """Return a new point with its children in the order of the schema: ele, time, name, desc, type."""
    point = _add(parent, tag, lat=_number(place[1], _DEGREES), lon=_number(place[0], _DEGREES))
    children = {"ele": _number(place[2]) if dimension == 3 else None, "time": when}
    children |= {key: about.get(key) for key in ("name", "desc", "type")}
    for key, value in children.items():
        if value is not None:
            _add(point, key, value)
    return point


def _add_extensions(point: Element, mark: Mark) -> None:
    """Add the status to a GPX point, and the covariance along east, north and up, m^2, if it is valid.

    The schema requires extensions as the last child of a point.
    """
    extensions = _add(point, "extensions")
    _add(extensions, "optloc:status", mark.status)
    if mark.covers:
        _add(extensions, "optloc:covariance_enu_m2", _covariance(mark.level))


# Cursor on Target.

# Value of the schema for an unknown length.
_UNKNOWN = 9999999.0
# Seconds after which an event is stale: the usual value of aircraft maps.
_STALE = 60.0


def cot(results: Results) -> str:
    """Return the events of Cursor on Target for all marks and alternatives, one event on each line.

    Events without a time start now. Raise InvalidProblem for times that are no dates.
    """
    if results.undated:
        advice = 'state --time-scale for a table, or time_scale = "unix" under [epochs]'
        raise InvalidProblem("Cursor on Target needs dates, but the times have no time scale", results.title, advice)
    return "\n".join(filter(None, map(event, results.marks())))


def event(mark: Mark) -> str:
    """Return a mark and its alternatives as events of Cursor on Target 2.0, one on each line; empty without a position.

    `ce` is the standard deviation along the longest axis of the ellipse, `le` the standard deviation of the height, m.
    """
    if not np.isfinite(mark.place).all():
        return ""
    atom = "a-u-G" if mark.sure else "a-p-G"  # "a-u-G" is an unknown object, "a-p-G" is a pending object.
    major = ellipse(mark.level)[0] if mark.covers else _UNKNOWN
    rise = float(np.sqrt(max(mark.level[2, 2], 0.0))) if mark.covers and len(mark.level) == 3 else _UNKNOWN
    lines = [_event(mark, mark.name, mark.place, (major, rise), atom, mark.words)]
    for number, other in enumerate(mark.others, 1):
        name = _alternative_name(mark, number)
        lines.append(
            _event(mark, name, other.place, (_UNKNOWN, _UNKNOWN), "a-p-G", _alternative_text(mark, other), moves=False)
        )
    return "\n".join(lines)


def _event(
    mark: Mark, name: str, place: Array, errors: tuple[float, float], atom: str, about: str, *, moves: bool = True
) -> str:
    """Return one event of Cursor on Target as XML text on one line.

    `place` (3,) is longitude, latitude (degrees) and height (m). `errors` are `ce` and `le`, m. `atom` is the type of
    the event, and `about` a remark. With `moves`, course and speed of the mark are added. `name` is the name of the
    object, and a part of the id of the event.
    """
    now = datetime.now(UTC)
    start = mark.date or now
    # m-f: made by a machine, fused from several sources.
    root = Element("event", {"version": "2.0", "uid": visible(f"optloc.{name}"), "type": atom, "how": "m-f"})
    times = {"time": now, "start": start, "stale": start + timedelta(seconds=_STALE)}
    root.attrib |= {key: _iso(value) for key, value in times.items()}
    where = {"lat": _number(place[1], _DEGREES), "lon": _number(place[0], _DEGREES), "hae": _number(place[2])}
    _add(root, "point", **where, ce=_number(errors[0]), le=_number(errors[1]))
    detail = _add(root, "detail")
    _add(detail, "contact", callsign=name)
    if moves and mark.velocity is not None and mark.covers:
        east, north = mark.velocity[:2]
        course = float(np.degrees(np.arctan2(east, north)) % 360.0)
        _add(detail, "track", course=_number(course, 2), speed=_number(float(np.hypot(east, north))))
    _add(detail, "remarks", about)
    return tostring(root, encoding="unicode")
