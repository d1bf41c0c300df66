"""Rows that are linear in the position and one more coordinate: angles and gain ratios.

The coordinates are ``y = ((x - origin) / scale, last)``. The last coordinate is the range to a reference station, or
the squared distance from the origin. Each row is written once, elementwise: for arrays, and as a tape for machine code.
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
    """A row ``x . position + last y_last = right``.

    Parameters
    ----------
    x : tuple of d numbers
        Coefficients of the scaled position.
    last, right : number
        Coefficient of the last coordinate, and the right side.
    factor : callable
        Maps the scaled position to the row's error for one unit of error of the measurement; its sign says nothing.
    """

    x: Components
    last: Any
    right: Any
    factor: Callable[[Point], Any]


class KnownLift(NamedTuple):
    """A range ``offset + sign t`` that takes the place of one in a row; t is the last coordinate."""

    offset: Any
    sign: Any


def pair_elevation(m: Any, azimuth: Any, a: Point) -> LiftEntry:
    """Return [sin E cos A, sin E sin A, -cos E] . (x - s) = 0 in the station's axes; its error is range times n_E.

    The normal of the cone of elevation E in the measured azimuth A is at right angles to the line of sight.
    """
    xp = namespace(m)
    own = (xp.sin(m) * xp.cos(azimuth), xp.sin(m) * xp.sin(azimuth), -1.0 * xp.cos(m))
    basis = a.axes or tuple(tuple(float(i == j) for j in range(3)) for i in range(3))
    normal = tuple(own[0] * basis[0][c] + own[1] * basis[1][c] + own[2] * basis[2][c] for c in range(3))
    return LiftEntry(normal, 0.0, dot(normal, a.position), lambda t: distance(t, a))


def enter(model: Model, m: Any, a: Point, b: Point, known: tuple[KnownLift, KnownLift] | None) -> LiftEntry | None:
    """Return the row of a measured value, or None where it is not linear.

    Parameters
    ----------
    model : Model
        Its kind.
    m : number or array
        Value, SI units or radians.
    a, b : Point
        Its stations, scaled.
    known : tuple of two KnownLift, optional
        Ranges that take the place of those to a and b; None where ranges are not known, nor up to a common unknown.
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
    # ra r_a = -rb r_b, so p r_a^2 = q r_b^2: exact, as both sides are positive; p = q is a plane
    p, q, root = lifted.ra * lifted.ra, lifted.rb * lifted.rb, lifted.rb
    squared = tuple(-2.0 * (p * u - q * v) for u, v in zip(a.position, b.position, strict=True))
    right = q * dot(b.position, b.position) - p * dot(a.position, a.position)
    # d(p r_a^2 - q r_b^2) = (sqrt p r_a + sqrt q r_b) d(...), and both terms are equal at the place
    return LiftEntry(squared, p - q, right, lambda t: 2.0 * root * distance(t, b) * lifted.factor(t, a, b))


def _vanishes(value: Any) -> bool:
    """Return whether a coefficient is zero whatever is measured."""
    return not isinstance(value, Symbol) and not np.any(value != 0.0)


def azimuths_beside(problem: Problem, rows: Rows) -> Array | None:
    """Return the global number (m,) of the azimuth of the same station, target and epoch as each elevation, or None.

    None if any has no such row.
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


# The same rows for machine code: a tape for each block of rows, and where each of its inputs comes from.

# Sorts of inputs: a number of the structure, a measurement, a coordinate of a station, a least-squares range, or a
# coordinate of the place where the error of the row is taken.
NUMBER, SEEN, STATION, OFFSET, POINT = range(5)


class Lifts(NamedTuple):
    """Linear rows of a structure, in blocks of one tape each.

    Parameters
    ----------
    flat : bool
        Whether no row has the last coordinate.
    tapes : TapeTable
        Of each block; outputs are the d + 1 coefficients, the right side and the factor.
    first : int64 array (b + 1,)
        First row of each block.
    source : int64 array (l, i, 2)
        Of every input of every row: what it is, and which.
    number : array (m,)
        Numbers of the structure.
    sigma : array (l,)
        Standard deviation of each row's measurement.
    """

    flat: bool
    tapes: TapeTable
    first: Array
    source: Array
    number: Array
    sigma: Array


# Seeds of the inputs of a tape; axes come last, row by row.
_M, _AZIMUTH, _KNOWN_A, _SIGN_A, _KNOWN_B, _SIGN_B = range(6)
_A, _B, _T, _AXES = 10, 20, 30, 40


_TAPES = Cache["Tape | None"](64)


def _tape_of(model: Model, d: int, turned: bool, paired: bool, known: bool) -> Tape | None:
    """Return the tape of a kind's rows: coefficients, right side, factor; None where it has none."""
    recorder = Recorder()

    def point(first: int, axes: bool) -> Point:
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
    except (TypeError, AttributeError, ValueError):  # it needs more than the elementary functions
        return None


