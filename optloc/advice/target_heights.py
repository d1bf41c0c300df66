"""Explanations by heights: a target above the plane of the stations, and a wrong exact height."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from optloc.advice.change import Change, MisfitCase, Wording
from optloc.advice.fits import fit, in_base, joined
from optloc.advice.suspects import Suspects
from optloc.base import linalg
from optloc.base.types import Array, Band, Constraint
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import is_exact
from optloc.models import MODELS
from optloc.problem.problem import Problem


def heights(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield a free height of the target: outside the plane of a problem in two dimensions, or off its exact height."""
    base, k = case.base, len(case.times)
    if base.dimension == 2:
        kinds = [MODELS[kind] for kind in case.kinds]
        if all(model.ranges is not None and model.quantity == "length" for model in kinds) and _plain(base):
            yield Change("height", _slant_words, base=_in_space(base), extra=k)
        return
    free = tuple(c for c in base.constraints if not _is_height(c))
    if len(free) < len(base.constraints):
        each = Change("height", _height_words, base=replace(base, constraints=free), extra=k)
        yield each
        yield from _common_height(case, each)
    elif any(isinstance(c, Band) and is_exact(c) for c in base.constraints):
        count = sum(isinstance(c, Band) and is_exact(c) for c in base.constraints)
        words = partial(_constraint_words, ", ".join(dict.fromkeys(c.name for c in base.constraints)))
        yield Change("constraint", words, base=replace(base, constraints=()), extra=k * count)


def _is_height(constraint: Constraint) -> bool:
    """Return whether a constraint is an exact height, above the ellipsoid or along the third axis."""
    if not isinstance(constraint, Band) or not is_exact(constraint):
        return False
    return constraint.kind == "height" or (
        constraint.kind == "plane" and np.array_equal(constraint.coefficients, (0.0, 0.0, 1.0))
    )


def _common_height(case: MisfitCase, free: Change) -> Iterator[Change]:
    """Yield one other height of all epochs: the mean of their free heights, weighted by their variances."""
    stated = [c for c in case.base.constraints if _is_height(c)]
    if len(case.times) == 1 or len(stated) > 1 or not case.base.layout.shares("position"):
        return
    band, other = stated[0], in_base(case, free)
    assert isinstance(band, Band)
    found = fit(other, [free])
    if not np.isfinite(found.cost).all():
        return
    x, (slot, _) = found.x[0], other.base.layout.find("position")
    part = slice(slot.start, slot.start + slot.size)
    height, up = _height_at(case, band, x[:, part])
    root, _ = linalg.root(joined(other.base, equations_at(other.base, x))[0])
    variance = ((up[:, None] @ root[:, part])[:, 0] ** 2).sum(-1)
    level = float((height / variance).sum() / (1.0 / variance).sum())
    moved = replace(band, lower=np.array(level), upper=np.array(level))
    constraints = tuple(moved if c is band else c for c in case.base.constraints)
    words = partial(_common_words, level, float(np.sqrt(1.0 / (1.0 / variance).sum())))
    yield Change("height", words, base=replace(case.base, constraints=constraints), extra=1)


def _height_at(case: MisfitCase, band: Band, place: Array) -> tuple[Array, Array]:
    """Return the heights (K,) that a constraint limits at positions (K, d), and the directions (K, d) of their rise."""
    if band.kind == "plane":
        return place @ band.coefficients, np.broadcast_to(band.coefficients, place.shape)
    frame = case.base.frame
    return np.ravel(frame.to_geodetic(place)[2]), frame.enu_axes(place)[..., 2, :]


def _common_words(level: float, deviation: float, theta: Array, sigma: Array) -> Wording:
    seen = f"the values fit with a height of the target of {level:.6g} ± {deviation:.2g} m"
    return Wording(
        seen, "check the stated height: it is above the ellipsoid, not above the sea, and stations need heights, too"
    )


def _constraint_words(names: str, theta: Array, sigma: Array) -> Wording:
    seen = f"the values fit without the constraints ({names}), but no position was found that meets both"
    return Wording(seen, "check their values")


def _plain(base: Problem) -> bool:
    """Return whether a problem has only static stations and rows, so that a third axis can be added."""
    s = base.stations
    parts = (s.velocity, s.axes, s.covariance, s.velocity_covariance)
    motion = base.motions[0]
    return (
        all(part is None for part in parts)
        and not (base.priors or base.biases or base.constraints or base.fences)
        and len(base.motions) == 1
        and motion.order == 0
        and motion.known is None
        and base.medium is None
    )


def _in_space(base: Problem) -> Problem:
    """Return a problem of the plane with a third coordinate, which is zero for all stations."""
    place = base.stations.position
    zero = np.zeros((*place.shape[:-1], 1))
    return replace(base, stations=replace(base.stations, position=np.concatenate([place, zero], axis=-1)))


def _slant_words(theta: Array, sigma: Array) -> Wording:
    seen = "the values fit no point of the plane, but a target above or below it: they are slant ranges"
    return Wording(seen, "state the heights of the stations and of the target")


def _height_words(theta: Array, sigma: Array) -> Wording:
    seen = "the values fit without the stated height of the target"
    return Wording(
        seen, "check the height: it is above the ellipsoid, not above the sea, and stations need heights, too"
    )
