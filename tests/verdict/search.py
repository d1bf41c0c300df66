"""An independent search for what a verdict may have missed: SciPy's least squares from many places, and plain costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from descent import EXACT, levenberg
from scipy.optimize import least_squares
from scipy.stats import chi2
from verdict.scenes import Scene

from optloc import Fix, Status

Array = np.ndarray
# A minimum is found where the next Gauss-Newton step is shorter than this many standard deviations.
FINISHED = 1e-3
# Cost that two ways to compute it may differ by, relative: ten times what a certificate counts as equal.
EQUAL = 1e-5
# Gap within which another minimum forbids `ok`, less a share for two ways to compute it.
GAP = 9.0 - 1e-3


@dataclass(frozen=True)
class Found:
    """A minimum.

    Parameters
    ----------
    cost : float
        Weighted sum of squared residuals.
    x : array (d,)
        Where it is, metres.
    information : array (d, d)
        J'J there.
    """

    cost: float
    x: Array
    information: Array

    def apart(self, other: Array) -> float:
        """Return the squared distance of another point in standard deviations of this one."""
        away = other - self.x
        return float(away @ self.information @ away)


def minima(scene: Scene, rng: np.random.Generator, near: Array, starts: int = 24) -> list[Found]:
    """Return the minima that SciPy finds from many places, cheapest first.

    Parameters
    ----------
    scene : Scene
        What is searched.
    rng : Generator
        Draws the places.
    near : array (q, d)
        Places to begin with too: answers that are questioned, and their surroundings.
    starts : int
        How many random places: a tenth to a thousand times the size of the stations away, any direction.
    """
    d = len(scene.truth)
    ahead = rng.standard_normal((starts, d))
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    away = scene.size * 10.0 ** rng.uniform(-1.0, 3.0, (starts, 1))
    places = np.concatenate([scene.centre + ahead * away, scene.truth[None], near, *_beside(scene, near)])
    found: list[Found] = []
    for place in places:
        one = _descend(scene, place)
        if one is not None and not any(one.apart(other.x) < 1e-2 or other.apart(one.x) < 1e-2 for other in found):
            found.append(one)
    return sorted(found, key=lambda one: one.cost)


def _beside(scene: Scene, near: Array) -> list[Array]:
    """Return mirror images in the stations' best plane, and places nearer and farther on the line to the centre."""
    away = near - scene.centre
    _, _, axes = np.linalg.svd(scene.stations - scene.centre)
    mirrored = near - 2.0 * (away @ axes[-1])[:, None] * axes[-1]
    return [mirrored, *(scene.centre + share * away for share in (-1.0, 0.2, 0.5, 2.0, 5.0, 30.0))]


def _descend(scene: Scene, place: Array) -> Found | None:
    """Return the minimum that is reached from a place, or None where none is."""
    unit, d = scene.size, len(place)
    free = d - 1 if scene.level is not None else d

    def at(y: Array) -> Array:
        x = scene.centre + unit * y
        return np.append(x[:free], scene.level) if scene.level is not None else x

    def residual(y: Array) -> Array:
        return scene.residual(at(np.append(y, 0.0) if free < d else y))

    def slope(y: Array) -> Array:
        return unit * scene.slope(at(np.append(y, 0.0) if free < d else y))[:, :free]

    start, bounds = ((place - scene.centre) / unit)[:free], None
    if scene.corners is not None:
        bounds = tuple((scene.corners - scene.centre) / unit)
        start = np.clip(start, bounds[0] + 1e-9, bounds[1] - 1e-9)
    with np.errstate(all="ignore"):
        try:
            if bounds is None and len(scene.rows) >= free:
                end = levenberg(residual, start, slope)
            else:
                end = least_squares(residual, start, slope, bounds or (-np.inf, np.inf), x_scale="jac", **EXACT)
        except (ValueError, np.linalg.LinAlgError):  # it ran off to where nothing is finite
            return None
        information = end.jac.T @ end.jac
        step = np.linalg.pinv(information) @ (end.jac.T @ end.fun)
        inside = bounds is None or (np.abs(end.active_mask) == 0).all()
        if inside and not step @ information @ step < FINISHED**2:
            return None
    x = at(np.append(end.x, 0.0) if free < d else end.x)
    full = np.zeros((d, d))
    full[:free, :free] = information / unit**2
    return Found(2.0 * end.cost, x, full)


@dataclass(frozen=True)
class Judgement:
    """What is wrong with an answer.

    Parameters
    ----------
    status : Status
        What it says.
    cheaper, rival : str
        A cheaper minimum, or another within the gap that is not listed, in words; "" where there is none.
    squared : float
        Squared distance of the truth in standard deviations; NaN without a covariance.
    """

    status: Status
    cheaper: str
    rival: str
    squared: float

    @property
    def wrong(self) -> bool:
        """Whether it is `ok` though a minimum contradicts it."""
        return self.status is Status.OK and bool(self.cheaper or self.rival)

    def beyond(self, level: float, d: int) -> bool:
        """Return whether the truth lies outside the ellipsoid of a level."""
        return bool(self.squared > chi2.ppf(level, d))


def judge(scene: Scene, fix: Fix, rng: np.random.Generator, starts: int = 24) -> Judgement:
    """Return what an independent search says of an answer."""
    status = Status(int(fix.code))
    x = np.asarray(fix.position)
    if not np.isfinite(x).all() or not bool(fix.answered):
        return Judgement(status, "", "", np.nan)
    d = len(x)
    listed = np.asarray(fix.alternatives.x)[..., :d]
    listed = listed[np.isfinite(listed).all(-1)]
    found = minima(scene, rng, np.concatenate([x[None], listed]), starts)
    cost = scene.cost(x)
    cheaper = [one for one in found if one.cost < cost - EQUAL * (1.0 + cost)]
    spread = np.linalg.pinv(np.asarray(fix.covariance()))
    away = scene.truth - x
    squared = float(away @ spread @ away) if np.isfinite(spread).all() else np.nan
    known = [x, *listed]
    others = [
        one
        for one in found
        if one.cost < cost + GAP and (one.x - x) @ spread @ (one.x - x) > 1.0 and min(map(one.apart, known)) > 1.0
    ]
    return Judgement(status, _say(cheaper, cost), _say(others, cost), squared)


def _say(found: list[Found], cost: float) -> str:
    return f"cost {found[0].cost:.6g} at {found[0].x}, not {cost:.6g}" if found else ""
