"""Detection of misread values: units wrong by a thousand or by the speed of light, signs, compass bearings.

If the values do not fit as they are read, other readings of the values are fitted and compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array, Rows
from optloc.base.units import SPEED_OF_LIGHT, UNITS
from optloc.linear.constraints import exact, violation_names
from optloc.linear.redundancy import degrees_of_freedom
from optloc.model_checks.cause import Advice
from optloc.model_checks.score import descend, fit_anywhere, one_place
from optloc.models import MODELS
from optloc.models.primitives import wrap
from optloc.problem.chart import tail_probability
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.noise import Block, Noise, variances
from optloc.problem.problem import Problem

# Chi-square probability below which the values do not fit as they are read, equal to the limit of the status `misfit`;
# and the probability above which they fit with another reading.
_MISFIT, _FITS = 1e-4, 1e-3
# Probability, over all readings together, that random values fit with one of the readings.
_CHANCE = 1e-3
# The same for the opposite sign, the only alternative of its sort: four receivers in the plane can show it.
_CHANCE_OF_SIGN = 1e-2
# Number of standard deviations beyond which a value is impossible.
_IMPOSSIBLE_SIGMAS = 6.0
# Number of epochs of a run that are tested: an error of all rows is visible in a few epochs.
_EPOCHS = 5
# Largest number of reported readings if several fit.
_MAX_READINGS = 2


@dataclass(frozen=True, slots=True)
class Reading:
    """Another interpretation of the values of some kinds: ``z -> shift + factor * z``.

    - cause: keyword, as in `Advice`.
    - kinds: kinds of the values.
    - factor, shift: in SI units and radians.
    - seen, advice: sentences, as in `Advice`.
    - toml: keys of ``[[measurements]]``.
    """

    cause: str
    kinds: tuple[str, ...]
    factor: float
    shift: float
    seen: str
    advice: str
    toml: str = ""


def advise_on_values(problem: Problem, x: Array) -> Iterator[Advice]:
    """Yield advice about values that do not fit as they are read, but fit with another unit, sign or convention.

    `problem` is a flat batch of one problem or run with finite values in its present rows. `x` (1, size) is its fix;
    NaN if there is no fix. If separate epochs are tested, the fix is not used.
    """
    # a run whose epochs share no unknowns becomes a batch of its epochs
    batch = by_epoch(problem).flat() if separable(problem) else problem
    # use the first epochs with redundancy
    items = np.flatnonzero(degrees_of_freedom(batch) > 0)[:_EPOCHS]
    wrong = list(_impossible_advice(problem))
    if len(items) and one_place(batch):
        tested = batch.take(items)
        # the vector of a run does not have the layout of a single epoch
        start = x if len(batch.weight) == len(x) and x.shape[-1] == batch.layout.size else None
        refuted, p_free = _test_as_read(tested, start if start is None else start[items])
        if wrong or refuted:
            constraint_advice = [] if wrong or p_free < _FITS else [_without_constraints(tested, p_free)]
            # impossible values are reported even if no reading explains them
            yield from constraint_advice or list(_fitting_readings(tested)) or wrong
            return
    yield from wrong


def _test_as_read(problem: Problem, start: Array | None) -> tuple[bool, float]:
    """Return whether the values fit no position, and the p-value of the best position without constraints.

    The p-value is 1 if the values fit, and 0 if there are no constraints. `start` (N, size) is a fix or None.
    """
    # the fix often fits, and one descent is much faster than a search for the best position
    near = np.inf if start is None or not np.isfinite(start).all() else float(descend(problem, start)[1].sum())
    if _p_of_cost(problem, near) >= _MISFIT:
        return False, 1.0
    return _p_of_best_fit(problem, start) < _MISFIT, _p_of_best_fit(
        replace(problem, constraints=()), start
    ) if problem.constraints else 0.0


def _p_of_best_fit(problem: Problem, start: Array | None = None) -> float:
    """Return the chi-square probability of the best position of a search, without inequalities.

    If the values fit without constraints, the position must also satisfy the equalities. If the values do not fit,
    equalities could only lower the probability further. `start` (N, size) is one more start of the search.
    """
    free = fit_anywhere(replace(problem, constraints=()), start)
    cost = float(free.cost.sum())
    if _p_of_cost(problem, cost) >= _MISFIT and exact(problem):
        # equalities take most of the time: apply them only if the values fit without them
        cost = float(descend(problem, free.x)[1].sum())
    return _p_of_cost(problem, cost)


def _without_constraints(problem: Problem, p: float) -> Advice:
    """Return the advice for values that fit without constraints with the p-value `p`, but not with them."""
    names = violation_names(problem)
    seen = f"the values fit without the constraints ({names}; p = {p:.2g}), but no position was found that meets both"
    return Advice("constraint", seen, "check their values; heights must be above the ellipsoid, not above the sea")


def _p_of_cost(problem: Problem, cost: float) -> float:
    """Return the chi-square probability of the total cost of a batch; zero if there is no fit or no redundancy."""
    p = float(tail_probability(np.array([cost]), np.array([degrees_of_freedom(problem).sum()]))[0])
    return p if np.isfinite(p) else 0.0


def _fitting_readings(problem: Problem) -> Iterator[Advice]:
    """Yield advice for the readings with a good fit that is unlikely by chance, the most probable reading first."""
    tried = list(_readings(problem))
    found = []
    for one in tried:
        # noise that is stated in a separate unit keeps its size; the problem does not hold this unit, so try both
        scaled, stated = _with_reading(problem, one, False), _with_reading(problem, one, True)
        # each reading is tested twice, so the probability of a fit by chance is multiplied by two (Bonferroni)
        able = [other for other in (scaled, stated) if _chance_of_fit(other) <= _largest_chance(one, len(tried))]
        if not able or _is_impossible(able[0]):
            continue
        p = max(_p_of_best_fit(other) for other in able)
        if p >= _FITS:
            found.append((p, one))
    # feet and nanoseconds are so similar that both may fit: the better fit comes first
    for p, one in sorted(found, key=lambda each: -each[0])[:_MAX_READINGS]:
        yield Advice(one.cause, f"{one.seen} (p = {p:.2g})", one.advice, one.toml)


def _largest_chance(reading: Reading, count: int) -> float:
    """Return the largest probability of a fit by chance at which a reading is reported; `count` is their number."""
    return _CHANCE_OF_SIGN if reading.cause == "sign" else _CHANCE / (2.0 * count)


# Possible readings of the values.


def _readings(problem: Problem) -> Iterator[Reading]:
    """Yield all readings of the lengths and angles of a problem."""
    lengths = tuple(r.kind for r in problem.rows if MODELS[r.kind].quantity == "length" and MODELS[r.kind].stations)
    angles = tuple(r.kind for r in problem.rows if MODELS[r.kind].quantity == "angle")
    for kind in lengths:
        if MODELS[kind].ranges == (1, -1):
            seen = f"the {kind} values fit with the opposite sign"
            advice = "state which station is farther if the number is positive (remove the key if it is there)"
            yield Reading("sign", (kind,), -1.0, 0.0, seen, advice, 'positive = "b-farther"\n')
        if MODELS[kind].emission:
            seen = f"the {kind} values fit with the opposite sign: the counters count down to zero"
            yield Reading("sign", (kind,), -1.0, 0.0, seen, "write a minus before each value")
    for group in dict.fromkeys((lengths, *((kind,) for kind in lengths))):
        yield from _length_units(group) if group else ()
    yield from _angle_readings(angles)


def _length_units(kinds: tuple[str, ...]) -> Iterator[Reading]:
    """Yield readings of lengths in another unit than stated, one for each ratio of two units.

    `kinds` are the kinds of the rows with lengths. The SI unit comes first. Units of time count as lengths: they are
    multiplied by the speed of light. If two pairs of units have the same ratio, the values cannot separate them, and
    only the first pair is tried.
    """
    table = {name: size * (SPEED_OF_LIGHT if name in _TIMES else 1.0) for name, size in UNITS["length"].items()}
    what = " and ".join(kinds)
    seen_before: list[float] = []
    for stated, size in table.items():
        for meant, other in table.items():
            ratio = other / size
            if (
                stated not in _STATED_UNITS
                or meant not in _MEANT_UNITS
                or any(abs(ratio / old - 1.0) < 1e-6 for old in seen_before)
            ):
                continue
            if ratio == 1.0:
                continue
            seen_before.append(ratio)
            seen = f"the {what} values fit in {meant} instead of the stated {stated}, {ratio:.4g} times as large"
            pairs = [f"{a} for {b}" for b in table for a in table if abs(table[a] / table[b] / ratio - 1.0) < 1e-6]
            advice = f"state their unit; by the ratio it may be {_either(pairs)}"
            yield Reading("unit", kinds, ratio, 0.0, seen, advice, f'unit = "{meant}"\n')


_TIMES = ("s", "ms", "us", "ns", "ps")
# Units that a file states, first the unit without a statement; and units that may be meant. Feet occur if the unit is
# not stated, thousands if the prefix is wrong, and times if the speed of light is missing.
_STATED_UNITS = ("m", "s", "ns")
_MEANT_UNITS = ("m", "km", "mm", "ft", "s", "ms", "us", "ns")
# Largest number of pairs of units in a sentence.
_MAX_PAIRS = 3


def _either(pairs: list[str]) -> str:
    """Return the first few pairs of units as one text, for instance "km for m or m for mm"."""
    return " or ".join(pairs[:_MAX_PAIRS])


def _angle_readings(kinds: tuple[str, ...]) -> Iterator[Reading]:
    """Yield readings as compass azimuths, as opposite azimuths, and as angles in the other unit.

    `kinds` are the kinds of the rows with angles. Compass azimuths are clockwise from north, other azimuths
    counter-clockwise from east, so a compass azimuth z means pi / 2 - z.
    """
    bearings = tuple(kind for kind in kinds if kind == "azimuth")
    turned = np.pi / 2
    if bearings:
        seen = "the azimuths do not intersect as read (from east counter-clockwise, or as stated), but they do as"
        advice = "state the convention; if it is already stated, remove it"
        key = 'azimuth = "north-clockwise"\n'
        yield Reading("compass", bearings, -1.0, turned, f"{seen} compass bearings", advice, key)
        seen = "the azimuths intersect behind the stations: they point from the target to the station"
        advice = "subtract half a turn"
        yield Reading("opposite", bearings, 1.0, np.pi, seen, advice, 'correction = "180 deg"\n')
    for stated, meant, factor in (("rad", "deg", np.pi / 180.0), ("deg", "rad", 180.0 / np.pi)):
        if kinds:
            seen = f"the {' and '.join(kinds)} values fit in {meant} instead of the stated {stated}"
            key = f'unit = "{meant}"\n'
            yield Reading("unit", kinds, factor, 0.0, seen, "state their unit", key)
        if bearings and stated == "rad":
            seen = "the azimuths fit as compass bearings in degrees instead of the stated radians from east"
            both = f'{key}azimuth = "north-clockwise"\n'
            yield Reading("compass", bearings, -factor, turned, seen, "state unit and convention", both)


def _with_reading(problem: Problem, reading: Reading, stated: bool) -> Problem:
    """Return the problem with another reading of the values.

    If `stated`, the noise has a separate unit and stays. Otherwise it is multiplied by the factor of the reading.
    """
    size = np.ones(problem.count)
    rows = []
    for block, start in zip(problem.rows, problem.starts, strict=True):
        if block.kind in reading.kinds:
            block = _read_rows(block, reading)  # noqa: PLW2901  # the same rows, read otherwise
            size[start : start + block.count] = 1.0 if stated else abs(reading.factor)
        rows.append(block)
    blocks = tuple(
        Block(b.row, b.covariance * size[b.row][..., :, None] * size[b.row][..., None, :]) for b in problem.noise.blocks
    )
    return replace(problem, rows=tuple(rows), noise=Noise(blocks))


def _read_rows(rows: Rows, reading: Reading) -> Rows:
    """Return rows with another reading of their values; angles are wrapped."""
    z = reading.shift + reading.factor * rows.z
    return replace(rows, z=z if MODELS[rows.kind].period is None else wrap(z))


# Impossible values, and fits by chance.


def _station_extent(problem: Problem) -> float:
    """Return twice the spread of the stations, m: their largest distance from each other is at most this length."""
    return 2.0 * float(np.max(centre_and_spread(problem.stations.places)[1]))


def _chance_of_fit(problem: Problem) -> float:
    """Return the probability that random values fit: each redundant value within four sigma of its prediction.

    A random angle is uniform between -pi and pi. A random value of any other kind is uniform between minus and plus
    `_station_extent`. The probability of one value is 4 sigma divided by this half width, and at most 1. All redundant
    values have the same probability, the median over all rows.
    """
    sigma = np.sqrt(variances(problem.noise, problem.count)).reshape(-1, problem.count).max(0)
    # half widths of the intervals of random values
    width = np.concatenate(
        [
            np.full(r.count, np.pi if MODELS[r.kind].quantity == "angle" else _station_extent(problem))
            for r in problem.rows
        ]
    )
    share = np.minimum(1.0, 4.0 * sigma / np.maximum(width, 1e-300))
    return float(np.median(share)) ** int(degrees_of_freedom(problem).sum())


def _impossible_rows(problem: Problem) -> Iterator[tuple[Rows, int, float]]:
    """Yield the rows of a kind, the number of an impossible value among them, and the distance of its stations, m.

    A difference is impossible if it exceeds the distance of its stations. A range or a sum of ranges is impossible
    below this distance; a range has one station, so its limit is zero. Rows with an unknown emission time or a bias are
    omitted, because this unknown can shift their values. A value counts only beyond `_IMPOSSIBLE_SIGMAS`.
    """
    sigma = np.sqrt(variances(problem.noise, problem.count)).reshape(-1, problem.count)
    observed, weight = (np.reshape(a, (-1, problem.count)) for a in (problem.observed, problem.weight))
    position = problem.stations.position
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        ranges, part = MODELS[rows.kind].ranges, slice(start, start + rows.count)
        if ranges not in ((1, -1), (1, 0), (1, 1)) or MODELS[rows.kind].emission or _is_biased(problem, part):
            continue
        # stations at rest have positions for one epoch only, number 0
        moving = rows.epoch if position.shape[-3] > 1 else np.zeros_like(rows.epoch)
        apart = np.zeros(rows.count)
        if ranges[1]:
            line = position[..., moving, rows.a, :] - position[..., moving, rows.b, :]
            apart = np.sqrt((line**2).sum(-1)).reshape(-1, rows.count)[0]
        value = observed[:, part] * np.ones((len(observed), 1))
        over = np.abs(value) - apart if ranges == (1, -1) else apart - value
        bad = (over > _IMPOSSIBLE_SIGMAS * sigma[:, part]) & (weight[:, part] > 0.0)
        for i in np.flatnonzero(bad.any(0)):
            yield rows, int(i), float(apart[i])


def _is_biased(problem: Problem, part: slice) -> bool:
    """Return whether a bias of the problem affects a row in the slice `part`, so that any value is possible."""
    return any(((bias.row >= part.start) & (bias.row < part.stop)).any() for bias in problem.biases)


def _is_impossible(problem: Problem) -> bool:
    """Return whether a value is impossible at any position."""
    return next(_impossible_rows(problem), None) is not None


def _impossible_advice(problem: Problem) -> Iterator[Advice]:
    """Yield advice about the first value that no position can have, and the number of other impossible values."""
    found = list(_impossible_rows(problem))
    if not found:
        return
    rows, i, apart = found[0]
    names, value = problem.stations.names, float(np.reshape(rows.z - rows.correction, (-1, rows.count))[0, i])
    more = f"; so are {len(found) - 1} more" if len(found) > 1 else ""
    if MODELS[rows.kind].ranges == (1, -1):
        seen = f"the {rows.kind} of {names[rows.a[i]]} and {names[rows.b[i]]} is {value:.4g} m"
        seen += f", but the stations are {apart:.4g} m apart: no position has this difference{more}"
    else:
        seen = f"the {rows.kind} at {names[rows.a[i]]} is {value:.4g} m, less than possible at any position{more}"
    yield Advice(
        "impossible", seen, "check the unit of the values and of the stations, and the positions of the stations"
    )
