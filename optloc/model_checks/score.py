"""Score tests for systematic errors of one channel, and refits that confirm them.

A channel is a station together with a kind of rows. A score test needs no fit of the larger model, so it can rank many
possible errors. The best candidates are then fitted. A candidate is an error that the problem does not model, and q is
the number of its unknowns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import prod

import numpy as np

from optloc.base import linalg
from optloc.base.linalg import centre_and_spread
from optloc.base.types import Array, Bias, FormName
from optloc.kernels.least_squares import refine
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import exact
from optloc.linear.equalities import Equalities, spare_rows
from optloc.models import MODELS
from optloc.problem.bias import Per, family
from optloc.problem.chart import quantile, tail_probability
from optloc.problem.forms import FORMS, form_of
from optloc.problem.problem import Problem

FALSE_ALARM = 1e-3
"""Probability that all tests together report an error although the model is correct (Bonferroni)."""

FITS = 1e-3
"""Probability of the chi-square test above which the remaining residuals count as explained."""

# Number of candidates that are fitted after the ranking. A gross error moves the fix, so the true error is among the
# first candidates but not always the first.
_FITTED = 8
# Difference of costs within which two explanations are both reported: three sigma of one number.
_RIVAL = 9.0
# A smaller difference of costs does not decide between two forms of an error of one station: the simpler form is
# reported.
_SAME = 2.0
# The simplest form comes first.
_ORDER = (*FORMS, "step", "burst")
# Penalty of a scale of arrival times compared with a drift. A fast clock is a drift, and a second has the same length
# for all stations, so the odds are a hundred to one. In a run where both look alike, noise alone would decide.
_STRETCHED_TIME = 9.0
# If the other unknowns leave less than this share of the information of a candidate, the rest is rounding.
_ROUNDING = 1e-9
# Smallest number of epochs of a run for steps and bursts, and the number of times that are tried.
_STEP_EPOCHS, _STEP_TIMES = 6, 12


@dataclass(frozen=True, slots=True)
class Candidate:
    """One systematic error that a problem does not model.

    - bias: a bias with one member.
    - per: "station" for one station, "kind" for all rows of a kind.
    - kind: kind of the rows; empty if the error affects several kinds.
    - since, until: start and end of the error in seconds; NaN for an error without a start or an end.
    """

    bias: Bias
    per: Per
    kind: str
    since: float = float("nan")
    until: float = float("nan")

    @property
    def form(self) -> str:
        """Return the form of the bias, or "step" or "burst" for an offset of limited duration."""
        if not np.isfinite(self.since):
            return self.bias.form
        return "burst" if np.isfinite(self.until) else "step"

    @property
    def is_channel_offset(self) -> bool:
        """Return whether the error is a permanent offset of one station's rows of a kind."""
        form = form_of(self.bias)
        return self.per == "station" and form.enters == "adds" and not (form.changes or np.isfinite(self.since))

    @property
    def name(self) -> str:
        """Return a description of the error, for instance "drift of R2"."""
        whose = self.bias.members[0] if self.per == "station" else f"all {self.bias.members[0]} rows"
        when = f" from t = {self.since:.6g} s" if np.isfinite(self.since) else ""
        return f"{self.form} of {whose}{when}" + (f" to {self.until:.6g} s" if np.isfinite(self.until) else "")


@dataclass(frozen=True, slots=True)
class Explained:
    """A systematic error that explains the misfit of a fix.

    - candidate: the error.
    - value, sigma (q,): estimate and standard deviation in SI units and radians; three angles for a rotation in space.
    - score: Rao's statistic at the fix, a chi-square with q degrees of freedom if the error does not exist.
    - cost: remaining cost after the error is estimated.
    - p_before, p_after: chi-square probabilities without and with the error.
    """

    candidate: Candidate
    value: Array
    sigma: Array
    score: float
    cost: float
    p_before: float
    p_after: float


