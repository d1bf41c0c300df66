"""Explanations by a few rows or by the noise: one or two outliers, and noise levels of a kind or a station."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
from scipy.special import log_ndtr

from optloc.advice.change import Change, ErrorColumn, MisfitCase, Wording
from optloc.advice.suspects import Suspects
from optloc.advice.wording import row_name
from optloc.base.types import Array
from optloc.linear.normal import linearise
from optloc.model_checks.score import descend
from optloc.models import MODELS
from optloc.problem.noise import variances

# Epochs with the largest cost whose rows may be outliers, and the largest number of rows of which pairs are tried.
_EPOCHS, _PAIRED = 3, 12
# Excess of the cost of an epoch over its degrees of freedom below which no row of it is an outlier: a price is larger.
_FITS = 9.0
# Factors of the noise that are tried; between two of them, the likelihood changes by less than one.
_LEVELS = tuple((1.5 * 1.5**i) for i in range(14))
# A station needs this number of rows for a noise level: fewer rows do not distinguish noise from outliers.
_FEW = 6


def single_outliers(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield single rows without which the others may fit."""
    yield from _without_rows(case, [(row,) for row in _worst_rows(case)])


def pairs_of_outliers(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield pairs of rows without which the others may fit."""
    yield from _without_rows(case, [*combinations(_worst_rows(case)[:_PAIRED], 2)])


def _without_rows(case: MisfitCase, sets: Sequence[tuple[tuple[int, int], ...]]) -> Iterator[Change]:
    """Yield unknown errors of sets of rows; a row has the number of its epoch and its number there."""
    many, cost = int(case.present.sum()), np.zeros(len(case.times)) if case.cost is None else case.cost
    for pair in sets:
        columns = []
        for epoch, row in pair:
            mark = np.zeros(case.present.shape)
            mark[epoch, row] = 1.0
            columns.append(ErrorColumn("adds", mark))
        yield Change(
            "outlier" if len(pair) == 1 else "outliers",
            partial(_outlier_words, case, pair),
            tuple(case.names[i] for i in _blamed(case, [row for _, row in pair])),
            tuple(int(case.number[epoch, row]) for epoch, row in pair),
            columns=tuple(columns),
            alternatives=many if len(pair) == 1 else many * (many - 1) / 2,
            least=float(np.delete(cost, [epoch for epoch, _ in pair]).sum()),
        )


def _blamed(case: MisfitCase, rows: list[int]) -> list[int]:
    """Return the stations of rows, without a reference station that all rows have in common."""
    a, b = case.ends
    ends = {int(i) for row in rows for i in (a[row], b[row]) if i >= 0}
    references = set(b[case.present.any(0)].tolist())
    return sorted(ends - references if len(references) == 1 and ends - references else ends)


def _worst_rows(case: MisfitCase) -> list[tuple[int, int]]:
    """Return epoch and number of the rows of the epochs with the largest cost, the largest residuals first."""
    linear = linearise(case.base, case.x)
    size = np.zeros(case.present.shape)
    for whitener in linear.noise:
        white = whitener.apply(linear.residual[..., None])[..., 0]
        size[:, whitener.row.ravel()] = np.abs(white)
    size = np.where(np.isfinite(size), size, 0.0)
    excess = (size**2).sum(1) - case.dof
    worst = np.argsort(-excess, kind="stable")[:_EPOCHS]
    # an epoch that fits would only take the place of rows of the others
    epochs = [k for i, k in enumerate(worst.tolist()) if i == 0 or excess[k] > _FITS]
    # a gross row enlarges all residuals of its epoch, so that the rows of each epoch are ordered separately
    orders = [[(int(k), int(i)) for i in np.argsort(-size[k], kind="stable") if case.present[k, i]] for k in epochs]
    rows = [order[i] for i in range(case.base.count) for order in orders if i < len(order)]
    return rows[: 4 * _PAIRED]


def _outlier_words(case: MisfitCase, pair: tuple[tuple[int, int], ...], theta: Array, sigma: Array) -> Wording:
    names = " and ".join(row_name(case, *one) for one in pair)
    seen = f"the other rows fit without {names}"
    return Wording(seen, "check this reading, or leave it out" if len(pair) == 1 else "check them, or leave them out")


def levels(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield larger noise of one kind of several, and of one station with many rows."""
    groups: list[tuple[str, str, tuple[str, ...], Array]] = [
        (f"the {kind} values", kind, (), case.rows_of(kind)) for kind in case.kinds if len(case.kinds) > 1
    ]
    for station in case.stations:
        rows = case.rows_at(station)
        if int(case.present[:, rows].sum()) >= _FEW and not rows[case.present.any(0)].all():
            groups.append((f"station {case.names[station]}", "", (case.names[station],), rows))
    for what, kind, names, rows in groups:
        for level in _LEVELS:
            spread = np.where(rows, level, 1.0)
            words = partial(_level_words, what, level)
            yield Change("noise", words, names, spread=spread, levels=True, alternatives=len(groups), kind=kind)


def _level_words(what: str, level: float, theta: Array, sigma: Array) -> Wording:
    seen = f"the noise of {what} would explain the misfit if it were about {level:.2g} times as large as stated"
    return Wording(seen, "state its noise")


# Late signals.

# Steps of the alternation between the shares of late rows and the positions, and its starts: shares and mean delays, in
# sigmas, of late rows.
_ROUNDS, _STARTS = 12, ((0.15, 10.0), (0.3, 40.0), (0.3, 150.0))
# Smallest number of degrees of freedom for two parameters of a distribution.
_MANY = 8


@dataclass(frozen=True, slots=True)
class LateFit:
    """A mixture of punctual and late rows: -2 log likelihood, share, mean delay in sigmas, and positions (K, size)."""

    score: float
    share: float
    delay: float
    x: Array


def late_fit(case: MisfitCase) -> LateFit | None:
    """Return the fit of values of which a share is late by an exponential delay; None for kinds without delays.

    Delays only lengthen a range, an arrival time or a sum of ranges. The density of a row is
    ``(1 - share) N(r) + share (N * Exp)(r)``, with the residual r in sigmas. The positions follow from an EM
    alternation, in which late rows have the mean and the variance of their delay.

    References
    ----------
    E. Grushka, Anal. Chem. 44 (1972): the exponentially modified Gaussian.
    """
    models = [MODELS[kind] for kind in case.kinds]
    if int(case.dof.sum()) < _MANY or not all(m.ranges in ((1, 0), (1, 1)) and m.straight is None for m in models):
        return None
    if any(block.row.shape[1] > 1 for block in case.base.noise.blocks):
        return None
    fits = _alternate(case)
    return min(fits, key=lambda one: one.score)


def _alternate(case: MisfitCase) -> list[LateFit]:
    """Return the mixtures after the alternation, one for each start, all starts side by side."""
    count, shape = len(_STARTS), case.present.shape
    lanes = case.base.take(np.tile(np.arange(shape[0]), count))
    use = np.tile(case.present, (count, 1))
    sigma = np.sqrt(variances(lanes.noise, lanes.count)) * np.ones(use.shape)
    sigma = sigma / np.sqrt(np.where(use, lanes.weight, 1.0))
    x, z = np.tile(case.x, (count, 1)), np.where(use, lanes.z, 0.0)
    share, delay = (np.array(values) for values in zip(*_STARTS, strict=True))

    def mixed(x: Array) -> tuple[Array, Array, Array]:
        """Return residuals in sigmas, and densities of punctual and of late rows, weighted by their shares."""
        residual = np.where(use, linearise(lanes, x).residual / sigma, 0.0)
        each = np.repeat(share, shape[0])[:, None]
        punctual, late = _densities(residual, np.repeat(delay, shape[0])[:, None])
        return residual, (1.0 - each) * punctual, each * late

    for _ in range(_ROUNDS):
        residual, punctual, late = mixed(x)
        chance = late / np.maximum(punctual + late, 1e-300)
        # of a late row, the delay has the mean of its truncated exponential, and noise of this size
        expected, mean = np.clip(residual, 0.0, None), np.repeat(delay, shape[0])[:, None]
        precision = (1.0 - chance) + chance / (1.0 + mean**2)
        shift = chance / (1.0 + mean**2) * mean / precision
        x, _ = descend(lanes.with_rows(z=z - shift * sigma, weight=lanes.weight * precision), x)
        total, counted = (np.where(use, value, 0.0).reshape(count, -1).sum(1) for value in (chance, chance * expected))
        share = np.clip(total / case.present.sum(), 0.02, 0.6)
        delay = np.clip(counted / np.maximum(total, 1e-9), 3.0, 1e4)
    _, punctual, late = mixed(x)
    density = np.log(np.maximum(punctual + late, 1e-300))
    score = -2.0 * np.where(use, density, 0.0).reshape(count, -1).sum(1)
    places = x.reshape(count, *case.x.shape)
    return [LateFit(float(score[i]), float(share[i]), float(delay[i]), places[i]) for i in range(count)]


def _densities(residual: Array, delay: Array) -> tuple[Array, Array]:
    """Return the densities of punctual and of late rows, in units of the peak of a normal density."""
    late = np.exp(log_ndtr(residual - 1.0 / delay) + 0.5 / delay**2 - residual / delay) * np.sqrt(2.0 * np.pi) / delay
    return np.exp(-0.5 * residual**2), late


def late_words(fit: LateFit, theta: Array, sigma: Array) -> Wording:
    """Return the text about late signals."""
    seen = (
        f"late signals would explain the misfit: {fit.share:.0%} of the rows, late by {fit.delay:.3g} sigma on average"
    )
    advice = "use a robust loss for late rows, or remove the receivers without a line of sight"
    return Wording(seen, advice, "", "--late-from-data")