@dataclass(frozen=True, slots=True)
class _Block:
    """Rows of one kind: their tape, what each input of each row is, and standard deviations of the measurements."""

    tape: Tape
    source: list[list[tuple[int, int]]]
    sigma: list[float]


@dataclass(slots=True)
class _Scene:
    """One problem, its least-squares ranges, the place of each station, and the numbers of the structure so far."""

    problem: Problem
    found: Ranges | None
    node: dict[tuple[int, int], int]
    on_cone: bool
    number: list[float]

    def block(self, rows: Rows, start: int) -> _Block | None:
        """Return the block of rows of one kind, or None where they are not linear."""
        problem, model = self.problem, MODELS[rows.kind]
        beside = azimuths_beside(problem, rows) if rows.kind == "elevation" else None
        present, whole = rows.weight > 0.0, problem.weight > 0.0
        # without ranges the paired form is the only linear one; with some, only where every elevation has its azimuth
        if beside is not None and self.found is not None and not (whole[beside] | ~present).all():
            beside = None
        present = present if beside is None else present & whole[beside]
        key = (model, problem.dimension, problem.stations.axes is not None, beside is not None, self.found is not None)
        made = _TAPES.find(key, lambda: _tape_of(*key))
        if made is None:
            return None
        out, sigma = _Block(made, [], []), np.sqrt(variances(problem.noise, problem.count))
        for i in np.flatnonzero(present).tolist():
            own = [self._source(seed, rows, i, start, beside) for seed, _ in made.inputs]
            if not all(which >= 0 for _, which in own):
                return None  # a range stays unknown
            out.source.append(own)
            # a row of weight w counts as one of variance sigma^2 / w
            out.sigma.append(float(sigma[start + i] / np.sqrt(rows.weight[i])))
        return out

    def _source(self, seed: int, rows: Rows, i: int, start: int, beside: Array | None) -> tuple[int, int]:
        """Return sort and number of an input of the tape of a row; number -1 where it does not exist."""
        if seed in (_M, _AZIMUTH):
            return SEEN, int(start + i if beside is None or seed == _M else beside[i])
        if seed >= _T:
            return (POINT, seed - _T) if seed < _AXES else (NUMBER, self._keep(self._axis(rows, i, seed - _AXES)))
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
        return NUMBER, self._keep(float(self.found.sign[0, known.argmax()]) if self.on_cone else 0.0)

    def _axis(self, rows: Rows, i: int, cell: int) -> float:
        axes, d = self.problem.stations.axes, self.problem.dimension
        assert axes is not None
        return float(axes[int(rows.epoch[i]) if len(axes) > 1 else 0, rows.a[i], cell // d, cell % d])

    def _keep(self, value: float) -> int:
        self.number.append(value)
        return len(self.number) - 1


def lift(problem: Problem, found: Ranges | None, node: dict[tuple[int, int], int], on_cone: bool) -> Lifts:
    """Return the rows of one problem that are linear in these coordinates.

    Parameters
    ----------
    problem : Problem
        One problem of a static target, nothing else unknown; measurements do not matter.
    found : Ranges, optional
        Its least-squares ranges, which replace unknown ranges.
    node : dict
        Place of each (station, epoch) among the stations; the epoch is 0 where stations stay.
    on_cone : bool
        Whether the last coordinate is a range.
    """
    scene = _Scene(problem, found, node, on_cone, [])
    lifted = [
        scene.block(rows, start)
        for rows, start in zip(problem.rows, problem.starts, strict=True)
        if MODELS[rows.kind].ranges is None and MODELS[rows.kind].lifted is not None
    ]
    blocks = [block for block in lifted if block is not None and block.source]
    d, tapes = problem.dimension, [block.tape for block in blocks]
    every = [own for block in blocks for own in block.source]
    source = np.zeros((len(every), max(map(len, every), default=0), 2), dtype=np.int64)
    for row, own in zip(source, every, strict=True):
        row[: len(own)] = own
    return Lifts(
        found is None and all((one.outputs[d], 0.0) in one.constants for one in tapes),
        tape_table(tapes, [one.outputs for one in tapes]),
        starts([len(block.source) for block in blocks]),
        source,
        np.array(scene.number, dtype=float),
        np.array([one for block in blocks for one in block.sigma], dtype=float),
    )