def explain_misfit(problem: Problem, x: Array) -> tuple[Explained, ...]:
    """Return the systematic errors that explain the misfit of a fix, the best first.

    An error is reported under three conditions. Its score test is significant at the level `FALSE_ALARM` over all
    tests. The cost decreases by the same amount when the error is estimated. The remaining cost passes the chi-square
    test with redundancy left. `problem` is a flat batch of one problem, or of a whole run. Least squares starts at its
    fix `x` (1, size).

    References
    ----------
    C. R. Rao, "Large sample tests of statistical hypotheses concerning several parameters with applications to problems
    of estimation", Math. Proc. Cambridge Philos. Soc. 44 (1948) 50-57.
    """
    dof = int(spare_rows(problem)[0])
    found = candidates(problem)
    if dof < 2 or not found or not np.isfinite(x).all():
        return ()
    x, cost = descend(problem, x)
    before = float(tail_probability(cost, np.array([dof]))[0])
    # The search for steps and bursts selects the best error of many: every channel, every first epoch and several last
    # epochs. Bonferroni counts all of them.
    channels = sum(one.is_channel_offset for one in found)
    more = channels * problem.epochs * (2 * _search_width(problem) + 2) if any(o.form == "step" for o in found) else 0
    level = 1.0 - FALSE_ALARM / (len(found) + more)
    # a statistic is the square of a projection of the residual, so it is at most the cost: no test can be significant
    if cost[0] <= quantile(level, 1):
        return ()
    scores = score(problem, x, found)
    sharp = tuple(_sharpened(problem, x, found, np.array([one for one, _, _ in scores])))
    if sharp:
        found, scores = (*found, *sharp), [*scores, *score(problem, x, sharp)]
    # a rotation in space has three unknowns, so its limit is higher: the excess over the limit ranks the candidates
    limit = np.array([quantile(level, max(1, size)) for _, _, size in scores])
    values = np.array([one for one, _, _ in scores])
    order = np.argsort(-np.where(values > limit, values - limit, -np.inf), kind="stable")[:_FITTED]
    explained = []
    for i in order:
        # the remaining redundancy must allow a chi-square test
        if values[i] <= limit[i] or dof - scores[i][2] < 1:
            continue
        fitted = _fitted(problem, x, found[i], scores[i])
        after = float(tail_probability(fitted.cost + np.zeros(1), np.array([dof - scores[i][2]]))[0])
        if after >= FITS and cost[0] - fitted.cost > limit[i]:
            explained.append(replace(fitted, p_before=before, p_after=after))
    return _distinct(explained)


def _distinct(explained: list[Explained]) -> tuple[Explained, ...]:
    """Return the explanations whose cost is almost the lowest, in ascending order of the cost.

    Of explanations of the same station that fit equally well, only the simplest is returned. `explained` are the
    explanations that pass all tests, in any order.
    """
    # for one row, an offset, a scale and a drift are equal, and also for rows of one position
    simple = sorted(explained, key=lambda one: (_is_time_scale(one), _ORDER.index(one.candidate.form), one.cost))
    kept: list[Explained] = []
    for one in simple:
        same = [other for other in kept if other.candidate.bias.members == one.candidate.bias.members]
        if not any(_replaces(other, one) for other in same):
            kept.append(one)
    kept.sort(key=lambda one: one.cost)
    return tuple(one for one in kept if one.cost <= kept[0].cost + _RIVAL)


def _replaces(other: Explained, one: Explained) -> bool:
    """Return whether an explanation `other` makes an explanation `one` of the same station unnecessary.

    It does so if both fit almost equally well. A scale of arrival times must fit much better than another explanation.
    """
    if _is_time_scale(one) and not _is_time_scale(other):
        return other.cost - one.cost < _STRETCHED_TIME
    return abs(other.cost - one.cost) < _SAME


def _is_time_scale(one: Explained) -> bool:
    """Return whether an explanation is a scale of arrival times."""
    form, kind = form_of(one.candidate.bias), one.candidate.kind
    return form.enters == "scales" and kind != "" and _is_of_arrivals(kind)


def _is_of_arrivals(kind: str) -> bool:
    """Return whether rows of a kind measure arrival times, so that a clock error changes them.

    These rows are lengths that involve two stations, such as differences, or times since an unknown emission.
    """
    model = MODELS[kind]
    return model.quantity == "length" and (model.emission or model.stations == 2)


