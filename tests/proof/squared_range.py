"""A measurement kind from another package, with its proof: the squared range, as some radars and sonars report power.

All there is to it is this file and one entry point, ``[project.entry-points."optloc.models"]`` with
``squared_range = "squared_range:KIND"``. Above is the node, what a proof must know of ``|x - a|^2``; below the kind.
"""

from math import sqrt

from optloc.kernels.jit import compiled
from optloc.models import Model
from optloc.proof.nodes.node import CONVEX, GROWS, Node, inner_product, reach, triple_at, turned_form, write_triple


@compiled
def bound(data, line, sense, half, slope):
    """Value and slope at the centre of a box; the remainder |sense s|^2 is between 0 and the reaches of its parts."""
    v, h = triple_at(line, 0), triple_at(half, 0)
    gradient = turned_form(v, sense)
    write_triple((2.0 * gradient[0], 2.0 * gradient[1], 2.0 * gradient[2]), slope)
    most = (
        reach(triple_at(sense[0], 0), h) ** 2
        + reach(triple_at(sense[1], 0), h) ** 2
        + reach(triple_at(sense[2], 0), h) ** 2
    )
    return inner_product(v, v), 0.0, most


@compiled
def curve(data, line, sense, half, curvature, turn):
    """The Hessian 2 sense'sense is the same everywhere, so it changes by nothing, and the gradient by its reaches."""
    h = triple_at(half, 0)
    for k in range(3):
        for m in range(3):
            entry = 0.0
            for i in range(3):
                entry += sense[i, k] * sense[i, m]
            curvature[k, m] = 2.0 * entry
        turn[k] = reach((curvature[k, 0], curvature[k, 1], curvature[k, 2]), h)
    return 0.0


@compiled
def size(data, reach):
    """Coordinates are subtracted and then squared."""
    return (reach + (abs(data[0]) + abs(data[1]) + abs(data[2]))) ** 2


@compiled
def ball(data, least, most):
    """Points whose squared range is at most `most` are within its root of the station."""
    return data[0], data[1], data[2], sqrt(max(most, 0.0))


def station(row):
    """Return the numbers of the node for a row: the station, three of them."""
    return row.place(row.a)


SQUARED = Node("squared_range", 3, 1, station, bound, curve, shape=CONVEX, infinity=GROWS, size=size, ball=ball)


def squared_range(t, a, b):
    """Return |t - a|^2, elementwise: the same function serves values, derivatives and symbols."""
    return sum((u - v) * (u - v) for u, v in zip(t.position, a.position, strict=True))


KIND = Model(squared_range, "plain", 1, "squared range r_a^2", nodes=((1.0, SQUARED),))
