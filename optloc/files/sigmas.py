"""What a table of measurements says about its noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from optloc.errors import InvalidProblem
from optloc.files.chunk import Context
from optloc.files.words import Units, join, nearest
from optloc.models import Model
from optloc.types import Array
from optloc.units import Conversion

ESTIMATE = "estimate"
"""Word in the place of a standard deviation that is to be found from the data."""

# Where the search for a level begins, in SI units: it decides nothing but how kinds are weighed in the first fixes.
_BEGIN = {"angle": 1e-2, "ratio": 1e-2, "speed": 0.1}


def spread_of(
    c: Context, model: Model, units: Units, unit: Conversion, z: Array
) -> tuple[Array | None, Array | None, Array | None]:
    """Return standard deviations (m,), arrival standard deviations (s,) and covariance (r, r): one of them, or none.

    Parameters
    ----------
    c : Context
        Settings and rows.
    model : Model
        Of their kind.
    units : Units
        What they measure.
    unit : Conversion
        Of z, and of bare numbers.
    z : array (m,)
        Measured values in SI.
    """
    section = c.section
    column = c.table.has("sigma")
    given = [column or section.sigma is not None, section.arrival_sigma is not None, section.covariance is not None]
    if sum(given) > 1:
        raise InvalidProblem("the noise is given more than once", c.where, "give sigma, arrival_sigma or covariance")
    if column:
        return _positive(c, unit.sigma_to_si(c.table.numbers("sigma"), z), column=True), None, None
    if section.sigma == ESTIMATE:
        return np.full(z.shape, _BEGIN.get(model.quantity, 1.0)), None, None
    if section.sigma is not None:
        number, own = units.amount(section.sigma, unit, join(c.where, "key 'sigma'"))
        return _positive(c, np.broadcast_to(own.sigma_to_si(number, z), z.shape), column=False), None, None
    if section.arrival_sigma is not None:
        return None, _arrival(c, model, units, unit, section.arrival_sigma), None
    covariance = None if section.covariance is None else square(section.covariance, join(c.where, "key 'covariance'"))
    return None, None, covariance


def _positive(c: Context, sigma: Array, *, column: bool) -> Array:
    bad = np.flatnonzero(sigma <= 0.0)
    if len(bad):
        place = c.table.where("sigma", int(bad[0])) if column else join(c.where, "key 'sigma'")
        raise InvalidProblem("the standard deviation is not positive", place, "give a positive number")
    return sigma


def _arrival(
    c: Context, model: Model, units: Units, unit: Conversion, given: float | str | Mapping[str, float | str]
) -> Array:
    place = join(c.where, "key 'arrival_sigma'")
    if model.ranges is None:
        raise InvalidProblem("these rows do not combine arrival times", place, "give sigma or covariance")
    if not isinstance(given, Mapping):
        given = dict.fromkeys(c.stations, given)
    unknown = [name for name in given if name not in c.stations]
    if unknown:
        raise InvalidProblem(f"there is no station {unknown[0]!r}", place, nearest(unknown[0], list(c.stations)))
    sigma = np.zeros(len(c.stations))
    for name, value in given.items():
        number, own = units.amount(value, unit, place)
        sigma[c.stations.index(name)] = own.sigma_to_si(number)
        if number <= 0.0:
            raise InvalidProblem("the standard deviation is not positive", place, "give a positive number")
    return sigma


def square(rows: list[list[float]], where: str) -> Array:
    """Return a covariance (r, r) as an array; raise InvalidProblem where it is none."""
    r = len(rows)
    if r == 0:
        raise InvalidProblem("the covariance is empty", where, "give a square matrix")
    for i, row in enumerate(rows):
        if len(row) != r:
            what = f"row {i + 1} of the covariance has {len(row)} numbers, not {r}"
            raise InvalidProblem(what, where, "give a square matrix")
    matrix = np.array(rows, dtype=float)
    i, j = divmod(int(np.argmax(np.abs(matrix - matrix.T))), r)
    if abs(matrix[i, j] - matrix[j, i]) > 1e-9 * np.abs(matrix).max():
        entries = f"({i + 1}, {j + 1}) is {matrix[i, j]:g}, ({j + 1}, {i + 1}) is {matrix[j, i]:g}"
        raise InvalidProblem(f"the covariance is not symmetric: entry {entries}", where, "make both equal")
    diagonal = np.diagonal(matrix)
    if (diagonal <= 0.0).any():
        place = int(np.flatnonzero(diagonal <= 0.0)[0]) + 1
        raise InvalidProblem(
            f"the variance ({place}, {place}) is {diagonal[place - 1]:g}, not positive", where, "give a covariance"
        )
    lowest = np.linalg.eigvalsh(matrix)[0]
    if lowest < -1e-9 * diagonal.max():
        raise InvalidProblem(f"the covariance has the negative eigenvalue {lowest:g}", where, "give a covariance")
    return matrix
