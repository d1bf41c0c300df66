"""Range rates of a fixed target over a box: the component of the station's velocity along the line of sight.

A rate is ``n.w / |n|``, with n the line from the station and w the reversed velocity of the station. This quotient of
a linear form and a range depends on the direction of the line only, so it stays finite and smooth at infinity.
"""

from __future__ import annotations

from math import sqrt

from optloc.base.types import Array
from optloc.kernels.jit import compiled
from optloc.proof.nodes.node import (
    SCALED,
    Node,
    NodeRow,
    inner_product,
    is_zero_slope,
    lay_out,
    length,
    length_across,
    range_form,
    range_hessian,
    reach,
    sum_of_forms,
    triple_at,
    turned_form,
    unbounded_curvature,
    write_symmetric,
    write_triple,
)
from optloc.proof.nodes.ratio import quotient_hessian, quotient_remainder

# Numbers: the station, and its reversed velocity.
STATION, VELOCITY, RATE_WIDTH = 0, 3, 6


@compiled
def bound_rate(data: Array, line: Array, sense: Array, half: Array, slope: Array) -> tuple[float, float, float]:
    """Bound a range rate over a box, m/s (see `optloc.proof.nodes.node`), in two ways: as a quotient, and by a cone.

    The cone contains the directions from the station to the points of the box. The narrower bound is the result.
    """
    h, n, w = triple_at(half, 0), triple_at(line, 0), triple_at(data, VELOCITY)
    r, u, least, most, far = range_form(line, sense, h)
    phi = inner_product(w, n) / r if r > 0.0 else 0.0
    low, high = _cone(phi, length(w), least, length_across(sense, u, h))
    if least > 0.0:
        g = sum_of_forms(1.0 / r, turned_form(w, sense), -phi / r, u)
        less, more = quotient_remainder(phi, g, u, most, (0.0, 0.0), (least, far), h)
        # Otherwise a constant interval for the whole box is tighter than a slope with its remainder.
        if more - less <= high - low:
            write_triple(g, slope)
            return phi, less, more
    slope[0] = slope[1] = slope[2] = 0.0
    return phi, low - phi, high - phi


@compiled
def _cone(phi: float, speed: float, least: float, aside: float) -> tuple[float, float]:
    """Return the least and greatest rate, m/s, over all directions from the station to the points of a box.

    `phi` is the rate at the centre and `speed` the speed of the station, m/s. The directions are in a cone around the
    direction to the centre. Along it, lines are at least `least` long; across it, at most `aside`.
    """
    if not (least > 0.0 and speed > 0.0):
        return -speed, speed
    size = sqrt(least * least + aside * aside)
    cosine, sine, along = least / size, aside / size, phi / speed
    beside = sqrt(max(0.0, 1.0 - along * along))
    # If the cone contains the direction of the velocity, the rate is the speed.
    high = 1.0 if along >= cosine else along * cosine + beside * sine
    low = -1.0 if along <= -cosine else along * cosine - beside * sine
    return speed * low, speed * high


@compiled
def curve_rate(data: Array, line: Array, sense: Array, half: Array, curvature: Array, turn: Array) -> float:
    """Bound the second derivatives of a range rate over a box (see `optloc.proof.nodes.node`)."""
    h, n, w = triple_at(half, 0), triple_at(line, 0), triple_at(data, VELOCITY)
    bound_rate(data, line, sense, half, turn)
    r, u, least, most, _ = range_form(line, sense, h)
    if is_zero_slope(turn) or not least > 0.0:
        return unbounded_curvature(curvature, turn)
    phi = inner_product(w, n) / r
    second, ds, chi, norm = range_hessian(sense, h, r, u, least, most)
    g = sum_of_forms(1.0 / r, turned_form(w, sense), -phi / r, u)
    changes = ((0.0, 0.0, 0.0), ds, 0.0, chi, norm, reach(u, h) + most)
    flat = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # a linear form has no curvature
    own, wander, chi = quotient_hessian(g, u, (phi, r, least), changes, h, flat, second)
    write_symmetric(own, curvature)
    write_triple(wander, turn)
    return chi


@compiled
def _size(data: Array, reach: float) -> float:
    """Return the size of the terms of a rate, m/s: a bound of the speed of the station, which limits the accuracy."""
    return float(abs(data[VELOCITY]) + abs(data[VELOCITY + 1]) + abs(data[VELOCITY + 2]))


def _numbers(row: NodeRow) -> Array:
    """Return the numbers (B, n) of the range-rate node of a row."""
    # For a fixed target, the relative velocity is the reversed velocity of the station.
    return lay_out({STATION: row.place(row.a), VELOCITY: -row.velocity(row.a)})


RATE_OF_RANGE = Node(
    "range_rate", RATE_WIDTH, 1, _numbers, bound_rate, curve_rate, infinity=SCALED, size=_size, of_station=True
)
