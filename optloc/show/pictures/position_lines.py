"""Lines of position: the positions that fit one row exactly, such as hyperbolas, circles, rays and isodoppler curves.

A line is found as a zero line of the residual of its row on a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from optloc.base.frames import Frame
from optloc.base.types import Array, Rows
from optloc.linear.evaluate import differentiate
from optloc.models import MODELS, RAY, Point
from optloc.models.layers import Layers
from optloc.problem.fix import Fix
from optloc.problem.layout import state_names
from optloc.problem.problem import Problem
from optloc.show.pictures.notes import mark_positions
from optloc.show.pictures.scene import local_frame, placed_points
from optloc.show.pictures.style import GREEN, PURPLE, SKY, YELLOW, note

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Maximum number of range rates with curves, evenly spread over a run; points along a side of the grid on which curves
# are traced; and the side of the grid in widths of the panel, because a panel can be wider or taller than its limits.
_CURVES, _GRID, _WIDE = 9, 161, 2.0
# Maximum number of rows with lines of position: more lines are unreadable.
_LINES = 24
# Legend of the lines of each kind.
_SHAPES = {
    "tdoa": "hyperbola of a time difference",
    "toa": "hyperbola of two arrivals",
    "range": "circle of a range",
    "range_sum": "ellipse of a bistatic range",
    "azimuth": "ray of a bearing",
    "isodoppler": "equal Doppler through the fix",
}
# Look of the lines of each pair: colours differ with any colour vision, and dashes in grey print. Maximum number of
# pairs with these looks and with names, and minimum number of pairs with names: a single name says nothing.
_LOOKS = tuple((colour, dash) for dash, colour in product(("-", "--", "-."), (PURPLE, SKY, GREEN, YELLOW)))
_NAMED_LINES, _NAMED_FROM = 10, 2
# Factor on the colour of a name, so that it is legible on white; margin of the plan without names, as a share of its
# side; and maximum number of tried points of a line.
_DARKER, _MARGIN, _TRIED = 0.6, 0.06, 200
# Horizontal distance from the origin, m, at which the surface of the Earth is almost vertical; and iterations to find
# the surface.
_STEEP, _STEPS = 5.5e6, 12


class PositionLine(NamedTuple):
    """The positions that fit one row exactly.

    - kind: kind of the row, or "isodoppler".
    - name: names of the stations.
    - line (p, 2): the positions in x and y, in the units of the grid.
    """

    kind: str
    name: str
    line: Array


def draw_lines_of_fix(
    panel: Axes, problem: Problem, fix: Fix, centre: Array, size: float, *, named: bool = True
) -> bool:
    """Draw the lines of position in a plan whose origin is `centre`, m, and return whether there are lines."""
    if _only_target(problem.flat(), fix.flat().x) is None:
        return False
    x, y, limits = _grid_of(panel, problem, centre, size)
    places = _at_height(problem, fix, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    found = lines_of_position(problem, fix, x, y, places)
    draw_lines(panel, found, centre, size, limits=limits if named else None)
    return bool(found)


def draw_lines_of_problem(panel: Axes, problem: Problem, size: float) -> None:
    """Draw the lines of position of a problem in the plane whose only unknowns are a position and times of emission."""
    flat = problem.flat()
    names = {slot.name.partition("[")[0] for slot in (*flat.layout.shared, *flat.layout.local)}
    vector = np.zeros((1, flat.layout.size))
    target = _only_target(flat, vector)
    if flat.dimension != 2 or names - {"position", "emission"} or target is None:
        return
    x, y, limits = _grid_of(panel, problem, np.zeros(2), size)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    if sum(int((rows.target == target).sum()) for rows in flat.rows) <= _LINES:
        draw_lines(panel, _zero_lines(flat, vector[0], target, x, y, places), np.zeros(2), size, limits=limits)


def _grid_of(panel: Axes, problem: Problem, centre: Array, size: float) -> tuple[Array, Array, Array]:
    """Return the grid lines x (n,) and y (n,), m, of a plan, and its limits (2, 2) in the unit of the plan.

    `centre` (2,) is the origin of the plan, m, and `size` its unit, m.
    """
    (west, east), (south, north) = panel.get_xlim(), panel.get_ylim()
    middle, half = np.array([west + east, south + north]) / 2.0, _WIDE * max(east - west, north - south) / 2.0
    corners = size * np.stack([middle - half, middle + half]) + centre
    # Use a coarser grid for layers: a bent ray takes a thousand times longer to compute than a straight ray.
    side = _GRID if not isinstance(problem.medium, Layers) else _GRID // 3
    x, y = (np.linspace(low, high, side) for low, high in corners.T)
    return x, y, np.array([[west, south], [east, north]])


def draw_lines(
    panel: Axes, found: Sequence[PositionLine], centre: Array, size: float, *, limits: Array | None = None
) -> None:
    """Draw lines of position in a plan with the origin `centre`, m, and the unit `size`, m.

    Each station or pair has a colour and a dash. With the `limits` (2, 2) of the plan, in its unit, its name is next to
    the line. If there are many pairs, the lines are faded and have no names.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_hex, to_rgb

    pairs = list(dict.fromkeys((one.kind, one.name) for one in found))
    faded = len(pairs) > _NAMED_LINES
    looks = dict(zip(pairs, cycle(_LOOKS), strict=False))
    spots: list[Array] = []
    for kind, look in zip(dict.fromkeys(one.kind for one in found), cycle(_LOOKS)):
        chosen = [one for one in found if one.kind == kind]
        lines = [(one.line - centre) / size for one in chosen]
        each = [look if faded else looks[one.kind, one.name] for one in chosen]
        label = _SHAPES.get(kind, f"positions that fit one {kind.removeprefix(RAY)}")
        style: dict[str, Any] = {"colors": [colour for colour, _ in each], "linestyles": [dash for _, dash in each]}
        style |= {"linewidths": 0.7, "alpha": 0.4} if faded else {"linewidths": 1.2, "alpha": 0.9}
        # Curves do not change the limits of a plan (autolim=False), because they can be much longer than the scene.
        panel.add_collection(LineCollection(lines, label=label, zorder=1, **style), autolim=False)
        if faded or limits is None or len({one.name for one in chosen}) < _NAMED_FROM:
            continue
        for pair in (pair for pair in pairs if pair[0] == kind):
            own = np.concatenate([line for one, line in zip(chosen, lines, strict=True) if one.name == pair[1]])
            spot = _free_spot(panel, own, limits, spots)
            if spot is not None:
                spots.append(spot)
                red, green, blue = (_DARKER * part for part in to_rgb(looks[pair][0]))
                note(panel, pair[1], float(spot[0]), float(spot[1]), to_hex((red, green, blue)))


