"""The probability that a target is in a region, under the posterior law of its fix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.records import take
from optloc.base.types import Array, Band, Fence, Motion, Stations
from optloc.linear.constraints.quantities import is_exact, needs_velocity
from optloc.linear.constraints.violation import violation
from optloc.problem.chart import CARTESIAN, CURVED, INVERSE_RANGE
from optloc.problem.constraint_checks import check_constraints
from optloc.problem.fix import Fix
from optloc.problem.noise import Noise
from optloc.problem.problem import Problem
from optloc.problem.truncated import Truncated

# Decimal digits of an integrated probability: one more than its accuracy, and far above the rounding of a processor.
_DIGITS = 4
# Points that are tested at a time: their distances from a polygon of a hundred edges take some tens of megabytes.
_PART = 2**13


def chance(fix: Fix, region: Any) -> Array:
    """Return the probability (...) that the target is in a region, under the posterior law of its fix.

    The law is the law of `Fix.covers`: a Gaussian in metres or in inverse range, truncated at bounds, or multiplied by
    the probabilities of fences. The prior density of the position is flat. The region is a statement about the result,
    so it does not change the fix. To impose it, give it to `optloc.assemble`.

    One half-plane or slab has a closed form if the law is a Gaussian in metres. All other probabilities are integrated
    over fixed points: their error is below 0.001, and they are rounded to four decimals.

    Parameters
    ----------
    fix : Fix
        One fix or a batch (...).
    region : constraint, or sequence of constraints
        Results of the functions in `optloc.constraints`, all of which must hold. They depend on the position of one
        target alone. Their numbers may have the batch axes of the fix.

    Returns
    -------
    array (...)
        NaN for fixes without a covariance, and for fixes whose law is not known (`curved`).

    Raises
    ------
    InvalidProblem
        If the region is empty or exact, or depends on a velocity. Also if it belongs to several targets, or to a
        target with one position for each epoch.
    """
    demands = tuple(c for given in _listed(region) for c in _listed(given))
    name = _position_name(fix, demands)
    frame = _frame_for(fix, tuple(replace(c, target=0) for c in demands))
    position, covariance = fix.take(name), fix.covariance(name)
    out = np.full(fix.shape, np.nan)
    for i in np.ndindex(fix.shape):
        if np.isfinite(position[i]).all() and np.isfinite(covariance[i]).all():
            one = frame if not frame.batch_shape else frame.take(np.array([np.ravel_multi_index(i, fix.shape)]))
            out[i] = _chance(fix, i, one, position[i], covariance[i])
    return out[()]


def _listed(value: Any) -> Sequence[Any]:
    """Return a list or tuple unchanged, and another value as its only member."""
    return value if isinstance(value, tuple | list) else (value,)


def _position_name(fix: Fix, demands: tuple[Any, ...]) -> str:
    """Return the name of the position that a region bounds; raise if it bounds something else."""
    if not demands:
        raise InvalidProblem("the region is empty", "region", "give at least one constraint")
    for one in demands:
        if not hasattr(one, "target") or not hasattr(one, "name"):
            raise InvalidProblem(f"{one!r} is not a constraint", "region", "use the functions of optloc.constraints")
        if needs_velocity(one):
            what = f"the constraint {one.name!r} depends on the velocity"
            raise InvalidProblem(what, "region", "give constraints of the position alone")
        if is_exact(one):
            what = f"the constraint {one.name!r} is an equality, whose probability is zero"
            raise InvalidProblem(what, "region", "give a lower and an upper bound")
        if isinstance(one, Fence):
            what = f"{one.name!r} is an uncertain fence, which has no edge"
            raise InvalidProblem(what, "region", "give a half-plane")
    targets = {one.target for one in demands}
    if len(targets) > 1:
        raise InvalidProblem("the region belongs to several targets", "region", "give the constraints of one target")
    names, target = {slot.name for slot in fix.layout.shared}, targets.pop()
    for name in ("position",) if target == 0 and "position" in names else (f"position[{target}]",):
        if name in names:
            return name
    what = f"the fix has no position of target {target} that all epochs share"
    raise InvalidProblem(what, "region", "solve epoch by epoch, or give another target")


def _frame_for(fix: Fix, demands: tuple[Any, ...]) -> Problem:
    """Return a flat problem without rows, which has the frame of a fix and the region as its constraints."""
    d = fix.take(next(s.name for s in fix.layout.shared if s.name.partition("[")[0] == "position")).shape[-1]
    stations = Stations(np.zeros((1, 1, d)), ("none",))
    problem = Problem(stations, (), Noise(()), np.zeros(1), (Motion(),), frame=fix.frame, constraints=demands)
    check_constraints(problem)
    if problem.batch_shape not in ((), fix.shape):
        what = f"the region has batch axes {problem.batch_shape}, and the fix has {fix.shape}"
        raise InvalidProblem(what, "region", "give numbers without batch axes, or with the batch axes of the fix")
    return problem.flat() if problem.batch_shape else problem


def _chance(fix: Fix, i: tuple[int, ...], frame: Problem, position: Array, covariance: Array) -> float:
    """Return the probability of the region for fix number i with its position (d,) and covariance (d, d)."""
    if fix.chart is None:
        points, weight = _gaussian(np.zeros_like(position), covariance).nodes()
        return _share(frame, position + points, weight)
    chart = take(fix.chart, i)
    if chart.kind == CURVED:
        return np.nan
    if chart.kind == INVERSE_RANGE:
        points, weight = _gaussian(np.zeros_like(position), chart.spread).nodes()
        places = chart.to_position(chart.mean + points)
        # points behind the centre have no position, and are not in the region
        known = np.asarray(np.isfinite(places).all(-1))
        return _share(frame, np.where(known[:, None], places, position), weight, known)
    law, skew = chart.truncated, chart.skew
    if law is not None and bool(chart.cut_off):
        points, weight = law.nodes()
        return _share(frame, position + points, weight)
    if skew is not None and bool(skew.matters):
        points, weight = _gaussian(skew.shift, skew.covariance).nodes()
        return _share(frame, position + points, weight * skew.probability(points))
    assert chart.kind == CARTESIAN
    return _closed(frame, position, covariance)


def _closed(frame: Problem, position: Array, covariance: Array) -> float:
    """Return the probability of the region under a Gaussian in metres; in closed form for one half-plane or slab."""
    from scipy.special import ndtr

    band = frame.constraints[0]
    if len(frame.constraints) > 1 or not isinstance(band, Band) or band.kind != "plane":
        points, weight = _gaussian(np.zeros_like(position), covariance).nodes()
        return _share(frame, position + points, weight)
    # an edge of a polygon in space has two coefficients
    normal = np.ravel(band.coefficients)
    part = slice(0, len(normal))
    sigma = np.sqrt((normal[:, None] * covariance[part, part] * normal).sum())
    lower, upper = (float(np.ravel(bound)[0]) - (normal * position[part]).sum() for bound in (band.lower, band.upper))
    if sigma == 0.0:  # an equality fixes the position along the normal
        return float(lower <= 0.0 <= upper)
    return float(ndtr(upper / sigma) - ndtr(lower / sigma))


def _gaussian(shift: Array, covariance: Array) -> Truncated:
    """Return a normal law with mean `shift` (d,), metres from the fix, as a truncated law without bounds."""
    d = len(shift)
    none, ends = np.zeros((0, d)), np.zeros((0, 2))
    return Truncated(none, np.zeros(0), none, ends, np.zeros(0), shift, covariance)


def _share(frame: Problem, points: Array, weight: Array, known: Array | bool = True) -> float:
    """Return the share of the weights (p,) that belongs to points (p, d) in the region; `known` (p,) are usable."""
    with np.errstate(all="ignore"):
        parts = [violation(frame, points[i : i + _PART]) <= 0.0 for i in range(0, len(points), _PART)]
    inside = np.concatenate(parts)
    return float(np.round((weight * (inside & known)).sum() / weight.sum(), _DIGITS))
