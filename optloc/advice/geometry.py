"""Ambiguities of the geometry (mirror images, rotations about a line) and missing redundancy, with advice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array, Band
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import is_exact, violation
from optloc.linear.redundancy import degrees_of_freedom
from optloc.model_checks.cause import Advice
from optloc.model_checks.score import descend, one_place
from optloc.models import MODELS
from optloc.problem.chart import tail_probability
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.noise import variances
from optloc.problem.problem import Problem

# Limit of the chi-square that separates a position from its mirror image, if stations are not exactly in a plane. Below
# the limit, the data separate no position from its image by three sigma.
_SEPARATED = 9.0
# Share of the extent of the stations that counts as zero with any noise: a micrometre per metre.
_FLAT = 1e-6
# Chi-square probability below which the data refute a fix, as for the status `misfit`.
_REFUTED = 1e-4
# Share of the extent of the stations that is rounding of their coordinates.
_ROUNDING = 1e-12
# Height of stations above the ellipsoid, m, below which they may be in the sea: without a map of the
# ground, a target below them is possible.
_DRY = 0.5
# Cosine above which a normal counts as an axis of the frame, so that a box can exclude one side of the plane.
_ALONG = 0.999


def advise_on_geometry(problem: Problem, x: Array) -> Iterator[Advice]:
    """Yield advice about positions of stations and numbers of rows that leave the position ambiguous.

    `problem` is a flat batch of one problem or run. `x` (1, size) is its fix; NaN if there is no fix.
    """
    found = list(_redundancy_advice(problem))
    yield from found
    # with fewer rows than unknowns, more than two positions fit
    if not any("fewer" in one.seen for one in found):
        yield from _mirror_advice(problem, x)


def _redundancy_advice(problem: Problem) -> Iterator[Advice]:
    """Yield advice if the smallest redundancy of the epochs is at most 1.

    Without redundancy, no error is detectable. With a redundancy of 1, an error is detectable, but the wrong row is not
    identifiable.
    """
    separate = separable(problem)
    dof = np.ravel(degrees_of_freedom(by_epoch(problem) if separate else problem))
    least, k = int(dof.min()), len(dof)
    if least > 1:
        return
    count = int((dof == least).sum())
    where = f"{count} of {k} epochs {'has' if count == 1 else 'have'}" if k > 1 else "the rows have"
    if least < 0:
        seen = f"{where} {-least} measurement{'s' if least < -1 else ''} fewer than unknowns"
        yield Advice("redundancy", seen, "add rows, or state known quantities: a height, a bias, a prior")
    elif least == 0:
        seen = f"{where} no redundancy: all values fit, even wrong values"
        yield Advice("redundancy", seen, "add a row, or better two: one row detects an error, two rows identify it")
    else:
        seen = f"{where} a redundancy of 1: an error is detectable, but the wrong row is not identifiable"
        yield Advice("redundancy", seen, "add a row")


# Stations in a plane or on a line.


@dataclass(frozen=True, slots=True)
class _Shape:
    """Stations with present rows, relative to their centre.

    - places (s, d): positions, m.
    - centre (d,): their mean, m.
    - extent (d,): RMS extents along the principal axes, in ascending order, m.
    - axes (d, d): directions of the principal axes in columns; the first is the normal of the best-fitting plane.
    """

    places: Array
    centre: Array
    extent: Array
    axes: Array

    @property
    def height(self) -> Array:
        """Return the distances (s,) of the stations from their best-fitting plane or line, m."""
        return np.asarray((self.places - self.centre) @ self.axes[:, 0])


def _shape(problem: Problem) -> _Shape | None:
    """Return the shape of the stations with present rows; None if a row is more than a function of ranges."""
    numbers, weight = set(), np.broadcast_to(problem.weight, (1, problem.count))[0]
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        model = MODELS[rows.kind]
        # angles and heights distinguish above from below, and range rates of moving stations may do so
        if model.axes or model.velocity or model.ecef or not model.stations:
            return None
        present = weight[start : start + rows.count] > 0.0
        numbers |= {int(i) for index in (rows.a, rows.b)[: model.stations] for i in index[present]}
    if len(numbers) < 2 or problem.fences or any(prior.name.startswith("position") for prior in problem.priors):
        return None
    places = problem.stations.position[..., sorted(numbers), :].reshape(-1, problem.dimension)
    centre, _ = centre_and_spread(places)
    values, vectors = np.linalg.eigh((places - centre).T @ (places - centre) / len(places))
    return _Shape(places, centre, np.sqrt(np.maximum(values, 0.0)), vectors)


def _noise(problem: Problem) -> float:
    """Return the smallest positive standard deviation of present rows that are lengths, m; zero without lengths."""
    sigma = np.sqrt(variances(problem.noise, problem.count)).reshape(-1, problem.count)[0]
    weight = np.broadcast_to(problem.weight, (1, problem.count))[0]
    lengths = np.concatenate([np.full(r.count, MODELS[r.kind].quantity == "length") for r in problem.rows])
    lengths_sigma = sigma[lengths & (weight > 0.0) & (sigma > 0.0)]
    return float(lengths_sigma.min()) if len(lengths_sigma) else 0.0


def _mirror_advice(problem: Problem, x: Array) -> Iterator[Advice]:
    """Yield advice if the stations are in a plane or on a line, or if the mirror image of a fix fits.

    `x` (1, size) is the fix; NaN if there is no fix.
    """
    shape = _shape(problem)
    if shape is None or shape.extent[-1] == 0.0:
        return
    # whether the stations have no extent along each principal axis, in ascending order of the extent
    d, flat = problem.dimension, np.array([_is_flat(problem, shape, i) for i in range(problem.dimension)])
    # noise as large as the whole array says nothing about the shape of the array
    if flat[-1] or _one_side(problem, shape):
        return
    if flat[0] and not (d == 3 and flat[1]) and _equality_excludes_image(problem, shape):
        return
    if d == 3 and flat[1]:
        axis = _spell(shape.axes[:, -1])
        seen = f"the stations are on one line along {axis}: a rotation about it changes no measurement"
        yield Advice("line", seen, "add a station off the line, or a bearing or height")
    elif flat[0]:
        name = "plane" if d == 3 else "line"
        seen = f"the stations are {'in one plane' if d == 3 else 'on one line'} within the noise"
        seen += (
            f" ({_describe_offset(shape)}): every position has a mirror image across the {name} that fits equally well"
        )
        yield Advice(name, seen, _side_advice(problem, shape)[0], _side_advice(problem, shape)[1])
    elif _mirror_fits(problem, shape, x):
        name = "plane" if d == 3 else "line"
        seen = f"the mirror image of the fix in the best-fitting {name} of the stations ({_describe_offset(shape)})"
        seen += " fits almost equally well"
        yield Advice("mirror", seen, _side_advice(problem, shape)[0], _side_advice(problem, shape)[1])


# Heights above the plane of the stations at which both sides are tested, in extents of the stations.
_HEIGHTS = (0.01, 0.1, 0.3, 1.0, 3.0)


def _one_side(problem: Problem, shape: _Shape) -> bool:
    """Return whether the constraints exclude one side of the plane of the stations."""
    if not problem.constraints or not problem.layout.shares("position") or problem.epochs != 1:
        return False
    slot, _ = problem.layout.find("position")
    steps = shape.extent[-1] * np.array(_HEIGHTS)[:, None] * shape.axes[:, 0]
    inside = []
    for sign in (1.0, -1.0):
        x = np.zeros((len(steps), problem.layout.size))
        x[:, slot.start : slot.start + problem.dimension] = shape.centre + sign * steps
        inside.append(bool((violation(problem.take(np.zeros(len(steps), dtype=int)), x) <= 0.0).any()))
    return inside[0] != inside[1]


# Share of the normal in the gradient of an equality above which a mirror image violates the equality.
_ACROSS = 0.1


def _equality_excludes_image(problem: Problem, shape: _Shape) -> bool:
    """Return whether an equality, an exact height or plane, excludes mirror images in the plane of the stations."""
    normal = shape.axes[:, 0]
    for band in problem.constraints:
        if not isinstance(band, Band) or not is_exact(band):
            continue
        if band.kind == "plane":
            c = band.coefficients.reshape(-1, band.coefficients.shape[-1])[0]
            # distance of the centre of the stations from the plane, times the length of c
            off = np.abs(band.lower - c @ shape.centre[: len(c)]).min()
            if abs(float(c @ normal[: len(c)])) > _ACROSS * float(np.linalg.norm(c)) and off > 0.0:
                return True
        if band.kind == "height" and abs(float(problem.frame.enu_axes(shape.centre)[2] @ normal)) > _ACROSS:
            return True
        if band.kind == "terrain" and abs(float(normal[2])) > _ACROSS:
            return True
    return False


def _is_flat(problem: Problem, shape: _Shape, axis: int) -> bool:
    """Return whether the data separate no position from its mirror image across an axis by three sigma.

    `axis` is the number of a principal axis of the stations: 0 is the normal of their best-fitting plane. The result is
    also True if the extent of the stations along the axis is negligible.
    """
    height = (shape.places - shape.centre) @ shape.axes[:, axis]
    # a mirror image changes a range by at most twice the height of the station
    noise = _noise(problem)
    separation = np.inf if noise == 0.0 else float(((2.0 * height / noise) ** 2).sum())
    return bool(separation < _SEPARATED or shape.extent[axis] < _FLAT * shape.extent[-1])


def _describe_offset(shape: _Shape) -> str:
    """Return a text with the RMS distance of the stations from their plane or line, and their extent, m."""
    off, size = float(np.sqrt((shape.height**2).mean())), float(shape.extent[-1])
    return f"{off if off > _ROUNDING * size else 0.0:.2g} m off it, over {size:.3g} m"


def _mirror_fits(problem: Problem, shape: _Shape, x: Array) -> bool:
    """Return whether the mirror image of a fix `x` (1, size) leads to a second minimum that fits almost as well.

    The cost of the second minimum exceeds the cost of the fix by less than nine. The minimum must be on the other side
    of the plane and satisfy the constraints.
    """
    if not one_place(problem) or not np.isfinite(x).all() or not _fits(problem, x):
        return False
    slot, _ = problem.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    height = float((x[0, part] - shape.centre) @ shape.axes[:, 0])
    image = np.array(x)
    image[0, part] -= 2.0 * height * shape.axes[:, 0]
    both, cost = descend(problem.take(np.zeros(2, dtype=int)), np.concatenate([x, image]))
    after = (both[:, part] - shape.centre) @ shape.axes[:, 0]
    inside = not problem.constraints or bool((violation(problem, both[1:]) <= 0.0).all())
    # the descent must stay on the other side, and not return to the plane
    return bool(
        after[0] * after[1] < 0.0 and abs(after[1]) > 0.1 * abs(height) and cost[1] - cost[0] < _SEPARATED and inside
    )


def _fits(problem: Problem, x: Array) -> bool:
    """Return whether the data accept a fix; the image of a refuted fix says nothing about the geometry."""
    cost, dof = equations_at(problem, x).cost, degrees_of_freedom(problem)
    return bool(dof[0] < 1 or tail_probability(np.atleast_1d(cost), np.atleast_1d(dof))[0] >= _REFUTED)


def _side_advice(problem: Problem, shape: _Shape) -> tuple[str, str]:
    """Return advice on how to decide between the sides of the plane, and the lines of a problem file for it."""
    if problem.constraints:
        return "check if a constraint excludes one of the two, or add a station off it, a bearing or a height", ""
    normal = shape.axes[:, 0]
    if problem.frame.geodetic:
        # a target below stations at sea level is in the water
        if float(np.min(problem.frame.to_geodetic(shape.places)[2])) < _DRY:
            return "state the height or the depth of the target; or add a station off it, a bearing or a height", ""
        advice = "if the target is above ground, use `--above-ground`; or add a station off it"
        return f"{advice}, a bearing or a height", '[[constraints]]\nkind = "above-ground"\n'
    axis = int(np.argmax(np.abs(normal)))
    if abs(normal[axis]) < _ALONG:
        return "add a station off it, a bearing, or a constraint that excludes one side", ""
    # only the user can know the side: the lines select the upper side
    low = ["-inf"] * problem.dimension
    low[axis] = f"{float(shape.centre[axis]):.6g}"
    high, bound = ["inf"] * problem.dimension, ",".join(low)
    advice = f"state the side of the target, here {'xyz'[axis]} above {low[axis]} m: "
    advice += f"`--box={bound}:{','.join(high)}`; or add a station off it or a bearing"
    box = f'[[constraints]]\nkind = "box"\nmin = [{", ".join(low)}]\nmax = [{", ".join(high)}]\n'
    return advice, box


def _spell(vector: Array) -> str:
    """Return a vector as text with two decimals."""
    return "(" + ", ".join(f"{v:.2f}" for v in vector) + ")"
