"""The causes of a misfit: all explanations in one comparison, and the advice on the best of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from optloc.advice.change import Change, MisfitCase, Wording
from optloc.advice.comparison import Comparison, compare_all
from optloc.advice.explanation_table import EXPLANATIONS, LATE_PRICE
from optloc.advice.fits import Fits, fit, is_out_of_reach
from optloc.advice.rows_and_noise import late_fit, late_words
from optloc.advice.scores import GAP, Scored, price_of_parameters, score_of_level
from optloc.advice.wording import no_words
from optloc.base.types import Array
from optloc.kernels.sums import equations_at
from optloc.model_checks.cause import Advice
from optloc.problem.noise import variances
from optloc.solvers.solution import solve

# Smallest price of any explanation: a misfit of a smaller cost has no cause.
_CHEAPEST = 2.0
# Largest number of causes that are listed if the data do not decide.
_LISTED = 3
# Relative difference of the costs of equal explanations: rounding, and the end of the descents.
_EQUAL = 1e-3


def causes_of(case: MisfitCase) -> tuple[Scored, ...]:
    """Return the explanations that the data do not exclude, the best first; empty if none is needed.

    The first is alone if all others score worse by the gap. An epoch that the data determine after no change excludes
    all causes, so that the others are compared without it.
    """
    plain = fit(case, [Change("none", no_words)])
    found, known = _compared(case, plain), np.flatnonzero(np.isfinite(plain.cost[0]))
    # errors of all rows count without a determined position
    if all(one.change.cause in ("noise", "late") for one in found) and 0 < len(known) < len(case.times):
        part = case.in_epochs(known)
        return _compared(part, Fits(plain.x[:, known], plain.theta, plain.sigma, plain.cost[:, known])) or found
    return found


def _compared(case: MisfitCase, plain: Fits) -> tuple[Scored, ...]:
    """Return the explanations that the data do not exclude; `plain` is the fit without a change."""
    cost, dof = float(plain.cost.sum()), int(case.dof.sum())
    if cost >= GAP + _CHEAPEST and not np.isfinite(case.x).all():
        # a direction, or a position that the data determine badly, explains the values without a change
        cost = min(cost, _solved_cost(case), _cost_at(case, plain.x[0]))
    if not np.isfinite(cost):
        cost = _cost_at(case, case.x)
    if cost < GAP + _CHEAPEST or dof < 1:
        return ()
    case = replace(case, x=np.where(np.isfinite(plain.x[0]), plain.x[0], case.x), cost=plain.cost[0])
    comparison = Comparison(case, cost)
    if np.isfinite(cost):
        comparison.add([_of_level(case, plain, cost, dof)])
    compare_all(comparison)
    if np.isfinite(cost):
        comparison.add(_of_late_rows(case))
    found = comparison.found
    if not found:
        return ()
    found.sort(key=lambda one: one.score)
    if found[0].score > cost - GAP:
        return ()
    return tuple(_distinct(found))[:_LISTED]


def _solved_cost(case: MisfitCase) -> float:
    """Return the cost of a solution of the problem as it is, also at infinity; infinite if it fails."""
    cost = float(np.sum(solve(case.base).cost))
    return cost if np.isfinite(cost) else np.inf


def _cost_at(case: MisfitCase, x: Array) -> float:
    """Return the cost at unknowns (K, size); infinite without a value, and at positions that no signal reaches."""
    if not np.isfinite(x).all() or is_out_of_reach(case.base, x).any():
        return np.inf
    cost = float(equations_at(case.base, x).cost.sum())
    return cost if np.isfinite(cost) else np.inf


def _of_level(case: MisfitCase, plain: Fits, cost: float, dof: int) -> Scored:
    """Return the explanation that all noise is understated."""
    level = float(np.sqrt(cost / dof))
    # a weight changes the variances of rows, and not their covariances
    simple = len(case.kinds) == 1 and all(block.row.shape[1] == 1 for block in case.base.noise.blocks)

    def words(theta: Array, sigma: Array) -> Wording:
        seen = f"noise that is {level:.3g} times as large as stated would explain the misfit"
        lines = f"weight = {level**-2:.6g}\n" if simple else ""
        return Wording(seen, "state a larger noise, or use `--rescale-noise` for several epochs", lines)

    none, score = np.zeros(0), score_of_level(cost, dof) + _price_of_width(case, level)
    change = Change("noise", words, spread=level, levels=True)
    return Scored(change, none, none, float(dof), dof, score, plain.x[0], case)


def _price_of_width(case: MisfitCase, level: float) -> float:
    """Return the price of noise that is larger than the station array, or than half a turn.

    Smaller noise costs nothing in the rows that determine the positions, because the positions follow the noise.
    Positions that follow larger noise are as unlikely as the noise.
    """
    width = np.full(case.base.count, np.inf)
    width[case.rows_where("length")], width[case.rows_where("angle")] = case.extent, np.pi
    size = level * np.sqrt(variances(case.base.noise, case.base.count)) / width
    over = 2.0 * np.log(np.maximum(size, 1.0)) * np.ones(case.present.shape)
    fixing = int(case.present.sum()) - int(case.dof.sum())
    return fixing * float(over[case.present].mean())


def _of_late_rows(case: MisfitCase) -> Iterator[Scored]:
    """Yield the explanation that some rows are late."""
    found = late_fit(case)
    if found is not None:
        change, theta = Change("late", partial(late_words, found)), np.array([found.share, found.delay])
        dof = int(case.dof.sum()) - 2
        price = LATE_PRICE + price_of_parameters(np.zeros(2), np.ones(2))
        # residuals of late rows have no chi-square
        yield Scored(change, theta, np.zeros(2), np.nan, dof, found.score + price, found.x, case)


def _distinct(found: Sequence[Scored]) -> Iterator[Scored]:
    """Yield the explanations within the gap of the best; of equal ones, only the simplest.

    `found` is in ascending order of the score.
    """
    names = list(EXPLANATIONS)
    kept: list[Scored] = []
    for one in found:
        if one.score > found[0].score + GAP:
            break
        if any(_is_part(other, one) for other in kept):
            continue
        equal = next((i for i, other in enumerate(kept) if _is_equal(one, other)), None)
        if equal is None:
            kept.append(one)
        elif _rank(one, names) < _rank(kept[equal], names):
            kept[equal] = replace(one, score=kept[equal].score)
    yield from kept


def _rank(one: Scored, names: list[str]) -> int:
    """Return the place of a cause in the table: the simplest cause of a station comes first."""
    return names.index(one.change.cause) if one.change.cause in names else len(names)


def _is_part(one: Scored, other: Scored) -> bool:
    """Return whether a pair of outliers contains an explanation with a better score: the second row is not needed."""
    return (
        other.change.cause == "outliers"
        and bool(one.change.station)
        and (set(one.change.station) <= set(other.change.station) and one.change.cause != "outliers")
    )


def _is_equal(one: Scored, other: Scored) -> bool:
    """Return whether two explanations are the same statement about the same stations."""
    if (one.change.cause, one.change.station, one.change.kind) == (
        other.change.cause,
        other.change.station,
        other.change.kind,
    ):
        return not (one.change.members and one.change.members != other.change.members) or one.change.cause == "noise"
    same = set(one.change.station) == set(other.change.station) and one.change.station
    return bool(same and one.dof == other.dof and abs(one.cost - other.cost) < _EQUAL * (1.0 + one.cost))


def advice_on(found: Sequence[Scored]) -> Iterator[Advice]:
    """Yield the advice on explanations in ascending order of their scores."""
    for i, one in enumerate(found):
        words = one.change.words(one.theta, one.sigma)
        rivals = [other.score for j, other in enumerate(found) if j != i]
        gap = min(rivals) - one.score if rivals else GAP
        p = f" (p = {one.p:.2g} with it)" if np.isfinite(one.p) and one.change.cause != "noise" else ""
        yield Advice(
            one.change.cause,
            words.seen + p,
            words.advice,
            words.toml,
            words.option,
            one.change.station,
            one.change.members,
            tuple(one.theta.tolist()),
            one.cost,
            gap,
            one.p,
        )
