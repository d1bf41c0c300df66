"""The arrays of a plan, from the structure of one problem.

`one` is a problem without batch axes. `found` are its least-squares ranges as linear maps of the measurements, known up
to one common unknown t; None if the rows give no ranges. Letters: m rows, s station positions with rows, k epochs, d
coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from optloc.base.linalg import project_out, whitening
from optloc.base.types import Array, Band
from optloc.engine.candidates import directions
from optloc.engine.lifts import Lifts, lift
from optloc.engine.memory import (
    BY_HEIGHT,
    BY_PLACES,
    BY_SQUARES,
    HEARD,
    RANGED,
    SEEN,
    SIGN,
    Admission,
    EngineModel,
)
from optloc.engine.ranges import RangeRows
from optloc.engine.tapes import TapeRows
from optloc.kernels.pack import pack
from optloc.linear.constraints import is_exact
from optloc.linear.evaluate import block_links, columns
from optloc.linear.least_squares_ranges import Ranges, ranges
from optloc.linear.normal import with_station_noise
from optloc.linear.redundancy import degrees_of_freedom, largest
from optloc.linear.vectors import problem_at_rest, vectors
from optloc.models import MODELS
from optloc.problem.forms import form_of
from optloc.problem.noise import variances, whiten, whiten_rows
from optloc.problem.problem import Problem

# Share of the largest weight below which a combination of rows is rounding: four digits above rounding itself.
_NOTHING = 1e-12
# Share of a combination of ranges up to which its common part is rounding; exact differences have no common part.
_LEVEL = 1e-9


class PlanArrays(NamedTuple):
    """The arrays of a plan, and a function that returns the rows of problems.

    Parameters
    ----------
    node : int64 array (2, s)
        Epoch and station number of each station position that has rows.
    model : EngineModel
        Maps from measurements to a start.
    rows : callable
        Returns the rows for the evaluator, from a problem or a flat batch.
    ranged : bool
        Whether all rows are sums of ranges.
    """

    node: Array
    model: EngineModel
    rows: Callable[[Problem], Any]
    ranged: bool


def draw_ranges(one: Problem, admission: Admission) -> PlanArrays | None:
    """Return the arrays of a plan whose rows are sums of ranges.

    `admission` contains the constraints of the position. The result is None if rows for a start are missing, or if no
    row links some stations.
    """
    offset = None
    if one.stations.unknown_for:  # errors along the lines to the target are noise
        offset = columns(one.layout, "stations", np.zeros(1, dtype=int))[0]
        one = replace(one, stations=one.stations.with_noise())
    found = _find_ranges(one)
    # If no row links two stations, their ranges are not related.
    if found is None or len(found.groups[0]) != 1:
        return None
    node = _station_nodes(one, found)
    model = _start_maps(one, found, node, admission)
    if model is None or _start_of(one, found, admission, 0) != BY_SQUARES:
        return None
    turned, made = _range_rows(with_station_noise(one), node[1])
    if offset is not None:
        assert one.stations.covariance is not None
        first = offset.reshape(-1, one.dimension)[node[1], 0]
        made = made._replace(wander=np.array(one.stations.covariance[node[1], 0, 0]), offset=first)
    return PlanArrays(node, model._replace(linear=np.concatenate([model.linear, turned])), lambda _: made, True)


def draw_tapes(one: Problem, admission: Admission, dof: int) -> PlanArrays | None:
    """Return the arrays of a plan whose rows are tapes, or None if the rows have no tapes or no start.

    `admission` contains the constraints of the position. `dof` is the number of degrees of freedom; it sets the cost
    above which a candidate fits poorly.
    """
    found = _find_ranges(one)
    node = _station_nodes(one, found)
    model = _start_maps(one, found, node, admission)
    if model is None:
        return None
    places = {(int(station), int(epoch)): i for i, (epoch, station) in enumerate(node.T)}
    lifts = lift(problem_at_rest(one.flat()).take(np.zeros(1, dtype=int)), found, places, model.reference >= 0)
    make = partial(_tape_rows, one.correction, vectors(one.flat(), None)[0], lifts, _is_bounded(one))
    start = _start_of(one, found, admission, len(lifts.sigma))
    if start is None or make(one) is None:
        return None
    height = _height_of(one)
    if start == BY_HEIGHT and height is not None:
        model = model._replace(start=start, height=height)
    elif start == BY_PLACES:
        model = model._replace(start=start, limit=largest(dof, _POOR))
    return PlanArrays(node, model, make, False)


def _find_ranges(one: Problem) -> Ranges | None:
    """Return the least-squares ranges of one problem as linear maps, or None if the rows give no ranges.

    Item i of the result contains the ranges for the measurements that are one in row i and zero in all other rows.
    """
    return ranges(with_station_noise(_unit_measurements(problem_at_rest(one.flat()))))


# Probability of the chi-square test below which the general solver searches for a better position, as
# `optloc.solvers.policy.P_SUSPECT`.
_POOR = 1e-3
# Number of ranges known up to one unknown that determine a position together with a height.
_THREE = 3


def _start_of(one: Problem, found: Ranges | None, admission: Admission, lifted: int) -> int | None:
    """Return BY_SQUARES, BY_HEIGHT or BY_PLACES, see `EngineModel.start`; None if the rows give no start.

    Squared ranges need one linear row for each coordinate; the quadric determines the last unknown. `lifted` is the
    number of linear rows of other kinds.
    """
    known = 0 if found is None else int(found.inside[0].sum())
    if lifted + known == 0:
        return None
    on_cone = found is not None and bool(found.free.all())
    if lifted + known - on_cone >= one.dimension:
        return BY_SQUARES
    if known == _THREE and on_cone and not lifted and admission.earth and _height_of(one) is not None:
        return BY_HEIGHT
    moving = one.stations.position.shape[-3] > 1
    spare = degrees_of_freedom(one.flat())[0] > 0  # without redundancy every position fits
    return BY_PLACES if moving and one.epochs > 1 and spare else BY_SQUARES


def _height_of(one: Problem) -> int | None:
    """Return the source of the height of the target, see `EngineModel.height`; None if the height is not known.

    The source is the number of an exact constraint, or -1 minus the number of a row.
    """
    held = [band for band in one.constraints if is_exact(band)]
    for i, band in enumerate(held):
        if isinstance(band, Band) and band.kind == "height":
            return i
    for rows, start in zip(one.rows, one.starts, strict=True):
        if rows.kind == "height" and (rows.weight > 0.0).any():
            return -1 - start - int((rows.weight > 0.0).argmax())
    return None


def _unit_measurements(problem: Problem) -> Problem:
    """Return one problem for each row, whose measurement is one in this row and zero in all others."""
    # The images of the unit vectors define a linear map.
    parts = np.split(np.eye(problem.count), problem.starts[1:], axis=1)
    rows = tuple(replace(r, z=part, correction=np.zeros(r.count)) for r, part in zip(problem.rows, parts, strict=True))
    return replace(problem, rows=rows, stations=replace(problem.stations, velocity=None, axes=None))


def _station_nodes(one: Problem, found: Ranges | None) -> Array:
    """Return epoch and number (2, s) of the stations that have rows, first those whose ranges are known.

    The epoch is 0 if stations do not move.
    """
    moving = one.stations.position.shape[-3] > 1
    known = _stations_with_ranges(found)
    first = [] if found is None else list(zip(found.epoch[known].tolist(), found.station[known].tolist(), strict=True))
    others = {
        (int(rows.epoch[i]) if moving else 0, int(end[i]))
        for rows in one.rows
        for end in (rows.a, rows.b)[: MODELS[rows.kind].stations]
        for i in np.flatnonzero(rows.weight > 0.0)
    }
    return np.array([*first, *sorted(others - {*first})], dtype=np.int64).reshape(-1, 2).T


def _stations_with_ranges(found: Ranges | None) -> Array:
    """Return the numbers of the stations in `found` whose ranges the rows determine, at least up to t."""
    return np.zeros(0, dtype=np.int64) if found is None else np.flatnonzero(found.inside[0])


def _start_maps(one: Problem, found: Ranges | None, node: Array, admission: Admission) -> EngineModel | None:
    """Return the maps from measurements of one problem to a start by squares; None if the noise is singular.

    `node` (2, s) is the result of `_station_nodes`; `admission` contains the constraints of the position.
    """
    count, s, flat, known = one.count, node.shape[1], one.flat(), _stations_with_ranges(found)
    white = np.eye(s)
    if found is not None:
        white[: len(known), : len(known)] = whitening(found.covariance[0, known[:, None], known])
    # The compiled core needs triangular whitening matrices, which a singular covariance does not have.
    if np.triu(white, 1).any():
        return None
    added, gain = np.zeros(count), np.zeros(count)
    base = vectors(flat, None)
    for links, rows, start in zip(block_links(one), one.rows, one.starts, strict=True):
        part = slice(start, start + rows.count)
        gain[part], added[part] = links.gains.total(base, rows.count)[0], links.adds.total(base, rows.count)[0]
    present = one.weight > 0.0
    precision = np.where(present, 1.0 / np.where(present, variances(with_station_noise(one).noise, count), 1.0), 0.0)
    linear, station, reference = np.zeros((s, count)), np.zeros((SEEN + 1, s)), -1
    if found is not None:
        linear[: len(known)] = found.offset[:, known].T
        station[SIGN, : len(known)], station[RANGED, : len(known)] = found.sign[0, known], 1.0
        reference = int(np.searchsorted(known, found.reference[0])) if found.free.all() else -1
    station[HEARD], station[SEEN] = _observed_stations(one, node)
    row = np.stack([one.correction + added, precision, 1.0 / (1.0 + gain)])
    anchor, ahead = _anchors(one)[0], directions(one.dimension)
    return EngineModel(row, anchor, linear, station, reference, white, admission, BY_SQUARES, -1, ahead, np.inf)


def _observed_stations(one: Problem, node: Array) -> tuple[Array, Array]:
    """Return two arrays (s,): 1.0 for stations that have a row, and 1.0 for stations that have an angle; else 0.0.

    They are the rows HEARD and SEEN of `EngineModel.station`.
    """
    moving = one.stations.position.shape[-3] > 1
    has_row, has_angle = np.zeros(node.shape[1]), np.zeros(node.shape[1])
    for rows in one.rows:
        model = MODELS[rows.kind]
        for index in (rows.a, rows.b)[: model.stations]:
            for i in np.flatnonzero(rows.weight > 0.0):
                same = (node[1] == index[i]) & (node[0] == (rows.epoch[i] if moving else 0))
                has_row[same] = 1.0
                has_angle[same] = 1.0 if model.quantity == "angle" else has_angle[same]
    return has_row, has_angle


def _anchors(one: Problem) -> tuple[Array, Array]:
    """Return the reference rows of the emission times: of each row (m,), and of each epoch (k,); -1 without one.

    The reference of an epoch is its first row with an emission time. The second array is empty if epochs have no
    unknowns.
    """
    anchor, start = np.full(one.count, -1), np.full(one.epochs if one.layout.n_local else 0, -1)
    for rows, first in zip(one.rows, one.starts, strict=True):
        if MODELS[rows.kind].emission:
            for i in np.flatnonzero(rows.weight > 0.0):
                epoch = int(rows.epoch[i])
                start[epoch] = first + i if start[epoch] < 0 else start[epoch]
                anchor[first + i] = start[epoch]
    return anchor, start


def _range_rows(one: Problem, station: Array) -> tuple[Array, RangeRows]:
    """Return linear maps (v, m) of the measurements, and the rows over the ranges to the stations `station` (s,).

    The maps give the whitened rows, then the emission times, then the loops. A loop is a combination of rows that no
    range changes; its cost is the misfit of the measurements with each other.
    """
    design, emitted = _design(one, station)
    alone = whiten_rows(whiten(one.noise, one.weight), np.eye(one.count))
    times = alone @ emitted
    # After the projection that removes emission times, the rows depend on ranges only.
    bare = project_out(times, alone)
    basis, upper = np.linalg.qr(bare @ design, mode="complete")
    inside = min(upper.shape)
    # K is upper triangular: a rotation of the whitened rows does not change the cost
    turned = basis.T @ bare
    loops = turned[inside:]
    # Combinations of rows that no range changes: their cost is the misfit of loops.
    loops = loops[np.abs(loops).max(-1, initial=0.0) > _NOTHING * np.abs(alone).max()]
    emission = np.linalg.pinv(times) @ alone
    share = upper[:inside]
    norm = float(np.linalg.norm(share, 2)) if share.size else 0.0
    return np.concatenate([turned[:inside], emission, loops]), RangeRows(
        one.correction,
        np.array(share, order="C"),
        np.array(emission @ design, order="C"),
        _anchors(one)[1],
        norm,
        bool(np.abs(share.sum(-1)).max(initial=0.0) <= _LEVEL * norm),
        np.zeros(0),
        np.zeros(0, dtype=np.int64),
    )


def _design(one: Problem, station: Array) -> tuple[Array, Array]:
    """Return the coefficients of the ranges (m, s) and of the emission times (m, k) in the rows.

    `station` (s,) contains the station numbers.
    """
    design, emitted = np.zeros((one.count, len(station))), np.zeros((one.count, len(_anchors(one)[1])))
    place = {int(s): i for i, s in enumerate(station)}
    for rows, first in zip(one.rows, one.starts, strict=True):
        model = MODELS[rows.kind]
        for i in np.flatnonzero(rows.weight > 0.0):
            for coefficient, end in zip(model.ranges or (), (int(rows.a[i]), int(rows.b[i])), strict=False):
                if coefficient:
                    design[first + i, place[end]] += coefficient
            if model.emission:
                emitted[first + i, int(rows.epoch[i])] = 1.0
    return design, emitted


def _tape_rows(correction: Array, base: Array, lifts: Lifts, bounded: bool, problem: Problem) -> TapeRows | None:
    """Return the rows of problems as tapes, or None if a row has no tape.

    `base` (p,) are the starts of the other unknowns, `bounded` is the result of `_is_bounded`. The other arguments are
    the fields of `TapeRows`.
    """
    bare = problem.with_rows(z=np.zeros(problem.count))
    found = pack(bare, whiten(with_station_noise(bare).noise, bare.weight))
    scaled = any(form_of(bias).enters == "scales" for bias in problem.biases)
    return None if found is None else TapeRows(found.tables, found.numbers, correction, base, lifts, bounded, scaled)


def _is_bounded(one: Problem) -> bool:
    """Return whether a row or a prior makes the cost grow without bound when the target moves far away.

    Ranges that add up do so, unless a scale or an offset without a prior absorbs them. Heights and a prior on the
    position do so too.
    """
    free = {bias.name for bias in one.biases if bias.sigma is None or form_of(bias).enters == "scales"}
    touched = np.zeros(one.count, dtype=bool)
    for bias in one.biases:
        touched[bias.row] |= bias.name in free
    if any(prior.name == "position" for prior in one.priors):
        return True
    for rows, start in zip(one.rows, one.starts, strict=True):
        model = MODELS[rows.kind]
        grows = rows.kind == "height" or (model.ranges is not None and sum(model.ranges) != 0 and not model.emission)
        present = (rows.weight > 0.0) & ~touched[start : start + rows.count]
        if grows and present.any():
            return True
    return False
