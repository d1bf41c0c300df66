"""The data that all problems of a plan share, the workspace of a block of problems, and the arrays of the answers.

A block has W = LANES problems, one in each lane; the last axis of every array of a block is the lane. The integer
constants name rows of these arrays. Letters: m rows, s stations, d coordinates, p refined unknowns, k constraints, c of
them exact.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.gtrs import scratch
from optloc.kernels.jit import compiled
from optloc.kernels.systems import LANES
from optloc.kernels.tape_table import TapeTable

ROUNDING = 4.0 * 2.220446049250313e-16
"""Rounding error as a share of a measurement: four roundings of a double occur between a measurement and its
residual."""

# Rows of `EngineWorkspace.vector`. X and G (right side) are each followed by their values at a trial step. FIX and
# NORMAL are the fix whose mirror image is refined, and the direction in which the stations spread least. OTHER is a
# second start, valid if SECOND is 1.
X, TRIAL, MOVE, G, G_TRIAL, DIAGONAL, INVERSE, ROW, ORIGIN, CENTRE, FIX, NORMAL, OTHER = range(13)
# Rows of `EngineWorkspace.matrix`: information H and its factor LOWER. FIX_H is the information at the fix, MARGIN the
# information about the position alone, and REST the same at a trial step.
H, H_TRIAL, LOWER, FIX_H, MARGIN, REST = range(6)
# Rows of `EngineWorkspace.axes`: BASE spans coordinates in inverse range, AXES are principal axes, EIGEN is the matrix
# that these axes diagonalise.
BASE, AXES, EIGEN = range(3)
# Rows of `EngineWorkspace.scalar`, one number for each problem. COST, COST_TRIAL: cost at X and at TRIAL. LOOP: cost of
# combinations of rows that no range changes. BLUR: rounding error of the whitened residuals. DAMPING, GROWTH:
# Marquardt's factor, and its growth after a rejected step. GAIN: squared length of a step in standard deviations.
# SOLVABLE: 1.0 if a system is regular. ALIVE: 1.0 while a refinement continues. GOOD: 1.0 if its result is valid so
# far. STEPS: steps tried. SCALE: unit of length of squared-range rows, metres. SPREAD: greatest distance of a station
# from their mean, metres. FIX_COST, FIX_GOOD: cost of the fix, and 1.0 if it is settled. HEIGHT: height of the fix
# above the plane of the stations, metres. BEYOND: cost at infinity. SECOND: 1.0 if OTHER is valid. RADIUS: distance
# from CENTRE to which positions are moved, metres; 0.0 for none. SPARE, HIGH, LOW and SHARE are scratch, mostly the
# extremes and a factor of one kernel.
COST, COST_TRIAL, LOOP, BLUR, DAMPING, GROWTH, GAIN, SOLVABLE, SPARE, ALIVE, GOOD, STEPS, SCALE, SPREAD = range(14)
FIX_COST, FIX_GOOD, HEIGHT, HIGH, LOW, SHARE, BEYOND, SECOND, RADIUS = range(14, 23)


LOWER_BOUND, UPPER_BOUND, BOUNDED = range(3)
"""Rows of `EngineWorkspace.side`."""


class Admission(NamedTuple):
    """Constraints of a position as tapes, with their bounds, and the frame of the Earth.

    Parameters
    ----------
    exact : int
        Number of exact constraints; they come first.
    tapes : TapeTable
        Value and derivatives of each constrained quantity; the inputs are coordinates.
    level : array (N or 1, k, 2)
        Lower and upper bounds.
    earth : bool
        Whether the frame is geodetic, so that the Earth can hide a position from a station.
    globe : array (4, 3)
        If `earth` is True, the Earth-centred position of x is ``globe[:3] x + globe[3]``, metres.
    """

    exact: int
    tapes: TapeTable
    level: Array
    earth: bool
    globe: Array


SIGN, RANGED, HEARD, SEEN = range(4)
"""Rows of `EngineModel.station`.

SIGN: factor of the unknown range t, 0 if the ranges are determined. RANGED: 1.0 for stations whose range is known up
to t. HEARD: 1.0 for stations with a row. SEEN: 1.0 for stations with an angle."""


BY_SQUARES, BY_HEIGHT, BY_PLACES = range(3)
"""How a fix starts.

