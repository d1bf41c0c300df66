"""Data that all problems of a plan share, the memory of a block of problems, and answers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.gtrs import scratch
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES
from optloc.kernels.tape_table import TapeTable

ROUNDING = 4.0 * 2.220446049250313e-16
"""Share of a measurement that is rounding: four of a double lie between it and its residual."""

# Rows of `Room.vector`: current and tried values of a refinement, each followed by its trial; FIX and
# NORMAL are the fix whose mirror image is refined, and the direction in which the stations spread least; OTHER is a
# second start, where SECOND is 1.
X, TRIAL, MOVE, G, G_TRIAL, DIAGONAL, INVERSE, ROW, ORIGIN, CENTRE, FIX, NORMAL, OTHER = range(13)
# Rows of `Room.matrix`: information and factor; FIX_H is the information at the fix, MARGIN the information about
# the position alone, and REST the same at a trial.
H, H_TRIAL, LOWER, FIX_H, MARGIN, REST = range(6)
# Rows of `Room.axes`: BASE spans a chart, AXES are principal axes, EIGEN is the matrix that they make diagonal.
BASE, AXES, EIGEN = range(3)
# Rows of `Room.scalar`.
COST, COST_TRIAL, LOOP, BLUR, DAMPING, GROWTH, GAIN, SOLVABLE, SPARE, ALIVE, GOOD, STEPS, SCALE, SPREAD = range(14)
FIX_COST, FIX_GOOD, HEIGHT, HIGH, LOW, SHARE, BEYOND, SECOND, RADIUS = range(14, 23)


LOWER_BOUND, UPPER_BOUND, BOUNDED = range(3)
"""Rows of `EngineWorkspace.side`."""


class Admission(NamedTuple):
    """Quantities of a position that are held or bounded, as tapes, and the Earth.

    Parameters
    ----------
    exact : int
        Number of held quantities; they come first.
    tapes : TapeTable
        Value and derivatives of each; inputs are coordinates.
    level : array (N or 1, k, 2)
        Lower and upper bounds.
    earth : bool
        Whether there is an Earth.
    globe : array (4, 3)
        Earth-centred positions are ``globe[:3] x + globe[3]`` then.
    """

    exact: int
    tapes: TapeTable
    level: Array
    earth: bool
    globe: Array


SIGN, RANGED, HEARD, SEEN = range(4)
"""Rows of `EngineModel.station`: how the unknown range t enters, zeros where the ranges are determined; 1.0 for the
stations whose range is known, up to t; 1.0 for those with a row, and for those with an angle."""


BY_SQUARES, BY_HEIGHT, BY_PLACES = range(3)
"""How a fix starts: squared ranges and linear rows; where ranges meet a known height; the cheapest of many places."""


class EngineModel(NamedTuple):
    """How measurements z become a start: linear maps to ranges to s stations, and what the rows are corrected by.

    Parameters
    ----------
    row : array (3, m)
        Known amount by which each measurement exceeds the model; one over its variance, 0 where absent; and what it is
        multiplied with then.
    anchor : int64 array (m,)
        Row whose measurement is subtracted first, -1 for none: emission times count from it.
    linear : array (s + v, m)
        Maps to the least-squares ranges c, known up to sign * t, and to v more values that an evaluator wants.
    station : array (4, s)
        See the names of its rows.
    reference : int
        Station whose range is t; -1 where the ranges are determined.
    white : array (s, s)
        Lower triangular whitening matrix of c.
    admission : Admission
        Which positions are admitted.
    start : int
        One of the ways above.
    height : int
        Source of the height: the number of a held quantity, or -1 less the number of a row.
    ahead : array (n, d)
        Directions that are tried from the mean of the stations.
    limit : float
        Cost above which another place may hold a better minimum.
    """

    row: Array
    anchor: Array
    linear: Array
    station: Array
    reference: int
    white: Array
    admission: Admission
    start: int
    height: int
    ahead: Array
    limit: float


class EngineResult(NamedTuple):
    """One line of `Answer.number`; `Answer` has the columns by the same names."""

    cost: float
    rival_cost: float
    settled: float
    infinity: float
    kappa: float
    kappa_far: float


COST_OF_FIX, COST_OF_RIVAL, SETTLED, AT_INFINITY, KAPPA, KAPPA_FAR = range(len(EngineResult._fields))
"""Columns of `Answer.number`."""
MULTIPLIER, VALUE, GRADIENT = range(3)
"""Last axis of `Answer.side`."""


class Answer(NamedTuple):
    """Answers to N problems, in arrays that are written.

    Parameters
    ----------
    x : array (N, size)
        Parameter vectors, the position first.
    covariance : array (N, n, n)
        Of the first n unknowns.
    rival : array (N, size)
        Another minimum that the mirror image of the fix leads to, and which costs no more than `LISTED` more; NaN.
    number : array (N, 6)
        See `EngineResult`.
    side : array (N, k, 2 + d)
        Of each held or bounded quantity its multiplier, where it is held: the gradient of the cost and all gradients
        times their multipliers add up to nothing; its value, and its gradient.
    """

    x: Array
    covariance: Array
    rival: Array
    number: Array
    side: Array

    @property
    def cost(self) -> Array:
        """Weighted sums of squared residuals (N,)."""
        return self.number[:, COST_OF_FIX]

    @property
    def rival_cost(self) -> Array:
        """Costs (N,) of the rivals; infinite without one."""
        return self.number[:, COST_OF_RIVAL]

    @property
    def settled(self) -> Array:
        """Whether a fix (N,) is good.

        A good fix has a finite input, an exact start, a finished refinement, a regular covariance and a place that is
        not far away. The others need a closer look, and their other numbers mean nothing.
        """
        return np.asarray(self.number[:, SETTLED] != 0.0)

    @property
    def infinity(self) -> Array:
        """Least costs (N,) at infinity, exact where less than `BEYOND_DOUBT` above the fix, else a lower bound.

        Infinite where the cost grows without bound, NaN where not measured.
        """
        return self.number[:, AT_INFINITY]

    @property
    def kappa(self) -> Array:
        """How far costs are from squares of distances, in metres and in inverse range, (N, 2); NaN: not measured."""
        return self.number[:, KAPPA:]

    @property
    def multiplier(self) -> Array:
        """Multipliers (N, k) of quantities that are held."""
        return self.side[..., MULTIPLIER]

    @property
    def quantity(self) -> Array:
        """Values (N, k) of what is held or bounded."""
        return self.side[..., VALUE]

    @property
    def normal(self) -> Array:
        """Gradients (N, k, d) of what is held or bounded."""
        return self.side[..., GRADIENT:]


class EngineWorkspace(NamedTuple):
    """Memory of a block of W problems of p unknowns, the first d of which are the position, and of s stations.

    Parameters
    ----------
    d : int
        Coordinates of a position.
    item : int64 array (W,)
        Problem of each lane.
    seen : array (m, W)
        Measurements.
    value : array (s + v, W)
        Their images under `EngineModel.linear`.
    place : array (s, d, W)
        Stations from the origin, metres.
    squared, rows : array (s, d + 2, W), (s + l, d + 2, W)
        Squared-range rows as they are; and weighed, behind them the l linear rows of other kinds.
    y, second, work : array (d + 1, W), (d + 1, W), (n, W)
        Squared-range answers, second ones, and scratch of `optloc.kernels.gtrs.minimise`.
    vector, matrix, axes, scalar : array (13, p, W), (6, p, p, W), (3, d, d, W), (23, W)
        See the names of their rows. Positions count from the origin, row ORIGIN. Where RADIUS is not zero, they are
        held at this distance from CENTRE.
    face, push : array (2, k, d, W), (c, p, W)
        Gradients of quantities at rows X and TRIAL; of those that are held, their products with an inverse.
    small, part, pivot : array (2, c, c, W), (c, W), (2, c, W)
        Products of these with each other, and scratch.
    side : array (3, k, W)
        Lower and upper bounds, and what they bound.
    registers : array (r, W)
        Scratch.
    """

    d: int
    item: Array
    seen: Array
    value: Array
    place: Array
    squared: Array
    rows: Array
    y: Array
    second: Array
    work: Array
    vector: Array
    matrix: Array
    axes: Array
    scalar: Array
    face: Array
    push: Array
    small: Array
    part: Array
    pivot: Array
    side: Array
    registers: Array


@compiled
def make_room(model: EngineModel, stations: int, d: int, unknowns: int, others: int) -> EngineWorkspace:
    """Return the memory of a block of problems, for numbers of stations, coordinates, unknowns and linear rows."""
    s, p, m = stations, unknowns, model.row.shape[1]
    c, k = model.admission.exact, model.admission.level.shape[1]
    return EngineWorkspace(
        d,
        np.empty(LANES, np.int64),
        np.zeros((m, LANES)),
        np.zeros((len(model.linear), LANES)),
        np.zeros((s, d, LANES)),
        np.zeros((s, d + 2, LANES)),
        np.zeros((s + others, d + 2, LANES)),
        np.zeros((d + 1, LANES)),
        np.zeros((d + 1, LANES)),
        np.zeros((scratch(d + 1), LANES)),
        np.zeros((13, p, LANES)),
        np.zeros((6, p, p, LANES)),
        np.zeros((3, d, d, LANES)),
        np.zeros((23, LANES)),
        np.zeros((2, k, d, LANES)),
        np.zeros((c, p, LANES)),
        np.zeros((2, c, c, LANES)),
        np.zeros((c, LANES)),
        np.zeros((2, c, LANES)),
        np.zeros((3, k, LANES)),
        np.zeros((model.admission.tapes.registers, LANES)),
    )
