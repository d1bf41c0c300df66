"""Rows of angles and gain ratios that are linear in the position and one more coordinate.

The coordinates are ``y = ((x - origin) / scale, last)``. The last coordinate is the range to a reference station, or
the squared distance from the origin. The start of a fix solves these linear rows together with the squared ranges. Each
row has one elementwise formula, which serves arrays and is recorded as a tape for machine code.

Letters: m is the measured value of a row, a and b are its stations, d is the number of coordinates. `known` and `found`
are ranges ``offset + sign t`` from other rows, with the last coordinate t.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from optloc.base.cache import Cache
from optloc.base.types import Array, Rows
from optloc.kernels.tables import starts
from optloc.kernels.tape_table import TapeTable, tape_table
from optloc.kernels.trace import Recorder, Symbol, Tape, tape
from optloc.linear.least_squares_ranges import Ranges
from optloc.models import MODELS, Model, distance, lifted_row, namespace
from optloc.models.primitives import Components, Point, dot
from optloc.problem.noise import variances
from optloc.problem.problem import Problem


class LiftEntry(NamedTuple):
    """One linear row ``x . position + last y_last = right``.

    Parameters
    ----------
    x : tuple of d numbers
        Coefficients of the scaled position.
    last, right : number
        Coefficient of the last coordinate, and the right side.
    factor : callable
        Maps the scaled position to the error of the row per unit of measurement error. The sign has no meaning.
    """

    x: Components
    last: Any
    right: Any
    factor: Callable[[Point], Any]


class KnownLift(NamedTuple):
    """A known range ``offset + sign t`` that replaces an unknown range in a row; t is the last coordinate."""

    offset: Any
    sign: Any


def pair_elevation(m: Any, azimuth: Any, a: Point) -> LiftEntry:
    """Return the linear row of an elevation E with its azimuth A: ``[sin E cos A, sin E sin A, -cos E] . (x - s) = 0``.

    Here `m` is the elevation, radians, and `a` is the station at s. The vector in brackets is in the axes of the
    station. It is the normal of the cone of elevation E at the measured azimuth A, and is perpendicular to the line of
    sight. The error of the row is the range times the error of E.
    """
    xp = namespace(m)
    own = (xp.sin(m) * xp.cos(azimuth), xp.sin(m) * xp.sin(azimuth), -1.0 * xp.cos(m))
    basis = a.axes or tuple(tuple(float(i == j) for j in range(3)) for i in range(3))
    normal = tuple(own[0] * basis[0][c] + own[1] * basis[1][c] + own[2] * basis[2][c] for c in range(3))
    return LiftEntry(normal, 0.0, dot(normal, a.position), lambda t: distance(t, a))


def enter(model: Model, m: Any, a: Point, b: Point, known: tuple[KnownLift, KnownLift] | None) -> LiftEntry | None:
    """Return the linear row of a measured value, or None if the row is not linear.

    Parameters
    ----------
    model : Model
        Kind of the row.
    m : number or array
        Measured value, SI units or radians.
    a, b : Point
        Stations of the row, scaled.
    known : tuple of two KnownLift, optional
        Ranges that replace the ranges to a and b. None if these ranges are unknown, even up to a common unknown.
    """
    lifted = lifted_row(model, m, a, b)
    if lifted is None:
        return None
    terms = [(c, place) for place, c in enumerate((lifted.ra, lifted.rb)) if not _vanishes(c)]
    x = (0.0,) * len(a.position) if lifted.x is None else lifted.x
    if not terms:
        return LiftEntry(x, 0.0, -1.0 * lifted.constant, lambda t: lifted.factor(t, a, b))
    if known is not None:
        last: Any = 0.0
        right: Any = -1.0 * lifted.constant
        for c, place in terms:
            last, right = last + c * known[place].sign, right - c * known[place].offset
        return LiftEntry(x, last, right, lambda t: lifted.factor(t, a, b))
    if lifted.x is not None:
        return None
    # ra r_a = -rb r_b, so p r_a^2 = q r_b^2. Squaring is exact, because both sides are positive. If p = q, the row is a
    # plane.
    p, q, root = lifted.ra * lifted.ra, lifted.rb * lifted.rb, lifted.rb
    squared = tuple(-2.0 * (p * u - q * v) for u, v in zip(a.position, b.position, strict=True))
    right = q * dot(b.position, b.position) - p * dot(a.position, a.position)
    # d(p r_a^2 - q r_b^2) = (sqrt p r_a + sqrt q r_b) d(...); both terms are equal at the position
    return LiftEntry(squared, p - q, right, lambda t: 2.0 * root * distance(t, b) * lifted.factor(t, a, b))


def _vanishes(value: Any) -> bool:
    """Return whether a coefficient is zero for every measurement."""
    return not isinstance(value, Symbol) and not np.any(value != 0.0)


def azimuths_beside(problem: Problem, rows: Rows) -> Array | None:
    """Return the row number (m,) in the problem of the azimuth that belongs to each elevation, or None.

    An azimuth belongs to an elevation if station, target and epoch are the same. The result is None if any elevation
    has no azimuth.
    """
    for other, start in zip(problem.rows, problem.starts, strict=True):
        if other.kind != "azimuth":
            continue
        keys = list(zip(other.a.tolist(), other.epoch.tolist(), other.target.tolist(), strict=True))
        wanted = list(zip(rows.a.tolist(), rows.epoch.tolist(), rows.target.tolist(), strict=True))
        pick = [start + keys.index(key) for key in wanted if key in keys]
        if len(pick) == len(wanted):
            return np.array(pick, dtype=np.int64)
    return None


# The same rows for machine code: one tape for each block of rows, and the source of each input of the tape.

# Sources of an input: a constant of the structure, a measurement, a coordinate of a station, or a least-squares range.
# The last source is a coordinate of the position at which the row is evaluated.
NUMBER, SEEN, STATION, OFFSET, POINT = range(5)


class Lifts(NamedTuple):
    """Linear rows of a structure, in blocks of one tape each.

    Parameters
    ----------
    flat : bool
        Whether the coefficient of the last coordinate is zero in all rows.
    tapes : TapeTable
        Tape of each block; its outputs are the d + 1 coefficients, the right side and the factor.
    first : int64 array (b + 1,)
        First row of each block.
    source : int64 array (l, i, 2)
        For each input of each row: its source (NUMBER to POINT), and the index within this source.
    number : array (m,)
        Constants of the structure.
    sigma : array (l,)
        Standard deviation of the measurement of each row.
    """

    flat: bool
    tapes: TapeTable
    first: Array
    source: Array
    number: Array
    sigma: Array


# Seeds of the inputs of a tape. The axes have the last seeds, row by row.
_M, _AZIMUTH, _KNOWN_A, _SIGN_A, _KNOWN_B, _SIGN_B = range(6)
_A, _B, _T, _AXES = 10, 20, 30, 40


_TAPES = Cache["Tape | None"](64)


def _tape_of(model: Model, d: int, turned: bool, paired: bool, known: bool) -> Tape | None:
    """Return the tape of the rows of a kind (coefficients, right side, factor), or None if they are not linear.

    `turned` is True if stations have axes, `paired` if the rows are elevations with azimuths, `known` if ranges are
    known.
    """
    recorder = Recorder()

    def point(first: int, axes: bool) -> Point:
        """Return a point whose coordinates are the inputs from seed `first` on, with axes as inputs if requested."""
        own = tuple(tuple(recorder.input(_AXES + d * i + j) for j in range(d)) for i in range(d)) if axes else None
        return Point(tuple(recorder.input(first + i) for i in range(d)), None, own)

    a, b, m = point(_A, turned), point(_B, False), recorder.input(_M)
    ranges = (
        KnownLift(recorder.input(_KNOWN_A), recorder.input(_SIGN_A)),
        KnownLift(recorder.input(_KNOWN_B), recorder.input(_SIGN_B)),
    )
    try:
        if paired:
            entry: LiftEntry | None = pair_elevation(m, recorder.input(_AZIMUTH), a)
        else:
            entry = enter(model, m, a, b, ranges if known else None)
        if entry is None:
            return None
        return tape(recorder, [*entry.x, entry.last, entry.right, entry.factor(point(_T, False))])
    except (TypeError, AttributeError, ValueError):  # the formula uses more than the elementary functions
        return None


@dataclass(frozen=True, slots=True)
class _Block:
    """The rows of one kind as one tape.

    `tape` computes each row. `source` contains, for each row and input, the source and the index in it. `sigma`
    contains the standard deviation of each measurement.
    """

    tape: Tape
    source: list[list[tuple[int, int]]]
    sigma: list[float]


@dataclass(slots=True)
class _LiftedProblem:
    """One problem and the data from which its linear rows are made.

    `found` are its least-squares ranges. `node` maps (station, epoch) to the index of a station. `on_cone` is True if
    the last coordinate is a range. `number` collects the constants of the rows.
    """

    problem: Problem
    found: Ranges | None
    node: dict[tuple[int, int], int]
    on_cone: bool
    number: list[float]

    def block(self, rows: Rows, start: int) -> _Block | None:
        """Return the block of the rows of one kind, or None if the rows are not linear.

        `start` is the number of the first of these rows in the problem.
        """
        problem, model = self.problem, MODELS[rows.kind]
        beside = azimuths_beside(problem, rows) if rows.kind == "elevation" else None
        present, whole = rows.weight > 0.0, problem.weight > 0.0
        # Without ranges, only the paired form is linear. With ranges, use it only if every elevation has its azimuth.
        if beside is not None and self.found is not None and not (whole[beside] | ~present).all():
            beside = None
        present = present if beside is None else present & whole[beside]
        key = (model, problem.dimension, problem.stations.axes is not None, beside is not None, self.found is not None)
        made = _TAPES.find(key, lambda: _tape_of(*key))
        if made is None:
            return None
        out, sigma = _Block(made, [], []), np.sqrt(variances(problem.noise, problem.count))
        for i in np.flatnonzero(present).tolist():
            sources = [self._source_of_input(seed, rows, i, start, beside) for seed, _ in made.inputs]
            if not all(which >= 0 for _, which in sources):
                return None  # a range is unknown
            out.source.append(sources)
            # a row of weight w counts as a row of variance sigma^2 / w
            out.sigma.append(float(sigma[start + i] / np.sqrt(rows.weight[i])))
        return out

    def _source_of_input(self, seed: int, rows: Rows, i: int, start: int, beside: Array | None) -> tuple[int, int]:
        """Return source and index of an input of the tape of row i; the index is -1 if the input does not exist.

        `seed` is the number of the input, see `_M` and the constants after it. `start` is the number of the first row
        of the kind. `beside` contains the rows of the azimuths that belong to elevations, or is None.
        """
        if seed in (_M, _AZIMUTH):
            return SEEN, int(start + i if beside is None or seed == _M else beside[i])
        if seed >= _T:
            return (
                (POINT, seed - _T) if seed < _AXES else (NUMBER, self._add_constant(self._axis(rows, i, seed - _AXES)))
            )
        second = seed >= _B if seed >= _A else seed in (_KNOWN_B, _SIGN_B)
        epoch = int(rows.epoch[i]) if self.problem.stations.position.shape[-3] > 1 else 0
        station = int((rows.b if second else rows.a)[i])
        place = self.node.get((station, epoch), -1)
        if seed >= _A:
            return STATION, place * self.problem.dimension + seed % (_B - _A) if place >= 0 else -1
        assert self.found is not None
        known = (self.found.station == station) & (self.found.epoch == epoch) & self.found.inside[0]
        if not known.any():
            return OFFSET, -1
        if seed in (_KNOWN_A, _KNOWN_B):
            return OFFSET, place
        return NUMBER, self._add_constant(float(self.found.sign[0, known.argmax()]) if self.on_cone else 0.0)

    def _axis(self, rows: Rows, i: int, cell: int) -> float:
        """Return a component of the axes of the station of row i; `cell` numbers the d * d components row by row."""
        axes, d = self.problem.stations.axes, self.problem.dimension
        assert axes is not None
        return float(axes[int(rows.epoch[i]) if len(axes) > 1 else 0, rows.a[i], cell // d, cell % d])

    def _add_constant(self, value: float) -> int:
        """Append a constant of the structure, and return its index."""
        self.number.append(value)
        return len(self.number) - 1


def lift(problem: Problem, found: Ranges | None, node: dict[tuple[int, int], int], on_cone: bool) -> Lifts:
    """Return the rows of one problem that are linear in the coordinates of this module.

    Parameters
    ----------
    problem : Problem
        One problem of a static target without other unknowns. Its measurements are not used.
    found : Ranges, optional
        Least-squares ranges of the problem, which replace unknown ranges.
    node : dict
        Index of each (station, epoch) among the stations; the epoch is 0 if stations do not move.
    on_cone : bool
        Whether the last coordinate is a range.
    """
    scene = _LiftedProblem(problem, found, node, on_cone, [])
    lifted = [
        scene.block(rows, start)
        for rows, start in zip(problem.rows, problem.starts, strict=True)
        if MODELS[rows.kind].ranges is None and MODELS[rows.kind].lifted is not None
    ]
    blocks = [block for block in lifted if block is not None and block.source]
    d, tapes = problem.dimension, [block.tape for block in blocks]
    every = [sources for block in blocks for sources in block.source]
    source = np.zeros((len(every), max(map(len, every), default=0), 2), dtype=np.int64)
    for row, sources in zip(source, every, strict=True):
        row[: len(sources)] = sources
    return Lifts(
        found is None and all((one.outputs[d], 0.0) in one.constants for one in tapes),
        tape_table(tapes, [one.outputs for one in tapes]),
        starts([len(block.source) for block in blocks]),
        source,
        np.array(scene.number, dtype=float),
        np.array([one for block in blocks for one in block.sigma], dtype=float),
    )