BY_SQUARES: from squared ranges and other linear rows. BY_HEIGHT: from the points where ranges meet a known height.
BY_PLACES: from the cheapest of many positions."""


class EngineModel(NamedTuple):
    """The maps from measurements z to a start: linear maps to the ranges of s stations, and corrections of the rows.

    Parameters
    ----------
    row : array (3, m)
        For each row: the known amount by which the measurement exceeds the model; one over its variance (0 if absent);
        and the factor that multiplies the corrected measurement.
    anchor : int64 array (m,)
        Row whose measurement is subtracted first, because emission times are relative to it; -1 for none.
    linear : array (s + v, m)
        Maps to the least-squares ranges c, known up to sign * t, and to v more values that an evaluator needs.
    station : array (4, s)
        Rows SIGN, RANGED, HEARD, SEEN.
    reference : int
        Station whose range is t; -1 if the ranges are determined.
    white : array (s, s)
        Lower triangular whitening matrix of c, 1/metres.
    admission : Admission
        Constraints of the position.
    start : int
        BY_SQUARES, BY_HEIGHT or BY_PLACES.
    height : int
        Source of the height: the number of an exact constraint, or -1 minus the number of a row.
    ahead : array (n, d)
        Directions from the mean of the stations in which candidates are placed.
    limit : float
        Cost above which the best candidate fits poorly, so that another position may be a better minimum.
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
    """The numbers of one fix: one row of `Answer.number`. `Answer` has the columns under the same names.

    `cost` and `rival_cost` are chi-square values of fix and rival. `settled` is 1.0 if the fix is valid, else 0.0.
    `infinity` is the least cost at infinity. `kappa` and `kappa_far` measure the deviation from a Gaussian, in metres
    and in inverse range.
    """

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
    """Answers to N problems, in arrays that the kernels write.

    Parameters
    ----------
    x : array (N, size)
        Parameter vectors, the position first.
    covariance : array (N, n, n)
        Covariance of the first n unknowns.
    rival : array (N, size)
        Parameters of the rival: another minimum, reached from the mirror image of the fix, whose cost is at most
        `LISTED` above the cost of the fix. NaN without a rival.
    number : array (N, 6)
        Columns of `EngineResult`.
    side : array (N, k, 2 + d)
        For each constrained quantity: its multiplier (exact constraints only), its value and its gradient. The gradient
        of the cost plus the sum of multipliers times gradients is zero.
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
        """Costs (N,) of the rivals; infinite without a rival."""
        return self.number[:, COST_OF_RIVAL]

    @property
    def settled(self) -> Array:
        """Whether each fix (N,) is settled.

        A settled fix has finite measurements, an exact start, a converged refinement, a regular covariance, and a
        position that is not far away. The other fixes need the general solver; their other numbers have no meaning.
        """
        return np.asarray(self.number[:, SETTLED] != 0.0)

    @property
    def infinity(self) -> Array:
        """Least costs (N,) at infinity.

        Exact if less than `BEYOND_DOUBT` above the cost of the fix, else a lower bound. Infinite if the cost grows
        without bound; NaN if not measured.
        """
        return self.number[:, AT_INFINITY]

    @property
    def kappa(self) -> Array:
        """Return the deviation (N, 2) of the costs from a quadratic function, in metres and in inverse range.

        The value is NaN if it was not measured.
        """
        return self.number[:, KAPPA:]

    @property
    def multiplier(self) -> Array:
        """Lagrange multipliers (N, k) of the exact constraints; zero for bounds."""
        return self.side[..., MULTIPLIER]

    @property
    def quantity(self) -> Array:
        """Values (N, k) of the constrained quantities at the fix, in the unit of each constraint."""
        return self.side[..., VALUE]

    @property
    def normal(self) -> Array:
        """Gradients (N, k, d) of the constrained quantities at the fix."""
        return self.side[..., GRADIENT:]


class EngineWorkspace(NamedTuple):
    """Workspace of a block of W problems with p unknowns, the first d of which are the position, and with s stations.

    Parameters
    ----------
    d : int
        Number of coordinates of a position.
    item : int64 array (W,)
        Problem of each lane.
    seen : array (m, W)
        Measurements.
    value : array (s + v, W)
        The maps `EngineModel.linear` applied to the measurements.
    place : array (s, d, W)
        Stations relative to the origin, metres.
    squared, rows : array (s, d + 2, W), (s + l, d + 2, W)
        Squared-range rows without weights; and weighted, followed by the l linear rows of other kinds.
    y, second, work : array (d + 1, W), (d + 1, W), (n, W)
        Squared-range solutions, second solutions, and scratch of `optloc.kernels.gtrs.minimise`.
    vector, matrix, axes, scalar : array (13, p, W), (6, p, p, W), (3, d, d, W), (23, W)
        The constants of this module name the rows. Positions are relative to the origin, row ORIGIN. If RADIUS is not
        zero, positions are kept at this distance from CENTRE.
    face, push : array (2, k, d, W), (c, p, W)
        Gradients of the constrained quantities at rows X and TRIAL; for the c exact ones, their products with the
        inverse of the information.
    small, part, pivot : array (2, c, c, W), (c, W), (2, c, W)
        Products of `face` and `push`, and scratch.
    side : array (3, k, W)
        Lower and upper bounds, and the constrained quantities.
    registers : array (r, W)
        Registers of the constraint tapes.
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
    """Return the workspace of a block.

    The arguments after `model` are numbers of stations, of coordinates, of refined unknowns, and of linear rows of
    other kinds than ranges.
    """
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