def _free_spot(panel: Axes, line: Array, limits: Array, spots: Sequence[Array]) -> Array | None:
    """Return the point (2,) of a line (p, 2) for its name; None if the line is outside of the limits (2, 2).

    The point is far from the marks of the panel and from the other names `spots`.
    """
    margin = _MARGIN * (limits[1] - limits[0])
    inside = line[((line > limits[0] + margin) & (line < limits[1] - margin)).all(-1)]
    if not len(inside):
        return None
    inside = inside[:: max(1, len(inside) // _TRIED)]
    marks = panel.transData.inverted().transform(mark_positions(panel)).reshape(-1, 2)
    taken = np.concatenate([marks, *(spot[None] for spot in spots), limits.mean(0, keepdims=True)])
    free = np.linalg.norm(inside[:, None] - taken, axis=-1).min(1)
    return np.asarray(inside[np.argmax(free)])


def lines_of_position(problem: Problem, fix: Fix, x: Array, y: Array, places: Array) -> list[PositionLine]:
    """Return the positions that fit each row exactly, as lines; other unknowns have their values at the fix.

    Time differences give hyperbolas; arrivals give hyperbolas with the first arrival; ranges give circles, bearings
    rays. If there are many rows, only some range rates have lines: the isodoppler curves through the fix.

    Parameters
    ----------
    problem : Problem
        A problem with one unknown target.
    fix : Fix
        Its fix.
    x, y : array (n,), (m,)
        Grid of a plan or a map.
    places : array (m n, d)
        Points of the grid in the frame of the problem, m; NaN for points without a position.
    """
    flat, answer = problem.flat(), fix.flat()
    target = _only_target(flat, answer.x)
    if target is None:
        return []
    count = sum(int((rows.target == target).sum()) for rows in flat.rows)
    if count > _LINES or (flat.motions[target].order > 0 and flat.epochs > 1):
        return [PositionLine("isodoppler", name, line) for name, line in isodopplers(problem, fix, x, y, places)]
    return _zero_lines(flat, answer.x[0], target, x, y, places)


def _zero_lines(flat: Problem, vector: Array, target: int, x: Array, y: Array, places: Array) -> list[PositionLine]:
    """Return the lines of `lines_of_position`; unknowns other than the place have their values in `vector` (size,)."""
    slot, _ = flat.layout.find(state_names(target, len(flat.motions), 0)[0])
    vectors = np.tile(vector, (len(places), 1))
    vectors[:, slot.start : slot.start + slot.size] = places[:, : slot.size]
    with np.errstate(all="ignore"):
        residual = differentiate(flat, vectors)[0]
    found: list[PositionLine] = []
    for rows, start in zip(flat.rows, flat.starts, strict=True):
        found += _lines_of(flat, rows, target, residual[:, start : start + rows.count], x, y)
    return found


def _only_target(flat: Problem, vectors: Array) -> int | None:
    """Return the index of the only unknown target; None if there are several or the target has no single fix.

    `vectors` (1, size) are the unknowns.
    """
    sought = [i for i, motion in enumerate(flat.motions) if motion.known is None]
    single = flat.batch_shape == (1,) and bool(np.isfinite(vectors).all())
    if len(sought) != 1 or not single or flat.motions[sought[0]].span == "epoch":
        return None
    return sought[0]


def _lines_of(problem: Problem, rows: Rows, target: int, residual: Array, x: Array, y: Array) -> list[PositionLine]:
    """Return the zero lines of residuals on a grid, for the rows of one kind and one target.

    `residual` (points, m) are the residuals of the m rows at the points of the grid, x fastest. `x` and `y` are the
    grid lines.
    """
    from contourpy import contour_generator

    model, names = MODELS[rows.kind], problem.stations.names
    present = (rows.weight.reshape(-1, rows.count)[0] > 0.0) & (rows.target == target)
    found = []
    for i in np.flatnonzero(present).tolist():
        values, ends = residual[:, i], [names[k] for k in (rows.a[i], rows.b[i]) if k >= 0]
        if model.emission:
            # The emission time is unknown, so subtract the residual of the first arrival: the difference is a measured
            # quantity.
            same = np.flatnonzero(present & (rows.epoch == rows.epoch[i]))
            first = same[np.argmin(rows.z.reshape(-1, rows.count)[0, same])]
            if first == i:
                continue
            values, ends = values - residual[:, first], [*ends, names[rows.a[first]]]
        if model.period is not None:
            # Behind a station, a bearing jumps by a full turn: mask this sign change, which is no line of position.
            values = np.where(np.abs(values) < 0.25 * model.period, values, np.nan)
        made = contour_generator(x, y, np.ma.masked_invalid(values.reshape(len(y), len(x)))).lines(0.0)
        found += [PositionLine(rows.kind, " – ".join(ends), np.asarray(line)) for line in made]
    return found


def isodopplers(problem: Problem, fix: Fix, x: Array, y: Array, places: Array) -> list[tuple[str, Array]]:
    """Return curves on which a range rate, or a difference of range rates, has the same value as at the fix.

    Parameters
    ----------
    problem : Problem
        A problem with one unknown target.
    fix : Fix
        Its fix.
    x, y : array (n,), (m,)
        Grid of a plan or a map.
    places : array (m n, d)
        Points of the grid in the frame of the problem, m; NaN for points without a position.

    Returns
    -------
    list of (str, array (p, 2))
        Names of at most nine rows, and their lines in x and y. The list is empty if the target moves during a run, or
        there is no fix.
    """
    from contourpy import contour_generator

    flat, answer = problem.flat(), fix.flat()
    rates = [rows for rows in flat.rows if MODELS[rows.kind].velocity]
    target = _only_target(flat, answer.x)
    if target is None or not rates or (flat.motions[target].order > 0 and flat.epochs > 1):
        return []
    # The last point is the fix; its value is the level of the curve.
    places = np.concatenate([places, answer.position.reshape(1, -1)])
    velocity = answer.velocity.reshape(-1) if flat.motions[target].order else np.zeros(flat.dimension)
    found = []
    # The zero lines of the value minus the value at the fix are the curves.
    for rows, row in _chosen_rows(rates, target):
        value = _rate(flat, rows, row, places, velocity)
        excess = np.ma.masked_invalid((value[:-1] - value[-1]).reshape(len(y), len(x)))
        ends = " – ".join(flat.stations.names[k] for k in (rows.a[row], rows.b[row]) if k >= 0)
        made = contour_generator(x, y, excess).lines(0.0)
        found += [(f"{rows.kind} {ends}, as at the fix", np.asarray(line)) for line in made]
    return found


def _chosen_rows(rates: Sequence[Rows], target: int) -> list[tuple[Rows, int]]:
    """Return the rows of a target with positive weight as pairs of rows and number.

    If there are more than `_CURVES` rows, only evenly chosen rows are returned.
    """
    present = [(rows.weight.reshape(-1, rows.count)[0] > 0.0) & (rows.target == target) for rows in rates]
    every = [(rows, i) for rows, mask in zip(rates, present, strict=True) for i in np.flatnonzero(mask).tolist()]
    return [every[i] for i in np.unique(np.linspace(0, len(every) - 1, min(_CURVES, len(every))).astype(int)).tolist()]


def _rate(problem: Problem, rows: Rows, row: int, places: Array, velocity: Array) -> Array:
    """Return the modelled value (n,) of a row, m/s, for a target at positions (n, d), m, with `velocity` (d,), m/s.

    `row` is the number of the row in `rows`. `places` are the positions.
    """

    def at(array: Array | None, index: int) -> tuple[float, ...]:
        # Position or velocity of a station at the epoch of the row; stations at rest have one epoch.
        if array is None:
            return (0.0,) * problem.dimension
        epoch = rows.epoch[row] if array.shape[-3] > 1 else 0
        return tuple(array.reshape(-1, *array.shape[-3:])[0, epoch, index].tolist())

    stations = problem.stations
    a, b = (Point(at(stations.position, i[row]), at(stations.velocity, i[row])) for i in (rows.a, rows.b))
    target = Point(tuple(places.T), tuple(velocity))
    with np.errstate(all="ignore"):
        # Use straight rays also for media with bent rays: the curve still passes through the fix.
        return np.asarray(MODELS[MODELS[rows.kind].straight or rows.kind].h(target, a, b))


def _at_height(problem: Problem, fix: Fix, plan: Array) -> Array:
    """Return points (n, d), m, in the frame of the problem, above a plan (n, 2) and at the height of the fix.

    Points beyond the horizon are NaN.
    """
    fixed = fix.position.reshape(1, -1)
    if problem.dimension == 2:
        return plan
    frame = local_frame(problem) or problem.frame
    if not frame.geodetic:
        return np.column_stack([plan, np.full(len(plan), fixed[0, 2])])
    height = float(problem.frame.to_geodetic(fixed)[2][0])
    return placed_points(problem, np.column_stack([plan, _third_coordinate(frame, plan, height)]))[0]


def _third_coordinate(frame: Frame, plan: Array, height: float) -> Array:
    """Return the third coordinate (n,), m, of points above a plan that have a given height above the ellipsoid.

    `frame` has the axes east, north and up, and `plan` (n, 2) are the first two coordinates, m. A point beyond the
    horizon gets NaN. The method is Newton iteration from the surface of a sphere.
    """
    across = np.linalg.norm(plan, axis=1)
    near = across < _STEEP
    centre = np.linalg.norm(frame.origin_ecef())
    up = np.full(len(plan), np.nan)
    up[near] = np.sqrt(centre**2 - across[near] ** 2) - centre
    for _ in range(_STEPS):
        at = np.column_stack([plan[near], up[near]])
        # Increase of the height for each metre along the third axis of the picture, for a spherical Earth.
        gain = (up[near] + centre) / np.hypot(across[near], up[near] + centre)
        up[near] -= (frame.to_geodetic(at)[2] - height) / gain
    return up
