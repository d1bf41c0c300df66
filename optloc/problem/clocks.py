"""Biases that change during a run: random walks with spectral densities or Allan deviations, and splines with knots.

Letters: q members of a bias, k epochs, p knots and c coefficients of a spline. `where` and `place` are the locations
that error messages name.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base.arrays import numbers
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Bias
from optloc.base.units import SPEED_OF_LIGHT

DEGREE = 3
"""Degree of the polynomials between knots. Cubic splines are smooth, and four coefficients matter at any time."""


# Splines: an error that is a smooth function of time.


def greville(bias: Bias) -> Array:
    """Return the times (c,), seconds, at which each coefficient of a spline is approximately the value of the spline.

    They are averages of consecutive knots (Greville abscissae).

    The spline starts of a fix and its output use these times.
    """
    assert bias.knots is not None
    full = _padded(bias.knots)
    return np.array([full[i + 1 : i + 1 + DEGREE].mean() for i in range(coefficients(bias.knots))])


def coefficients(knots: Array) -> int:
    """Return the number c of coefficients of a spline over knots (p,): p + 2 for cubic polynomials."""
    return len(knots) + DEGREE - 1


def spline_weights(knots: Array, times: Array) -> tuple[Array, Array]:
    """Return the indices (n, 4) of the spline coefficients that matter at times (n,), and their weights (n, 4).

    Parameters
    ----------
    knots : array (p,)
        Increasing times, seconds. The first and the last knot count four times, so that the spline ends there.
    times : array (n,)
        Times between the first and the last knot, seconds.

    References
    ----------
    C. de Boor, "A Practical Guide to Splines" (1978), chapters IX and X.
    """
    from scipy.interpolate import BSpline

    design = BSpline.design_matrix(times, _padded(knots), DEGREE)
    return design.indices.reshape(len(times), -1), design.data.reshape(len(times), -1)


def _padded(knots: Array) -> Array:
    """Return the knots (p + 6,) of the cubic spline basis, in which the first and the last knot occur four times."""
    return np.concatenate([np.full(DEGREE, knots[0]), knots, np.full(DEGREE, knots[-1])])


def with_knots(bias: Bias, times: Array, where: str, knots: Any) -> Bias:
    """Return the bias with the knots of a spline over a run.

    `times` (k,) are the epochs, seconds. `knots` gives the times of the knots, seconds, or their number. If it gives
    the number, the knots are evenly spaced. `where` is the location that messages name.

    Raises
    ------
    InvalidProblem
        If there are not at least two increasing knots, or if the run extends beyond them.
    """
    place = f"{where}, knots"
    if knots is None:
        raise InvalidProblem("a spline needs knots", place, "give their times in seconds, or their number")
    array = np.asarray(numbers(knots, place))
    if array.ndim == 0 and (array < 2 or array != round(float(array))):
        raise InvalidProblem(f"{knots} knots", place, "give two or more: the first and the last time are knots")
    if array.ndim == 0:
        return replace(bias, knots=np.linspace(times[0], times[-1], int(array)))
    if array.ndim != 1 or len(array) < 2 or not (np.diff(array) > 0.0).all():
        raise InvalidProblem("the knots are not two or more increasing times", place, "sort them")
    _check_knots(array, times, place)
    return replace(bias, knots=array)


def check_spline(bias: Bias, times: Array, where: str) -> None:
    """Raise if a spline has no increasing knots, or if the times (k,) extend beyond the knots."""
    knots = bias.knots
    if knots is None or knots.ndim != 1 or len(knots) < 2 or not (np.diff(knots) > 0.0).all():
        raise InvalidProblem("a spline has no increasing knots", where, "give two times or more")
    _check_knots(knots, times, f"{where}, knots")


def _check_knots(knots: Array, times: Array, place: str) -> None:
    """Raise if the run, with epochs at `times` (k,), extends beyond the knots (p,); both in seconds."""
    if times[0] < knots[0] or times[-1] > knots[-1]:
        what = f"the run lasts from {times[0]:.6g} to {times[-1]:.6g} s, beyond the knots"
        raise InvalidProblem(what, place, "let the first and the last knot enclose it")


# Random walks: the error, or its rate, is a sum of independent steps.


def rate_name(name: str) -> str:
    """Return the name of the unknown that is the rate of a walk, from the name of the walk."""
    return f"{name} rate"


def state_of(bias: Bias) -> tuple[str, ...]:
    """Return the names of the unknowns of a bias: its value and, if a walk has one, its rate.

    The number of names is the order of the walk: 1, or 2 with a rate.
    """
    return (bias.name, rate_name(bias.name))[: 1 if bias.density is None else bias.density.shape[1]]


def process(bias: Bias, times: Array) -> tuple[Array, Array]:
    """Return the transition matrices of a walk between epochs, and the covariances of its random steps.

    White noise of spectral density q1 drives the error. White noise of density q2 drives its rate. Over a time t they
    add ``q1 t + q2 t^3 / 3`` to the variance of the error and ``q2 t`` to the variance of its rate. Their covariance
    increases by ``q2 t^2 / 2``.

    Parameters
    ----------
    bias : Bias
        A walk with q members. Its order o is 1 (error only) or 2 (error and rate).
    times : array (k,)
        Seconds of the epochs.

    Returns
    -------
    transition : array (k - 1, o, o)
        Matrices from the state of an epoch to the state of the next.
    covariance : array (k - 1, q, o, o)
        Covariance of each step.

    References
    ----------
    A. J. van Dierendonck, J. B. McGraw, R. G. Brown, "Relationship between Allan variances and Kalman filter
    parameters", Proc. 16th PTTI (1984), eq. 16; R. G. Brown, P. Y. C. Hwang, "Introduction to Random Signals and
    Applied Kalman Filtering" (1997), eq. 10.3.
    """
    assert bias.density is not None
    step, order = np.diff(times), bias.density.shape[1]
    transition = np.broadcast_to(np.eye(order), (len(step), order, order)).copy()
    density, t = bias.density[:, 0], step[:, None]
    covariance = np.zeros((len(step), len(density), order, order))
    covariance[..., 0, 0] = density * t
    if order == 2:
        transition[:, 0, 1], rate_density = step, bias.density[:, 1]
        covariance[..., 0, 0] += rate_density * t**3 / 3.0
        covariance[..., 0, 1] = covariance[..., 1, 0] = rate_density * t**2 / 2.0
        covariance[..., 1, 1] = rate_density * t
    return transition, covariance


def with_densities(bias: Bias, times: Array, where: str, density: Any, rate_density: Any) -> Bias:
    """Return the bias with the spectral densities (q, 1 or 2) of a walk, one row for each member.

    Parameters
    ----------
    bias : Bias
        A walk with q members.
    times : array (k,)
        Seconds of the epochs.
    where : str
        Location that error messages name.
    density, rate_density : float or array (q,), optional
        Spectral densities of the white noise that drives the error (unit squared per second) and its rate (unit squared
        per second cubed). None: this noise is absent.
    """
    members = len(bias.members)
    if density is None and rate_density is None:
        advice = "give density, rate_density or both, for instance by optloc.problem.clock_densities"
        raise InvalidProblem("a walk needs a spectral density", where, advice)
    columns = []
    for values, name in ((density, "density"), (rate_density, "rate_density")):
        if values is None and name == "rate_density":
            continue
        array = np.asarray(numbers(0.0 if values is None else values, f"{where}, {name}"))
        if array.shape not in {(), (members,)}:
            raise InvalidProblem(f"{name} has shape {array.shape}", where, f"give one, or one for each of {members}")
        # The first density may be zero if there is a rate density. A walk without any noise is an offset.
        low = 0.0 if name == "density" and rate_density is not None else np.finfo(float).tiny
        if not (np.isfinite(array) & (array >= low)).all():
            raise InvalidProblem(f"{name} is not positive", where, "for a constant error use the form 'offset'")
        columns.append(np.broadcast_to(array, (members,)))
    return replace(bias, density=np.stack(columns, axis=1))


def clock_densities(tau: Any, deviation: Any, speed: float = SPEED_OF_LIGHT) -> tuple[float, float]:
    """Return the two spectral densities of a clock from its Allan deviations, for errors in metres.

    White noise and a random walk of the frequency give the Allan variance ``h1 / tau + h2 tau / 3``. h1 and h2 are the
    non-negative least-squares values for the relative errors of the Allan variances.

    Parameters
    ----------
    tau : float or array (n,)
        Averaging times, seconds.
    deviation : float or array (n,)
        Allan deviations of the relative frequency. With a single value the frequency noise counts as white.
    speed : float
        Metres per second that convert clock errors to metres.

    Returns
    -------
    density : float
        ``speed^2 h1``, square metres per second: the argument of `optloc.with_bias` for the form "walk".
    rate_density : float
        ``speed^2 h2``, square metres per second cubed.

    Raises
    ------
    InvalidProblem
        Unless there is one positive deviation for each positive time.

    References
    ----------
    D. W. Allan, "Time and frequency (time-domain) characterization, estimation, and prediction of precision clocks and
    oscillators", IEEE Trans. UFFC 34 (1987); L. Galleani, "A tutorial on the two-state model of the atomic clock
    noise", Metrologia 45 (2008) S175.
    """
    from scipy.optimize import nnls

    given = ((tau, "tau"), (deviation, "deviation"))
    times, sizes = (np.atleast_1d(np.asarray(numbers(value, name))) for value, name in given)
    if times.shape != sizes.shape or times.ndim != 1:
        what = f"{times.size} averaging times for {sizes.size} Allan deviations"
        raise InvalidProblem(what, "deviation", "give one deviation for each time")
    if not (np.isfinite(times * sizes) & (times > 0.0) & (sizes > 0.0)).all():
        raise InvalidProblem("a time or a deviation is not positive", "deviation", "give such as 1.0 s and 1e-9")
    # A single time determines one number only: h1. Then h2 is zero.
    design = np.stack([1.0 / times, times / 3.0], axis=1)[:, : min(2, len(times))]
    # Relative errors, so that a deviation of 1e-12 has the same weight as a deviation of 1e-9.
    fitted, _ = nnls(design / sizes[:, None] ** 2, np.ones(len(sizes)))
    h1, h2 = (*fitted.tolist(), 0.0)[:2]
    return speed**2 * h1, speed**2 * h2


def check_walk(bias: Bias, times: Array, where: str) -> None:
    """Raise if a walk has no valid densities, or if the times (k,) are only one epoch."""
    density = bias.density
    if density is None or density.shape not in {(len(bias.members), 1), (len(bias.members), 2)}:
        advice = f"give an array ({len(bias.members)}, 1), or with rates ({len(bias.members)}, 2)"
        raise InvalidProblem("a walk has no spectral densities", where, advice)
    if not (np.isfinite(density) & (density >= 0.0)).all() or not (density[:, -1:] > 0.0).all():
        raise InvalidProblem("a spectral density is not positive", where, "for a constant error use the form 'offset'")
    if len(times) == 1:
        raise InvalidProblem("a walk needs several epochs", where, "use the form offset")