def candidates(problem: Problem) -> tuple[Candidate, ...]:
    """Return the systematic errors that the rows of a problem could have and that the problem does not model.

    They are errors of all rows of a kind and errors of single stations. Kinds and stations without present rows have no
    candidates.
    """
    names = problem.stations.names
    present = np.broadcast_to(problem.weight, (1, problem.count))[0] > 0.0
    out: list[Candidate] = []
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        inside = present[start : start + rows.count]
        if not inside.any():
            continue
        end_count = MODELS[rows.kind].stations
        # the stations of the present rows; -1 means no station
        observing = np.unique(
            np.concatenate([index[inside] for index in (rows.a, rows.b)[:end_count]] or [np.zeros(0, int)])
        )
        for form in _forms(problem, rows.kind):
            out.append(_candidate(problem, form, "kind", rows.kind, None))
            out += [_candidate(problem, form, "station", rows.kind, names[i]) for i in observing if i >= 0]
    out += list(_rotations(problem, present))
    return (*out, *_steps_and_bursts(problem, out))


def _forms(problem: Problem, kind: str) -> Iterator[FormName]:
    """Yield the forms of systematic errors that rows of a kind can have."""
    yield "offset"
    if MODELS[kind].period is None:  # an angle has no scale
        yield "scale"
    # with two epochs, a drift equals two offsets
    if len(np.unique(problem.times)) > 2 and np.isfinite(problem.times).all():
        yield "drift"


def _candidate(problem: Problem, form: FormName, per: Per, kind: str | None, station: str | None) -> Candidate:
    """Return a candidate of a form for one station, or for all rows of a kind if `station` is None.

    `kind` is None if the error affects rows of several kinds.
    """
    members = None if station is None else (station,)
    names = problem.stations.names
    bias = family(problem.rows, names, f"{form} that is tested", per=per, form=form, kind=kind, members=members)
    return Candidate(bias, per, kind or "")


def _rotations(problem: Problem, present: Array) -> Iterator[Candidate]:
    """Yield the rotations of stations in space; rotations in the plane are offsets of the azimuth.

    `present` (m,) marks rows with a weight above zero. A station needs more than three rows of angles.
    """
    angles = [
        index
        for rows, start in zip(problem.rows, problem.starts, strict=True)
        if MODELS[rows.kind].axes
        for index in rows.a[present[start : start + rows.count]].tolist()
    ]
    # three angles need at least four rows
    if problem.dimension == 3:
        for i in sorted(set(angles)):
            if angles.count(i) > 3:
                yield _candidate(problem, "rotation", "station", None, problem.stations.names[i])


def _steps_and_bursts(problem: Problem, found: list[Candidate]) -> Iterator[Candidate]:
    """Yield offsets of stations that start within a run (steps), and offsets that also end within it (bursts).

    `found` are the candidates for the whole run. Runs with few epochs have no steps and bursts.
    """
    k = problem.epochs
    if k < _STEP_EPOCHS or not np.isfinite(problem.times).all():
        return
    cuts = np.unique(np.linspace(1, k - 1, min(k - 1, _STEP_TIMES)).round().astype(int)).tolist()
    # a burst before the first cut or after the last cut is a step
    spans = [*((first, k) for first in cuts), *pairwise(cuts)]
    stations = [one for one in found if one.is_channel_offset]
    for first, last in spans:
        yield from (made for one in stations for made in _in_epochs(problem, one, first, last))


def _in_epochs(problem: Problem, one: Candidate, first: int, last: int) -> Iterator[Candidate]:
    """Yield the candidate `one` for the epochs first <= k < last only, unless it then affects no row or all rows."""
    when = problem.epoch[one.bias.row]
    inside = (when >= first) & (when < last)
    if inside.any() and not inside.all():
        until = float(problem.times[last]) if last < problem.epochs else float("nan")
        yield replace(one, bias=_restricted(one.bias, inside), since=float(problem.times[first]), until=until)


