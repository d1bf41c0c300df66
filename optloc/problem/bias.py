"""Systematic errors (biases): families with one unknown for each station, group of stations, pair, kind or target.

A family consists of q members. Each member is one unknown error, or three angles for a rotation in space. A list of
entries (row, member, coefficient) links members to rows: the row contains the coefficient times the error.

Arguments of private functions: `form` is the `BiasForm`. `members` are the names that the caller gave, or None for all.
`where` is the location that messages name. `blocks` are blocks of rows, each with the global number of its first row.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import ArrayLike

from optloc.base.arrays import numbers
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Amounts, Array, Bias, FormName, Rows
from optloc.base.units import Quantity, in_si
from optloc.models import MODELS
from optloc.models.primitives import rotate
from optloc.problem.forms import FORMS, BiasForm, complete, form_of
from optloc.problem.problem import Problem
from optloc.problem.validation import check_unknowns

Per = Literal["station", "pair", "kind", "target"]
Members = Sequence[str] | Mapping[str, Sequence[str]] | None
# Row numbers, member numbers and coefficients, each (n,).
_Entries = tuple[Array, Array, Array]
# Names of other unknowns in the layout. A bias with one of these names would hide that unknown.
_TAKEN = ("position", "velocity", "acceleration", "emission", "stations", "station velocities")


def with_bias(
    problem: Problem,
    name: str,
    *,
    per: Per = "station",
    form: FormName = "offset",
    kind: str | None = None,
    members: Members = None,
    mean: Amounts = 0.0,
    sigma: Amounts | None = None,
    density: ArrayLike | None = None,
    rate_density: ArrayLike | None = None,
    knots: int | ArrayLike | None = None,
) -> Problem:
    """Return the problem with one more family of unknown systematic errors (biases).

    Parameters
    ----------
    problem : Problem
        A problem. Its existing biases stay.
    name : str
        Name of the family, for instance "clock".
    per : "station", "pair", "kind" or "target"
        Rows that share one error. "station": all rows of a station; the error has the sign with which the station's
        arrival enters the row. "pair": all rows of a pair of stations. "kind": all rows of a kind. "target": all rows
        of a target, for instance the frequency offset of an emitter.
    form : "offset", "scale", "drift", "rotation", "time", "walk" or "spline"
        How the error enters the measurement. "offset": the error is added. "scale": the error is multiplied by the
        measured quantity. "drift": the error is multiplied by the seconds since the reference time of the first target
        (default: the first epoch). "rotation": the axes of the station are turned. "time": the station is ahead on its
        course by this number of seconds, so its position error is velocity times this time. "walk": an added error that
        changes between epochs as a random walk, for instance a clock. "spline": an added error that is a smooth
        function of time.
    kind : str, optional
        Kind of the affected rows. Default: all kinds; for a rotation all kinds that are measured in station axes, for a
        time all kinds that involve stations.
    members : sequence of str, or mapping of str to sequence of str, optional
        Stations (or pairs, "A-B", or targets, "0") that have an error; by default all that measure. A mapping gives
        groups of stations that share one error, by group name. If all rows are differences, leave out the reference
        station: an error that all stations share has no effect.
    mean : float, str or array (q,) or (q, 3)
        Prior mean of each member, or text such as "20 ns". The unit of bare numbers is the SI unit of the measurements;
        1 for a scale, unit per second for a drift, radians for a rotation (three angles in space), seconds for a time.
    sigma : float, str or array like `mean`, optional
        Prior standard deviation. None: there is no prior. For a walk, mean and sigma apply to the value at the first
        epoch.
    density : float or array (q,), optional
        For a walk: spectral density of its white noise, in the squared unit of the rows per second. After t seconds the
        standard deviation of the change is ``sqrt(density * t)``.
    rate_density : float or array (q,), optional
        For a walk with a rate: spectral density of the white noise of the rate, squared unit per second cubed. Clocks
        have both densities; `optloc.problem.clock_densities` computes them from Allan deviations.
    knots : int or array (p,), optional
        For a spline: times of the knots in seconds, or the number of evenly spaced knots. Between two knots the spline
        is a cubic polynomial.

    Raises
    ------
    InvalidProblem
        For a name in use, an unknown kind or member, or a member without rows. For rows of several quantities, a
        rotation of rows without axes, or a prior that does not fit.
    """
    where = f"bias {name!r}"
    bias = family(problem.rows, problem.stations.names, name, per=per, form=form, kind=kind, members=members)
    bias = complete(bias, problem.times, where, density=density, rate_density=rate_density, knots=knots)
    shape = FORMS[form].shape(bias, problem.dimension)
    quantity = _quantity(problem, bias)
    centre = _per_member(in_si(mean, quantity, f"{where}, mean"), shape, where, "mean")
    spread = (
        None
        if sigma is None
        else _per_member(in_si(sigma, quantity, f"{where}, sigma", deviation=True), shape, where, "sigma")
    )
    result = replace(problem, biases=(*problem.biases, replace(bias, mean=centre, sigma=spread)))
    check_unknowns(result)
    return result


def _quantity(problem: Problem, bias: Bias) -> Quantity:
    """Return the physical quantity of the values of a bias, for the conversion of units.

    The result is "plain" if the values have no unit or are angles per second.
    """
    form = form_of(bias)
    if form.quantity is not None:
        return form.quantity
    kinds = [rows.kind for rows in problem.rows for _ in range(rows.count)]
    measured = MODELS[kinds[int(bias.row[0])]].quantity
    rates: dict[str, Quantity] = {"length": "speed"}
    return rates.get(measured, "plain") if form.rate else cast("Quantity", measured)


def family(
    rows: Sequence[Rows],
    stations: Sequence[str],
    name: str,
    *,
    per: Per = "station",
    form: FormName = "offset",
    kind: str | None = None,
    members: Members = None,
    targets: Sequence[str] | None = None,
    where: str | None = None,
) -> Bias:
    """Return a bias without a prior over the given rows; other arguments as for `with_bias`.

    If all azimuths that the bias affects were read clockwise, its values are clockwise too: its coefficients are
    negative. A bias of the form "time" has no sense of rotation.

    Parameters
    ----------
    rows : sequence of Rows
        All rows of the problem.
    stations : sequence of str
        Names of the stations.
    targets : sequence of str, optional
        Names of the targets; their numbers by default.
    where : str, optional
        Location that error messages name. Default: the name of the bias.
    """
    where = where or f"bias {name!r}"
    if not name or name.partition("[")[0] in _TAKEN:
        advice = f"choose another name; reserved are {', '.join(_TAKEN)}"
        raise InvalidProblem(f"the name {name!r} is taken" if name else "the name is empty", where, advice)
    for value, known, what in ((per, get_args(Per), "per"), (form, tuple(FORMS), "form")):
        if value not in known:
            raise InvalidProblem(f"unknown {what} {value!r}", where, nearest(str(value), known))
    # `per` decides the names of the members and the sign with which each row depends on them.
    bias_form = FORMS[form]
    blocks = _select_rows(rows, bias_form, kind, where)
    if not bias_form.of_readings and per != "station":
        raise InvalidProblem("a time along a course belongs to one station", where, "use per = 'station', or groups")
    if per == "kind":
        if members is not None:
            raise InvalidProblem("a kind has no members", where, "leave members out, or use per = 'station'")
        names, entries = tuple(block.kind for block, _ in blocks), _by_kind(blocks)
    elif per == "pair":
        names, entries = _by_pair(blocks, stations, members, where)
    elif per == "target":
        names, entries = _by_target(blocks, targets, members, where)
    else:
        names, entries = _by_station(blocks, bias_form, stations, members, where)
    row, member, coefficient = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    # No measurement would determine a member without rows.
    unused = sorted(set(range(len(names))) - set(member.tolist()))
    if unused:
        raise InvalidProblem(f"{names[unused[0]]} affects no row", f"{where}, members", "leave it out")
    if bias_form.of_readings:
        coefficient = coefficient * _sense(rows, row)
    return Bias(name, names, row, member, coefficient, form, np.zeros(1))


def _sense(rows: Sequence[Rows], affected: Array) -> float:
    """Return the sign of the bias: -1 if the rows contain azimuths and all were read clockwise, otherwise 1.

    `affected` (n,) are the global numbers of the rows that the bias affects. Elevations among these rows do not affect
    the result.
    """
    ends = np.cumsum([block.count for block in rows])
    blocks = [rows[i] for i in np.unique(np.searchsorted(ends, affected, side="right"))]
    senses = {block.sense for block in blocks if block.kind == "azimuth"}
    return senses.pop() if len(senses) == 1 else 1.0


def _select_rows(rows: Sequence[Rows], form: BiasForm, kind: str | None, where: str) -> list[tuple[Rows, int]]:
    """Return the blocks of rows that a bias can affect, each with the global number of its first row.

    `kind` is the kind that the caller named, or None. `where` is the location that error messages name.
    """
    starts = np.cumsum([0, *(block.count for block in rows)]).tolist()
    kinds = [block.kind for block in rows]
    if kind is not None and kind not in kinds:
        raise InvalidProblem(f"there are no rows of kind {kind!r}", f"{where}, kind", nearest(kind, kinds))
    chosen = [
        (block, start)
        for block, start in zip(rows, starts, strict=False)
        if kind == block.kind or (kind is None and form.touches(MODELS[block.kind]))
    ]
    if not chosen:
        of = "axes of stations" if form.enters == "turns" else "stations"
        raise InvalidProblem(f"no rows depend on the {of}", where, "leave the bias out")
    if form.enters == "turns" and not MODELS[chosen[0][0].kind].axes:
        raise InvalidProblem(f"{kind} has no axes that could be turned", where, "use the form offset")
    # One value cannot be in metres for one row and in radians for another.
    if form.of_readings and len({MODELS[block.kind].quantity for block, _ in chosen}) > 1:
        raise InvalidProblem("the rows measure different quantities", where, "name the kind of the rows")
    return chosen


def _entries(row: Array, member: Array, sign: float) -> _Entries:
    """Return row numbers, member numbers and coefficients (n,) of the rows that have a member.

    `row` (m,) are global row numbers. `member` (m,) is the member of each row, or -1 for none. `sign` is the
    coefficient of all entries.
    """
    inside = member >= 0
    return row[inside], member[inside], np.full(int(inside.sum()), sign)


def _by_kind(blocks: list[tuple[Rows, int]]) -> list[_Entries]:
    """Return the entries of a family with one member for each kind; `blocks` are the result of `_select_rows`."""
    return [
        _entries(start + np.arange(block.count), np.full(block.count, i), 1.0)
        for i, (block, start) in enumerate(blocks)
    ]


def _by_pair(
    blocks: list[tuple[Rows, int]], stations: Sequence[str], members: Members, where: str
) -> tuple[tuple[str, ...], list[_Entries]]:
    """Return the member names and the entries of a family with one member for each pair of stations.

    `blocks` are the result of `_select_rows`. `members` are the pairs to use, such as "A-B", or None for all pairs that
    have rows. `where` is the location that error messages name. `_by_target` and `_by_station` have these arguments
    too.
    """
    named = (*stations, "")  # the last entry is index -1, no station
    # Each pair has one number. A missing second station (-1) counts as an extra station with an empty name.
    codes = [block.a * len(named) + block.b % len(named) for block, _ in blocks]
    pairs = np.unique(np.concatenate(codes))
    present = tuple("-".join(filter(None, (named[i // len(named)], named[i % len(named)]))) for i in pairs.tolist())
    if isinstance(members, Mapping):
        raise InvalidProblem("pairs have no groups", f"{where}, members", "give names such as 'A-B'")
    names = present if members is None else _check_names(members, present, "pair", where)
    member_of = np.array([names.index(label) if label in names else -1 for label in present])
    return names, [
        _entries(start + np.arange(block.count), member_of[np.searchsorted(pairs, code)], 1.0)
        for (block, start), code in zip(blocks, codes, strict=True)
    ]


def _by_target(
    blocks: list[tuple[Rows, int]], targets: Sequence[str] | None, members: Members, where: str
) -> tuple[tuple[str, ...], list[_Entries]]:
    """Return the member names and the entries of a family with one member for each target.

    `targets` are the names of the targets; without names, a target is named by its number.
    """
    numbers = np.unique(np.concatenate([block.target for block, _ in blocks]))
    present = {int(i): str(i) if targets is None else targets[i] for i in numbers if i >= 0}
    if isinstance(members, Mapping) or not present:
        what = "no row has a target" if not present else "targets have no groups"
        raise InvalidProblem(what, f"{where}, members", "name the targets")
    known = tuple(present.values())
    names = known if members is None else _check_names(members, known, "target", where)
    # Rows without a target (-1) index the last entry, so they have no error.
    member_of = np.full(max(present, default=0) + 2, -1)
    for i, label in present.items():
        member_of[i] = names.index(label) if label in names else -1
    return names, [_entries(start + np.arange(block.count), member_of[block.target], 1.0) for block, start in blocks]


def _by_station(
    blocks: list[tuple[Rows, int]], form: BiasForm, stations: Sequence[str], members: Members, where: str
) -> tuple[tuple[str, ...], list[_Entries]]:
    """Return the member names and the entries of a family with one member for each station or group of stations.

    A row with two stations gets two entries. The form of the bias gives the signs of both stations.
    """
    measuring = np.unique(np.concatenate([index for block, _ in blocks for index in (block.a, block.b)]))
    if isinstance(members, Mapping):
        owner = dict(_owners(members, stations, where))
        names = tuple(members)
    else:
        present = [stations[i] for i in measuring.tolist() if i >= 0]
        names = tuple(present) if members is None else _check_names(members, stations, "station", where)
        owner = {name: i for i, name in enumerate(names)}
    member_of = np.array([*(owner.get(name, -1) for name in stations), -1])  # the last entry is index -1, no station
    return names, [
        _entries(start + np.arange(block.count), member_of[index], float(sign))
        for block, start in blocks
        for index, sign in zip((block.a, block.b), form.signs(MODELS[block.kind]), strict=True)
        if sign
    ]


def _owners(members: Mapping[str, Sequence[str]], stations: Sequence[str], where: str) -> Iterator[tuple[str, int]]:
    """Yield the name of each station that is in a group, with the number of its group."""
    seen: set[str] = set()
    for i, (group, names) in enumerate(members.items()):
        for name in _check_names(names, stations, "station", f"{where}, {group!r}"):
            if name in seen:
                raise InvalidProblem(f"{name} is in two groups", f"{where}, {group!r}", "name it once")
            seen.add(name)
            yield name, i


def _check_names(given: Sequence[str], known: Sequence[str], noun: str, where: str) -> tuple[str, ...]:
    """Return the given names as a tuple; raise if the list is empty, or if a name is unknown or repeated.

    `known` are the valid names. `noun` is the word for a name in messages, such as "station".
    """
    names = (given,) if isinstance(given, str) else tuple(given)
    place = f"{where}, members"
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InvalidProblem(f"there is no {noun} {unknown[0]!r}", place, nearest(unknown[0], list(known)))
    if not names or len(set(names)) < len(names):
        twice = next((name for name in names if names.count(name) > 1), None)
        raise InvalidProblem(
            "no name is given" if twice is None else f"{twice} is named twice", place, "name each once"
        )
    return names


def _per_member(values: Any, shape: tuple[int, ...], where: str, noun: str) -> Array:
    """Return prior values as an array of the given shape, with the members as the first axis.

    `values` has one value for all members, or one value for each member. `noun` is "mean" or "sigma", for messages.
    """
    array = np.asarray(numbers(values, f"{where}, {noun}"))
    if array.shape == shape[:1]:
        array = array.reshape(*array.shape, *(1,) * (len(shape) - 1))
    elif array.size == np.prod(shape):
        array = array.reshape(shape)
    if array.ndim and array.shape[0] != shape[0]:
        raise InvalidProblem(
            f"{noun} has {array.size} entries for {shape[0]} members", where, "give one value, or one for each member"
        )
    return np.array(np.broadcast_to(array, shape))


# Biases that an earlier run determined: with known values they are no longer unknowns of the problem.


def with_known_bias(problem: Problem, name: str, values: ArrayLike | Mapping[str, float]) -> Problem:
    """Return the problem with one family of biases fixed at known values.

    Estimate a bias in one run and apply it to another: ``with_known_bias(later, "clock", fix.take("clock"))``.

    Parameters
    ----------
    problem : Problem
        A problem that has this family of biases.
    name : str
        Name of the family.
    values : array (q,) or (q, 3), or mapping of str to number
        Value of each member in the order of the family, in its unit (radians for a rotation, seconds for a time). A
        mapping gives the values by member name; members that it lacks get zero.

    Returns
    -------
    Problem
        The problem without the family. Its rows are corrected, or the axes of its stations turned, or its stations
        moved along their courses.

    Raises
    ------
    InvalidProblem
        If the family or a member does not exist, or if the values do not fit.
    """
    names = [bias.name for bias in problem.biases]
    if name not in names:
        raise InvalidProblem(f"there is no bias {name!r}", "name", nearest(name, names) if names else "there are none")
    bias = problem.biases[names.index(name)]
    form = form_of(bias)
    shape = form.shape(bias, problem.dimension)
    known = _in_member_order(bias, values, shape if form.steps is None else (problem.epochs, *shape))
    rest = replace(problem, biases=tuple(b for b in problem.biases if b is not bias))
    return {"turns": _turn_axes, "moves": _move_stations}.get(form.enters, _correct_rows)(rest, bias, known)


def _in_member_order(bias: Bias, values: Any, shape: tuple[int, ...]) -> Array:
    """Return known bias values as an array of the given shape, in the order of the members.

    `values` is an array, or a mapping from member names to values. Members that the mapping lacks get zero.
    """
    where = f"values of {bias.name!r}"
    if isinstance(values, Mapping) and form_of(bias).steps is not None:
        raise InvalidProblem("a walk has values at every epoch", where, f"give an array of shape {shape}")
    if isinstance(values, Mapping):
        strange = [member for member in values if member not in bias.members]
        if strange:
            raise InvalidProblem(f"{strange[0]!r} is no member", where, nearest(str(strange[0]), list(bias.members)))
        values = [values.get(member, np.zeros(shape[1:])) for member in bias.members]
    array = np.asarray(numbers(values, where))
    if array.size != np.prod(shape):
        raise InvalidProblem(f"there are {array.size} values", where, f"give an array of shape {shape}")
    if not np.isfinite(array).all():
        raise InvalidProblem("a value is not finite", where, "use the biases of a fix that has an answer")
    return array.reshape(shape)


def _correct_rows(problem: Problem, bias: Bias, known: Array) -> Problem:
    """Return the problem with known offsets, drifts or scales added to the corrections of its rows.

    `known` (q,) are the values of the members. For a walk, `known` (k, q) has one row for each epoch.
    """
    form, amount, epoch = form_of(bias), np.zeros(problem.count), problem.epoch[bias.row]
    # `entry` are the numbers of the values that enter each row, and `factor` their factors. Rows without entries get 0.
    entry, factor = form.effects(bias, problem.times, problem.origin, epoch)
    values = known.ravel()[entry] if form.steps is None else known[epoch[:, None], entry]
    np.add.at(amount, bias.row, (factor * values).sum(1))
    rows = []
    for block, start in zip(problem.rows, problem.starts, strict=True):
        # The correction is measured minus modelled. For a scale, z = h (1 + s), it depends on the measurement.
        added: Any = amount[start : start + block.count]
        if form.enters == "scales":
            added = (block.z - block.correction) * added / (1.0 + added)
        rows.append(replace(block, correction=block.correction + added))
    return replace(problem, rows=tuple(rows))


def _turn_axes(problem: Problem, bias: Bias, known: Array) -> Problem:
    """Return the problem with the axes of its stations turned by the known angles (q,) or (q, 3), radians."""
    d, stations = problem.dimension, problem.stations
    angles = np.zeros((stations.count, 1 if d == 2 else 3))
    station = np.concatenate([block.a for block in problem.rows])[bias.row]
    angles[station] = bias.coefficient[:, None] * known.reshape(len(known), -1)[bias.member]
    axes = np.eye(d) + np.zeros((1, stations.count, d, d)) if stations.axes is None else stations.axes
    rows_of_axes = tuple(tuple(axes[..., i, c] for c in range(d)) for i in range(d))
    # The model of rows with unknown turns uses the same `rotate`, so known and estimated turns agree.
    rows = rotate(rows_of_axes, tuple(angles[:, c] for c in range(angles.shape[1])))
    return replace(
        problem, stations=replace(stations, axes=np.stack([np.stack(row, axis=-1) for row in rows], axis=-2))
    )


def _move_stations(problem: Problem, bias: Bias, known: Array) -> Problem:
    """Return the problem with its stations moved along their courses by the known times (q,), seconds."""
    stations, seconds = problem.stations, np.zeros((problem.stations.count, 1))
    # A coefficient of 1 means the first station of a row, -1 the second. Other stations stay: their time is zero.
    for index, sign in (("a", 1.0), ("b", -1.0)):
        selected = bias.coefficient == sign
        station = np.concatenate([getattr(block, index) for block in problem.rows])[bias.row[selected]]
        seconds[station, 0] = known[bias.member[selected]]
    velocity, acceleration = course(problem)
    station = replace(
        stations, position=stations.position + seconds * velocity, velocity=velocity + seconds * acceleration
    )
    return replace(problem, stations=station)


# Stations that are further along their courses than their stated positions.

# Earth constants (WGS 84): m^3/s^2, rad/s, m. Last: the altitude in metres above which a station counts as a satellite.
_GM, _TURN, _RADIUS, _SKY = 3.986004418e14, 7.292115e-5, 6378137.0, 1e5


def course(problem: Problem) -> tuple[Array, Array]:
    """Return the velocity and the acceleration (k or 1, s, d) of the stations, m/s and m/s^2.

    A station more than 100 km above the Earth is in free fall around the rotating Earth; the flattening is ignored
    (0.02 of 8 m/s^2 in a low orbit). All other stations keep their velocity: a time error is only about a second.

    Parameters
    ----------
    problem : Problem
        A problem whose stations have velocities, the same in all problems of a batch.

    References
    ----------
    O. Montenbruck and E. Gill, "Satellite Orbits" (2000), eq. 3.1 and section 5.1, in axes that turn.
    """
    assert problem.stations.velocity is not None
    position, velocity = (
        array.reshape(-1, *array.shape[-3:])[0] for array in (problem.stations.position, problem.stations.velocity)
    )
    position, velocity = np.broadcast_arrays(position, velocity)
    if problem.frame.kind == "cartesian" or problem.dimension == 2:
        return velocity, np.zeros_like(velocity)
    rotation = problem.frame.rotation_to_ecef()
    ecef, ecef_velocity, axis = problem.frame.to_ecef(position), velocity @ rotation.T, np.array([0.0, 0.0, _TURN])
    radius = np.linalg.norm(ecef, axis=-1, keepdims=True)
    # The limit of the radius avoids a division by zero near the centre. Results below `_SKY` are not used.
    gravity = -_GM * ecef / np.maximum(radius, _RADIUS) ** 3
    acceleration = gravity - 2.0 * np.cross(axis, ecef_velocity) - np.cross(axis, np.cross(axis, ecef))
    return velocity, np.where(radius > _RADIUS + _SKY, acceleration @ rotation, 0.0)


# Unknown propagation speed: all times have the same relative error, which is a scale bias.

SPEED = "speed"
"""Name of the scale bias for a propagation speed with a stated sigma."""


def scale_of(speed: float, sigma: float, rows: Sequence[Array], place: str) -> Bias:
    """Return the scale bias, with its prior, for a propagation speed with a stated sigma.

    A time multiplied by the stated speed is the range multiplied by stated speed / true speed. The scale is this
    quotient minus one. The name of its only member is the stated speed.

    The scale is an unknown of the fix, so the uncertainty of the speed enters the covariance of the position.

    Parameters
    ----------
    speed, sigma : float
        Stated speed and its standard deviation, metres per second.
    rows : sequence of int array (m,)
        Global numbers of the rows that were measured as times.
    place : str
        Location that error messages name.
    """
    affected = np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *rows]))
    if not len(affected):
        raise InvalidProblem("the speed has a sigma, but no measurement is a time", place, "leave the sigma out")
    member, ones = np.zeros(len(affected), dtype=np.int64), np.ones(len(affected))
    return Bias(SPEED, (f"{speed:g} m/s",), affected, member, ones, "scale", np.zeros(1), np.array([sigma / speed]))


def estimated_speed(name: str, member: str, value: float, sigma: float) -> tuple[float, float] | None:
    """Return the speed and its sigma, m/s, from the estimate of a bias by `scale_of`; None for other biases.

    Parameters
    ----------
    name, member : str
        Names of the bias and of its member.
    value, sigma : float
        The estimated scale and its standard deviation.
    """
    number, _, unit = member.partition(" ")
    if name != SPEED or unit != "m/s" or not value > -1.0:
        return None
    speed = float(number) / (1.0 + value)
    return speed, speed * sigma / (1.0 + value)
