"""Physical checks of a problem before it is solved: negative ranges, wrong units, wrapped counters, slant ranges.

`refuse_impossible` raises for values that no position can have. `suspicious_values` returns sentences about suspicious
values, and never changes a value. All readers use the same table of checks, `CHECKS`.

In shapes, n is the number of rows of one group, and d the dimension. A group has the rows of one kind in one epoch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from optloc.base.cached import cached_property
from optloc.base.errors import InvalidProblem
from optloc.base.types import Array, Band, Rows
from optloc.base.units import SPEED_OF_LIGHT
from optloc.model_checks.cause import Advice
from optloc.models import MODELS
from optloc.problem.chart import tail_probability
from optloc.problem.noise import variances
from optloc.problem.problem import Problem

# Number of standard deviations beyond which noise does not explain a value.
_SIGMAS = 6.0
# Share of pairs of rows that must contradict the stations. Outliers are rarer in usable data.
_MAJORITY = 0.5
# Share of pairs that may contradict the stations in another unit: outliers exist in that unit, too.
_RARE = 0.1
# Largest number of groups that are checked: an error of the unit affects all groups.
_GROUPS = 64
# Largest number of rows of a group that are compared in pairs.
_PAIRED = 40
# Ranges beyond this multiple of the extent of the stations are remote: ranges in centimetres are about 100 times it.
_REMOTE = 30.0
# Chi-square probabilities: below the first the values do not fit, above the second they fit.
_MISFIT, _FITS = 1e-4, 1e-3
# Shortest period of a counter, in extents of the stations: a shorter one is not separable from an outlier.
_LONG = 20.0
# Periods of clocks, s: hour, day, GPS week, and the 40 bits of UWB radios at 128 * 499.2 MHz (DW1000 user manual).
_PERIODS = {
    "an hour": 3600.0,
    "a day": 86400.0,
    "a week": 604800.0,
    "the 40 bits of a UWB radio": 2.0**40 / (128 * 499.2e6),
}
# Bits of a counter, 8 to 63: smaller counters wrap within a measurement, larger ones never.
_BITS = range(8, 64)


@dataclass(frozen=True, slots=True)
class OptionWords:
    """Names of options in messages; braces hold the value.

    unit: unit of the values. height: height of the target. stations: heights of the stations. missing: numbers that
    mean no reading. add: way to change single values.
    """

    unit: str
    height: str
    stations: str
    missing: str
    add: str


OPTIONS: Mapping[str, OptionWords] = {
    "table": OptionWords(
        "--unit {}", "--height", "a column z of the stations", "--missing={}", "add the period to the small times"
    ),
    "file": OptionWords(
        'unit = "{}"', 'kind = "height"', "a column z of the stations", "an empty cell", "add the period to these times"
    ),
    "python": OptionWords("unit='{}'", "height=", "z of the stations", "NaN", "add the period to the small times"),
    "live": OptionWords(
        'unit = "{}" in the site', 'kind = "height"', "z of the stations", "no row", "add the period to the small times"
    ),
}
"""Names of options by the surface: a measurement table, a problem file, Python, or a live site."""


@dataclass(frozen=True)  # without slots, because the cached properties need `__dict__`
class _RangeGroup:
    """Ranges or arrivals of one epoch and target.

    kind: measurement kind. places: positions of the stations (n, d), m. z, sigma: values and standard deviations (n,),
    m.
    """

    kind: str
    places: Array
    z: Array
    sigma: Array

    @property
    def emission(self) -> bool:
        """Return whether the emission time is unknown, so that only differences of values have a meaning."""
        return MODELS[self.kind].emission

    @cached_property
    def pairs(self) -> tuple[Array, Array]:
        """Return the row numbers of all pairs, two arrays."""
        return np.triu_indices(len(self.z), 1)

    @cached_property
    def apart(self) -> Array:
        """Return the distance of the stations of each pair, m."""
        i, j = self.pairs
        return np.asarray(np.linalg.norm(self.places[i] - self.places[j], axis=-1))


@dataclass(frozen=True, slots=True)
class _Differences:
    """Range differences: absolute values (n,), distances of their stations (n,) and sigmas (n,), all in m."""

    size: Array
    apart: Array
    sigma: Array


@dataclass(frozen=True)  # without slots, because the cached properties need `__dict__`
class _View:
    """Data of the checks: a flat problem, the names of options, and the units of counters.

    `units` has the metres in one unit of the written values by kind, and `speed` the metres in a second; both are empty
    or None where they are unknown.
    """

    problem: Problem
    words: OptionWords
    units: Mapping[str, float] = field(default_factory=dict)
    speed: float | None = None

    @cached_property
    def groups(self) -> list[_RangeGroup]:
        """Return groups of ranges and arrivals with at least two present rows each."""
        return list(_groups(self))

    @cached_property
    def differences(self) -> _Differences:
        """Return the range differences of the first epochs."""
        return _differences(self)

    @cached_property
    def sigma(self) -> Array:
        """Return the standard deviations (1 or N, m) of all rows."""
        return np.sqrt(variances(self.problem.noise, self.problem.count)).reshape(-1, self.problem.count)


@dataclass(frozen=True, slots=True)
class PhysicalCheck:
    """One check: its name, which is the cause of its advice, and a function that yields advice."""

    name: str
    find: Callable[[_View], Iterator[Advice]]


# Values that no position can have.


def least_values(problem: Problem) -> Array:
    """Return the least possible values (..., m) of all rows, SI; minus infinity for rows without a limit.

    A range or a sum of ranges is not negative, beyond its noise and without a bias.
    """
    least = -_SIGMAS * np.sqrt(variances(problem.noise, problem.count)) + problem.correction
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        part = slice(start, start + rows.count)
        limited = MODELS[rows.kind].ranges in ((1, 0), (1, 1)) and not MODELS[rows.kind].emission
        if not limited or _is_biased(problem, part):
            least[..., part] = -np.inf
    return np.asarray(least)


def refuse_impossible(problem: Problem, where: Callable[[int], str], surface: str) -> None:
    """Raise InvalidProblem for a negative range or sum of ranges.

    `where` returns the place of a row for messages, from its global number. `surface` is a key of `OPTIONS`.
    """
    if not any((rows.z < 0.0).any() for rows in problem.rows):  # also for NaN, which is a missing value
        return
    bad = (problem.z < least_values(problem)) & (problem.weight > 0.0)
    if not bad.any():
        return
    index = tuple(np.argwhere(bad)[0])
    number, value = int(index[-1]), float(np.broadcast_to(problem.observed, bad.shape)[index])
    rows, start = next(
        (rows, start)
        for rows, start in zip(problem.rows, problem.starts, strict=True)
        if start <= number < start + rows.count
    )
    what = f"the {rows.kind.replace('_', ' ')} at {problem.stations.names[rows.a[number - start]]} is {value:.4g} m"
    advice = f"correct it; if it means no reading, use {OPTIONS[surface].missing.format(f'{value:g}')}"
    raise InvalidProblem(f"{what}, and no distance is negative", where(number), advice)


def _is_biased(problem: Problem, part: slice) -> bool:
    """Return whether a bias affects a row in the slice `part`, so that any value is possible."""
    return any(((bias.row >= part.start) & (bias.row < part.stop)).any() for bias in problem.biases)


# Suspicious values.


def suspicious_values(
    problem: Problem,
    surface: str = "python",
    *,
    units: Mapping[str, float] | None = None,
    speed: float | None = SPEED_OF_LIGHT,
) -> tuple[Advice, ...]:
    """Return advice on values that are physically suspicious, before the problem is solved.

    Parameters
    ----------
    problem : Problem
        Any problem. NaN measurements are left out.
    surface : "table", "file", "python" or "live"
        Source of the problem, which determines the names of options in messages.
    units : mapping of kind to float, optional
        Metres in one unit of the written values, which detects counters that wrap.
    speed : float, optional
        Propagation speed, m/s; None if it is unknown.

    Returns
    -------
    tuple of Advice
        Empty for plausible values. The cause is a name of `CHECKS`.
    """
    if problem.medium is not None:  # bent rays are no straight distances
        return ()
    view = _View(problem.flat(), OPTIONS[surface], units or {}, speed)
    return tuple(advice for check in CHECKS for advice in check.find(view))


def _groups(view: _View) -> Iterator[_RangeGroup]:
    """Yield the groups of ranges and arrivals: of the first items of the batch, and of epochs spread evenly."""
    problem, position = view.problem, view.problem.stations.position
    # A long run has millions of rows, and an error of the unit affects all epochs.
    epochs = np.unique(np.linspace(0, problem.epochs - 1, min(problem.epochs, _GROUPS)).astype(int))
    items = range(min(problem.batch_shape[0], max(_GROUPS // len(epochs), 1)))
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        if not _is_plain_range(rows) or _is_biased(problem, slice(start, start + rows.count)):
            continue
        z, weight = (np.reshape(v, (-1, rows.count)) for v in (rows.z - rows.correction, rows.weight))
        chosen = np.flatnonzero(np.isin(rows.epoch, epochs)) if problem.epochs > _GROUPS else np.arange(rows.count)
        key = rows.epoch[chosen] * (int(rows.target.max(initial=0)) + 2) + rows.target[chosen]
        order = chosen[np.argsort(key, kind="stable")]
        members = np.split(order, np.flatnonzero(np.diff(np.sort(key))) + 1)
        for item in items:
            present = (weight[item % len(weight)] > 0.0) & np.isfinite(z[item % len(z)])
            for member in members:
                use = member[present[member]][:_PAIRED]
                if len(use) > 1:
                    at = int(rows.epoch[use[0]]) if position.shape[-3] > 1 else 0
                    places = (position[item % len(position)] if position.ndim > 3 else position)[at, rows.a[use]]
                    spread = view.sigma[item % len(view.sigma), start + use]
                    yield _RangeGroup(rows.kind, places, z[item % len(z), use], spread)


def _differences(view: _View) -> _Differences:
    """Return the present range differences of the first item of the batch, at most `_GROUPS` times `_PAIRED`."""
    problem, position = view.problem, view.problem.stations.position
    parts = [(np.zeros(0), np.zeros(0), np.zeros(0))]
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        model, part = MODELS[rows.kind], slice(start, start + rows.count)
        if model.ranges != (1, -1) or model.straight is not None or _is_biased(problem, part):
            continue
        z, weight = (np.reshape(v, (-1, rows.count))[0] for v in (rows.z - rows.correction, rows.weight))
        chosen = np.flatnonzero(np.isfinite(z) & (weight > 0.0))[: _GROUPS * _PAIRED]
        at = rows.epoch[chosen] if position.shape[-3] > 1 else np.zeros_like(chosen)
        places = position[0] if position.ndim > 3 else position
        apart = np.linalg.norm(places[at, rows.a[chosen]] - places[at, rows.b[chosen]], axis=-1)
        parts.append((np.abs(z[chosen]), apart, view.sigma[0, part][chosen]))
    return _Differences(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _is_plain_range(rows: Rows) -> bool:
    """Return whether the values are distances from one station, perhaps with a common unknown emission time."""
    model = MODELS[rows.kind]
    return model.ranges == (1, 0) and model.stations == 1 and model.straight is None


def _contradictions(view: _View, factor: float) -> tuple[float, float]:
    """Return the shares of pairs whose values, multiplied by `factor`, are too far apart, and too short.

    The difference of two ranges is at most the distance of their stations. Their sum is at least this distance, unless
    the emission time is unknown.
    """
    # The noise may be stated in another unit than the values, so the smaller one counts.
    scale = min(1.0, factor)
    given = view.differences
    far, short = int((given.size * factor > given.apart + _SIGMAS * given.sigma * scale).sum()), 0
    count = len(given.size)
    for group in view.groups:
        i, j = group.pairs
        noise = _SIGMAS * np.hypot(group.sigma[i], group.sigma[j]) * scale
        far += int((np.abs(group.z[i] - group.z[j]) * factor > group.apart + noise).sum())
        if not group.emission:
            short += int(((group.z[i] + group.z[j]) * factor < group.apart - noise).sum())
        count += len(i)
    return far / max(count, 1), short / max(count, 1)


# Factors of common mistakes of units: the mistake, and the meant unit where metres are read. A factor of 100 too small
# has no example, because metres are seldom stated as centimetres.
_FACTORS = {
    1e-2: ("100 times too large", "cm"),
    1e-3: ("1000 times too large", "mm"),
    1e2: ("100 times too small", None),
    1e3: ("1000 times too small", "km"),
}


def _find_size(view: _View) -> Iterator[Advice]:
    """Yield advice if the values contradict the distances of the stations, and another unit removes this."""
    far, short = _contradictions(view, 1.0)
    remote = far <= _MAJORITY and short <= _MAJORITY
    if remote and not _is_remote(view):
        return
    fitting = []
    for factor, words in _FACTORS.items():
        if (factor < 1.0) != (far > _MAJORITY or remote) or max(_contradictions(view, factor)) > _RARE:
            continue
        if not remote or _linear_p(view.groups, factor) > _FITS:
            fitting.append(words)
    if not fitting:
        yield from _find_header(view)
        return
    kinds = dict.fromkeys([group.kind for group in view.groups] + ["tdoa"] * bool(len(view.differences.size)))
    seen = f"the {' and '.join(kinds)} values are {' or '.join(text for text, _ in fitting)} for the distances of the"
    # A unit is an example only for values that were read as metres.
    meant = [unit for _, unit in fitting if unit and not {"toa", "tdoa"} & {*kinds}]
    plain = all(view.units.get(kind, 1.0) == 1.0 for kind in kinds)
    example = f", such as {' or '.join(view.words.unit.format(unit) for unit in meant)}" if meant and plain else ""
    yield Advice("size", f"{seen} stations", f"state their unit{example}, or correct the unit of the stations")


def _find_header(view: _View) -> Iterator[Advice]:
    """Yield advice if ranges contradict the stations in their written unit, and fit them as plain metres."""
    kinds = {group.kind for group in view.groups}
    # Differences of arrivals fit in any unit that makes them small. Ranges must also be long enough.
    if len(kinds) != 1 or view.groups[0].emission or len(view.differences.size):
        return
    (kind,) = kinds
    size = view.units.get(kind, 0.0)
    if size not in (0.0, 1.0) and max(_contradictions(view, 1.0 / size)) <= _RARE:
        seen = f"the {kind} values contradict the stations in their unit, and fit them as metres"
        yield Advice("size", seen, f"state their unit, such as {view.words.unit.format('m')}, or correct the header")


def _is_remote(view: _View) -> bool:
    """Return whether ranges of a plain frame are far longer than the stations are apart, and fit no position."""
    groups = [group for group in view.groups if not group.emission]
    if view.problem.frame.geodetic or not groups or len(groups) < len(view.groups):
        return False
    ratio = [float(np.median(group.z)) / max(float(group.apart.max()), 1e-300) for group in groups]
    return float(np.median(ratio)) > _REMOTE and 0.0 <= _linear_p(groups, 1.0) < _MISFIT


@dataclass(frozen=True, slots=True)
class _LinearFit:
    """The linear fit of squared ranges: z^2 = |x|^2 - 2 s.x + |s|^2 + h^2, with the last constant free.

    cost: chi-square. dof: redundancy. excess: h^2, square metres, the squared distance from the plane of the stations.
    sigma: standard deviation of the excess.

    J. O. Smith, J. S. Abel, IEEE J. Ocean. Eng. 12 (1987): spherical interpolation; the constant is free here.
    """

    cost: float
    dof: int
    excess: float
    sigma: float


def _linear_fit(group: _RangeGroup, factor: float = 1.0) -> _LinearFit | None:
    """Return the linear fit of ranges, multiplied by `factor`; None without redundancy or for a singular geometry."""
    n, d = group.places.shape
    if n < d + 2:
        return None
    z, sigma = group.z * factor, group.sigma * min(1.0, factor)
    s = group.places - group.places.mean(0)
    size = max(float(np.abs(s).max()), 1e-300)
    # The noise of a square is 2 z sigma; a range near zero keeps the noise of a square of sigma.
    weight = 1.0 / (2.0 * np.hypot(z, sigma) * sigma)
    design = np.column_stack([-2.0 * s, np.full(n, size)]) * weight[:, None]
    y = (z**2 - sigma**2 - (s**2).sum(-1)) * weight
    solution, _, rank, _ = np.linalg.lstsq(design, y, rcond=1e-9)
    if rank < d + 1:
        return None
    x, constant = solution[:d], float(solution[d]) * size
    covariance = np.linalg.inv(design.T @ design)
    slope = np.append(-2.0 * x, size)
    cost = float(((design @ solution - y) ** 2).sum())
    spread = float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
    return _LinearFit(cost, n - d - 1, constant - float(x @ x), spread)


def _linear_p(groups: list[_RangeGroup], factor: float) -> float:
    """Return the chi-square probability of the linear fits of all groups; -1 without redundancy."""
    fits = [fit for group in groups if (fit := _linear_fit(group, factor)) is not None]
    if not fits:
        return -1.0
    return float(tail_probability(np.array(sum(fit.cost for fit in fits)), np.array(sum(fit.dof for fit in fits))))


def _find_slant(view: _View) -> Iterator[Advice]:
    """Yield advice if ranges in two dimensions fit no point of the plane, but a target at one distance from it."""
    groups = [group for group in view.groups if not group.emission]
    if view.problem.dimension != 2 or not groups:
        return
    fits = [fit for group in groups if (fit := _linear_fit(group)) is not None]
    off = [fit for fit in fits if fit.excess > _SIGMAS * fit.sigma and _p(fit) > _FITS]
    if not fits or len(off) <= _MAJORITY * len(fits):
        return
    height = float(np.sqrt(np.median([fit.excess for fit in off])))
    seen = f"the ranges fit no point of the plane, but a target {height:.3g} m above or below it: they are slant ranges"
    yield Advice("slant", seen, f"state {view.words.stations} and the height of the target ({view.words.height})")


def _p(fit: _LinearFit) -> float:
    """Return the chi-square probability of a linear fit."""
    return float(tail_probability(np.array(fit.cost), np.array(fit.dof)))


def _find_short(view: _View) -> Iterator[Advice]:
    """Yield advice if a range is shorter than the stated difference of height between its station and the target."""
    problem = view.problem
    gap = _height_gaps(problem)
    if gap is None:
        return
    found = []
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        part = slice(start, start + rows.count)
        if not _is_plain_range(rows) or MODELS[rows.kind].emission or _is_biased(problem, part):
            continue
        z = np.reshape(rows.z - rows.correction, (-1, rows.count))
        bad = (z + _SIGMAS * view.sigma[:, part] < gap[rows.a]) & (np.reshape(rows.weight, (-1, rows.count)) > 0.0)
        found += [(rows, int(i), float(z[item, i])) for item, i in np.argwhere(bad)]
    if found:
        rows, i, value = found[0]
        name = problem.stations.names[rows.a[i]]
        more = f" ({len(found)} ranges are too short)" if len(found) > 1 else ""
        seen = f"the range at {name} is {value:.4g} m, but its height differs by {gap[rows.a[i]]:.4g} m{more}"
        yield Advice("height", seen, f"correct the heights of the stations or of the target ({view.words.height})")


def _height_gaps(problem: Problem) -> Array | None:
    """Return the least distance (s,) of each station from the stated heights of the target, m; None without heights."""
    position = problem.stations.position
    if problem.dimension != 3 or position.ndim > 3 or position.shape[-3] > 1:
        return None
    for band in problem.constraints:
        if not isinstance(band, Band) or np.ndim(band.lower) or np.ndim(band.upper):
            continue
        if band.kind == "height" and problem.frame.geodetic:
            level = problem.frame.to_geodetic(position[0])[2]
        elif band.kind == "plane" and not problem.frame.geodetic and np.array_equal(band.coefficients, (0.0, 0.0, 1.0)):
            level = position[0, :, 2]
        else:
            continue
        return np.asarray(np.maximum(np.maximum(band.lower - level, level - band.upper), 0.0))
    return None


def _find_wrap(view: _View) -> Iterator[Advice]:
    """Yield advice if some arrivals of an epoch are one period of a counter or clock earlier than the others."""
    periods = dict(_counters(view))
    found = [name for group in view.groups if group.emission and (name := _period(group, periods))]
    if found:
        name = max(set(found), key=found.count)
        seen = (
            f"in {len(found)} epoch{'s' if len(found) > 1 else ''} some times are earlier by {name}: a counter wrapped"
        )
        yield Advice("wrap", seen, view.words.add)


def _counters(view: _View) -> Iterator[tuple[str, float]]:
    """Yield the name and the length, m, of the periods of counters and clocks."""
    if view.speed is not None:
        yield from ((name, seconds * view.speed) for name, seconds in _PERIODS.items())
        counts = [size for size in view.units.values() if size < 0.5 * view.speed]  # whole seconds are no counts
        yield from ((f"2^{bits} counts", 2.0**bits * size) for size in counts for bits in _BITS)


def _period(group: _RangeGroup, periods: Mapping[str, float]) -> str | None:
    """Return the name of the period by which the smaller arrivals are early; None if they are not."""
    order = np.argsort(group.z)
    z, places = group.z[order], group.places[order]
    noise, extent = _SIGMAS * float(group.sigma.max()), float(group.apart.max())
    gaps = np.diff(z)
    cut = int(np.argmax(gaps)) + 1
    if gaps[cut - 1] <= _LONG * (extent + noise) or max(np.ptp(z[:cut]), np.ptp(z[cut:])) > extent + noise:
        return None
    late = z[cut:, None] - z[None, :cut]
    apart = np.linalg.norm(places[cut:, None] - places[None, :cut], axis=-1) + noise
    low, high = float((late - apart).max()), float((late + apart).min())
    return next((name for name, length in periods.items() if low <= length <= high), None)


CHECKS: tuple[PhysicalCheck, ...] = (
    PhysicalCheck("size", _find_size),
    PhysicalCheck("slant", _find_slant),
    PhysicalCheck("height", _find_short),
    PhysicalCheck("wrap", _find_wrap),
)
"""The checks of suspicious values. `refuse_impossible` has the check of impossible values."""


def wrapped_times(times: Array) -> str | None:
    """Return the name of the period at which the times of a table, s, start again; None if they do not.

    The rows are in the order of the table. The times before and after the wrap do not overlap, so a table that lists
    one target after the other is no wrap.
    """
    times = times[np.isfinite(times)]
    drops = np.flatnonzero(np.diff(times) < 0.0)
    if len(drops) != 1:
        return None
    before, after = times[: drops[0] + 1], times[drops[0] + 1 :]
    steps = np.diff(np.unique(times))
    if not len(steps) or after.max() >= before.min():
        return None
    # The step over the wrap is as long as other steps: at most ten of the median, since logs have gaps.
    periods = _PERIODS | {f"2^32 {unit}": 2.0**32 * size for unit, size in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))}
    for name, period in periods.items():
        step = float(after[0]) + period - float(before[-1])
        if 0.0 < step <= 10.0 * float(np.median(steps)) and before.max() <= period:
            return name
    return None