def _sharpened(problem: Problem, x: Array, found: Sequence[Candidate], values: Array) -> list[Candidate]:
    """Return the best step and the best burst with their ends moved to the epochs with the highest test.

    An error of many sigma between two tried times leaves a misfit, which would hide the kind of the error. `values` are
    the test statistics of the candidates `found`, and `x` (1, size) is the fix. The first epoch is moved first,
    then for a burst the epoch after its last epoch.
    """
    out, around = [], _search_width(problem)
    for form in ("step", "burst"):
        numbers = [i for i, one in enumerate(found) if one.form == form]
        if not numbers:
            continue
        best = found[max(numbers, key=lambda i: values[i])]
        # the permanent offset of the same channel
        whole = next(
            one
            for one in found
            if one.is_channel_offset and (one.kind, one.bias.members) == (best.kind, best.bias.members)
        )
        for end in range(1 if form == "step" else 2):
            ends = _epochs_of(problem, best)
            # end 0 is the first epoch, and end 1 the epoch after the last epoch; end 1 stays above end 0
            near = np.clip(ends[end] + np.arange(-around, around + 1), 1 if end == 0 else ends[0] + 1, problem.epochs)
            spans = [(k, ends[1]) if end == 0 else (ends[0], k) for k in np.unique(near).tolist()]
            tried = tuple(made for span in spans if span[0] < span[1] for made in _in_epochs(problem, whole, *span))
            best = tried[int(np.argmax([value for value, _, _ in score(problem, x, tried)]))]
        out.append(best)
    return out


def _search_width(problem: Problem) -> int:
    """Return the number of epochs between two neighbouring times that `_steps_and_bursts` tries."""
    return -(-problem.epochs // _STEP_TIMES)


def _epochs_of(problem: Problem, one: Candidate) -> tuple[int, int]:
    """Return the number of the first epoch of a step or burst, and the number of the epoch after its last epoch."""
    last = int(np.searchsorted(problem.times, one.until)) if np.isfinite(one.until) else problem.epochs
    return int(np.searchsorted(problem.times, one.since)), last


def _restricted(bias: Bias, inside: Array) -> Bias:
    """Return a bias that affects only the rows that `inside` marks; this mask has one entry per row of the bias."""
    return replace(bias, row=bias.row[inside], member=bias.member[inside], coefficient=bias.coefficient[inside])


# Score tests.


def score(problem: Problem, x: Array, found: tuple[Candidate, ...]) -> list[tuple[float, Array, int]]:
    """Return Rao's statistic, the estimate (q,) after one step, and the number q, for every candidate in `found`.

    Let r be the whitened residual, J the columns of the unknowns and c the columns of the candidate. With u = c - J J^+
    c the statistic is ``(u'r)' (u'u)^-1 (u'r)``: the part that the other unknowns can absorb is projected out. If the
    rows do not determine a candidate, its statistic and its estimate are zero. `problem` is a flat batch of one
    problem, and `x` (1, size) its fix.
    """
    larger, places = _with_families(problem, found)
    layout = larger.layout
    information, vector = _shared_equations(larger, _embed(problem, larger, x))
    # the unknowns of each candidate; `rest` are all other shared unknowns
    parts = [slice(*(layout.find(name)[0].start + end for end in ends)) for name, ends in places]
    inside = np.concatenate([np.arange(part.start, part.stop) for part in parts])
    rest = np.setdiff1d(np.arange(layout.n_shared), inside)
    space = np.eye(layout.n_shared)[:, rest]
    if (equalities := Equalities.of(problem)).lasting:
        # the other unknowns move only along the equalities
        along = equalities.lasting_space(x)[0]
        old = [layout.find(slot.name)[0].start + i for slot in problem.layout.shared for i in range(slot.size)]
        space = np.zeros((layout.n_shared, along.shape[1]))
        space[old] = along
    root = space @ linalg.root(space.T @ information @ space)[0]
    out = []
    for part in parts:
        # `left` is u'u and `pull` is u'r
        coupling = root.T @ information[:, part]
        left = information[part, part] - coupling.T @ coupling
        pull = vector[part] - coupling.T @ (root.T @ vector)
        determined = np.diagonal(left) > _ROUNDING * np.diagonal(information[part, part])
        half, _ = linalg.root(left)
        inverse = half @ half.T if determined.all() else np.zeros_like(left)
        value = inverse @ pull
        out.append((float(pull @ value), value, part.stop - part.start))
    return out


def _shared_equations(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return information (n, n) and right side (n,) of the n shared unknowns of one problem at `x` (1, size).

    Local unknowns are eliminated.
    """
    information, vector = Equalities.of(problem).shared(equations_at(problem, x), x)
    return information[0], vector[0]


def _with_families(problem: Problem, found: tuple[Candidate, ...]) -> tuple[Problem, list[tuple[str, tuple[int, int]]]]:
    """Return the problem with one additional bias per form, and the place of each candidate in these biases.

    A place is the name of the bias, its first entry and the entry after its last entry. All candidates of a form are
    members of one bias: a bias with many members takes no more time than a bias with one. `found` are the candidates.
    """
    more, places = [], [("", (0, 0))] * len(found)
    for form in dict.fromkeys(one.bias.form for one in found):
        numbers = [i for i, one in enumerate(found) if one.bias.form == form]
        parts = [found[i].bias for i in numbers]
        # `size` is the number of unknowns of each member
        name, size = f"{form} that is tested", prod(FORMS[form].shape(parts[0], problem.dimension)[1:])
        member = np.concatenate([np.full(len(part.row), j) for j, part in enumerate(parts)])
        row, coefficient = (np.concatenate([getattr(part, key) for part in parts]) for key in ("row", "coefficient"))
        more.append(replace(parts[0], name=name, members=tuple(map(str, numbers)), row=row, member=member))
        more[-1] = replace(more[-1], coefficient=coefficient)
        for j, i in enumerate(numbers):
            places[i] = name, (size * j, size * (j + 1))
    return replace(problem, biases=(*problem.biases, *more)), places


def _with_biases(problem: Problem, found: tuple[Candidate, ...]) -> Problem:
    """Return the problem with the candidates as additional biases, each with a unique name."""
    more = tuple(replace(one.bias, name=f"{one.bias.name} {i}") for i, one in enumerate(found))
    return replace(problem, biases=(*problem.biases, *more))


def _embed(problem: Problem, larger: Problem, x: Array) -> Array:
    """Return the vectors `x` (N, size) of `problem` as vectors of `larger`, which has more biases.

    The additional biases are zero.
    """
    shared, n = np.zeros((len(x), larger.layout.n_shared)), problem.layout.n_shared
    for slot in problem.layout.shared:
        new, _ = larger.layout.find(slot.name)
        shared[:, new.start : new.start + new.size] = x[:, slot.start : slot.start + slot.size]
    return np.concatenate([shared, x[:, n:]], axis=1)


def _fitted(problem: Problem, x: Array, one: Candidate, scored: tuple[float, Array, int]) -> Explained:
    """Return the explanation by a candidate after the candidate is estimated together with all other unknowns.

    `x` (1, size) is the fix without the candidate, and `scored` the result of `score`. The p-values are NaN here.
    """
    larger = _with_biases(problem, (one,))
    slot, _ = larger.layout.find(larger.biases[-1].name)
    part = slice(slot.start, slot.start + slot.size)
    start = _embed(problem, larger, x)
    # for a large drift or rotation, the step of the test is a poor start: descend from it and from zero
    start = np.concatenate([start, start])
    start[1, part] = scored[1]
    both, cost = descend(larger.take(np.zeros(2, dtype=int)), start)
    best = int(np.argmin(cost))
    sigma = _sigma(larger, both[best][None], part)
    return Explained(one, both[best, part], sigma, scored[0], float(cost[best]), np.nan, np.nan)


def _sigma(problem: Problem, x: Array, part: slice) -> Array:
    """Return the standard deviations (q,) of the shared unknowns in the slice `part`, at `x` (1, size)."""
    information, _ = _shared_equations(problem, x)
    space = Equalities.of(problem).lasting_space(x)[0]
    root = space @ linalg.root(space.T @ information @ space)[0]
    return np.asarray(np.sqrt((root[part] ** 2).sum(-1)))


# Refits.

# Length of the last step of a refit in standard deviations: the error of the cost is then 1e-8.
_CLOSE = 1e-4
# Largest number of steps: a search drops diverging descents, and converging descents take a dozen steps.
_STEPS = 30
# Steps before descents are compared: the first gives the unknowns that enter linearly, the second a direction.
_FEW_STEPS = 2
# Distances of the starts from the centre of the stations in spreads: inside the network, at its edge, and two outside.
_DISTANCES = (0.4, 1.2, 4.0, 15.0)
# Distance in spreads of the stations beyond which a position is only a direction: differences of ranges become
# rounding.
_FLAT = 1e6


def descend(problem: Problem, x: Array, steps: int = _STEPS) -> tuple[Array, Array]:
    """Return least-squares vectors (M, size) from the starts `x` (M, size), and their costs (M,).

    `problem` is a flat batch of M problems. The results satisfy equalities; inequalities are ignored. The cost is
    infinite if a descent fails. `steps` is the largest number of steps.
    """
    done = refine(problem, np.array(x), tolerance=_CLOSE, limit=steps, face=exact(problem))
    return done.x, np.where(np.isfinite(done.cost), done.cost, np.inf)


@dataclass(frozen=True, slots=True)
class ScoreFit:
    """Best of many descents of a flat batch of N problems.

    - x (N, size): parameter vectors.
    - cost (N,): their costs; infinite if every descent failed.
    """

    x: Array
    cost: Array


def fit_anywhere(problem: Problem, more: Array | None = None, most: int | None = None) -> ScoreFit:
    """Return the best fit of N problems of one position, by descents from starts in all directions around the stations.

    The result is not proven to be the best fit. The cost is infinite if every descent failed or ended beyond `_FLAT`
    spreads of the stations. If the search misses the best position, an advice is missing, but no advice is wrong.
    `more` (N, size) is one additional start of each problem; NaN for none. With `most`, only that number of descents
    goes on after a few steps, those with the least cost.
    """
    n, layout = problem.batch_shape[0], problem.layout
    centre, spread = centre_and_spread(problem.stations.places)
    rays = _directions(problem.dimension)
    away = np.concatenate([np.zeros((1, problem.dimension)), *(distance * rays for distance in _DISTANCES)])
    points = centre[..., None, :] + np.reshape(spread, (-1, 1, 1)) * away
    points = np.broadcast_to(points, (n, *points.shape[-2:]))
    x = np.zeros((n, points.shape[1], layout.size))
    slot, _ = layout.find("position")
    x[..., slot.start : slot.start + slot.size] = points
    if more is not None:
        x = np.concatenate([x, np.where(np.isfinite(more), more, x[:, 0])[:, None]], axis=1)
    if most is not None and most < x.shape[1]:
        many = problem.take(np.repeat(np.arange(n), x.shape[1]))
        near, before = descend(many, x.reshape(-1, layout.size), _FEW_STEPS)
        x, before = near.reshape(x.shape), before.reshape(n, -1)
        cheap = np.argsort(before, axis=1, kind="stable")[:, :most]
        x = np.take_along_axis(x, cheap[..., None], axis=1)
    # all descents of all problems form one batch
    many = problem.take(np.repeat(np.arange(n), x.shape[1]))
    found, cost = (part.reshape(*x.shape[:2], -1) for part in descend(many, x.reshape(-1, layout.size)))
    away = found[..., slot.start : slot.start + slot.size] - centre[..., None, :]
    far = np.abs(away).max(-1) > _FLAT * np.reshape(spread, (-1, 1))
    cost = np.where(far, np.inf, cost[..., 0])
    best, rows = cost.argmin(1), np.arange(n)
    return ScoreFit(found[rows, best], cost[rows, best])


def _directions(d: int) -> Array:
    """Return unit vectors (q, d): every 45 degrees of the plane; in space, axes and corners of a cube."""
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * d), axis=-1).reshape(-1, d)
    kept = grid[np.isin(np.abs(grid).sum(-1), (1, d))]
    return np.asarray(kept / np.sqrt((kept**2).sum(-1, keepdims=True)))


def one_place(problem: Problem) -> bool:
    """Return whether the problem has one epoch and one shared position."""
    return problem.epochs == 1 and problem.layout.shares("position")
