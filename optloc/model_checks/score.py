"""Score tests of what one channel may have wrong, and the refits that confirm it."""

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
"""Probability that data of a right model are accused by any of the tests together (Bonferroni)."""

FITS = 1e-3
"""Probability of the chi-square test from which what is left counts as explained."""

# Candidates that are fitted after the tests have ranked them: a gross error bends the fix, and the culprit is then
# among the first, not always the first.
_FITTED = 8
# Cost within which two explanations are told together: three sigma of one number.
_RIVAL = 9.0
# Costs that differ by less decide nothing between two forms of an error of one station: the simpler one is told.
_SAME = 2.0
# The simplest first.
_ORDER = (*FORMS, "step", "burst")
# What a scale of arrival times has against it beside a drift: a clock that is fast is a drift, and seconds are as long
# for all, so the odds are a hundred to one. Where a run looks alike in both, noise alone decides between them.
_STRETCHED_TIME = 9.0
# Share of its information that is left of a candidate once the other unknowns follow it, below which it is rounding.
_OPEN = 1e-9
# Epochs of a run from which steps and bursts are looked for, and how many times of them are tried.
_STEP_EPOCHS, _STEP_TIMES = 6, 12


@dataclass(frozen=True, slots=True)
class Candidate:
    """One systematic error that a problem does not model.

    Parameters
    ----------
    bias : Bias
        Of one member.
    per : "station" or "kind"
        Whether it belongs to one station or to all rows of a kind.
    kind : str
        Kind of the rows; empty where several are touched.
    since, until : float
        Times from which it lasts, and at which it is over, seconds; NaN: all the time, to the end.
    """

    bias: Bias
    per: Per
    kind: str
    since: float = float("nan")
    until: float = float("nan")

    @property
    def form(self) -> str:
        """Return the form of the bias, or "step" or "burst" of an offset that does not last all the time."""
        if not np.isfinite(self.since):
            return self.bias.form
        return "burst" if np.isfinite(self.until) else "step"

    @property
    def is_channel_offset(self) -> bool:
        """Return whether it adds a constant to one station's rows of a kind, all the time."""
        form = form_of(self.bias)
        return self.per == "station" and form.enters == "adds" and not (form.changes or np.isfinite(self.since))

    @property
    def name(self) -> str:
        """Return it in words, for instance "drift of R2"."""
        whose = self.bias.members[0] if self.per == "station" else f"all {self.bias.members[0]} rows"
        when = f" from t = {self.since:.6g} s" if np.isfinite(self.since) else ""
        return f"{self.form} of {whose}{when}" + (f" to {self.until:.6g} s" if np.isfinite(self.until) else "")


@dataclass(frozen=True, slots=True)
class Explained:
    """A systematic error that explains the misfit of a fix.

    Parameters
    ----------
    candidate : Candidate
        Which.
    value, sigma : array (q,)
        Estimate and standard deviation in SI units and radians; three angles of a turn in space.
    score : float
        Rao's statistic at the fix: chi-square of q degrees of freedom if there is no such error.
    cost : float
        What is left of the cost once it is estimated.
    p_before, p_after : float
        Chi-square probabilities without and with it.
    """

    candidate: Candidate
    value: Array
    sigma: Array
    score: float
    cost: float
    p_before: float
    p_after: float


def explain_misfit(problem: Problem, x: Array) -> tuple[Explained, ...]:
    """Return the systematic errors that explain the misfit of a fix, the best first; those that do as well follow.

    An error is named where its score test rejects that there is none, at the level `FALSE_ALARM` over all tests, where
    the cost falls by as much when it is estimated, and where what is left passes the chi-square test with redundancy
    to spare.

    Parameters
    ----------
    problem : Problem
        Flat batch of one problem; a run is taken as a whole.
    x : array (1, size)
        Its fix: least squares begin there.

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
    # a search for the ends of steps and bursts picks the best of all that it could have reached: those of every channel
    # that begin at any epoch, and end at any of so many
    channels = sum(one.is_channel_offset for one in found)
    more = channels * problem.epochs * (2 * _around(problem) + 2) if any(o.form == "step" for o in found) else 0
    level = 1.0 - FALSE_ALARM / (len(found) + more)
    # a statistic is the square of a projection of the residual: none is larger than the cost
    if cost[0] <= quantile(level, 1):
        return ()
    scores = score(problem, x, found)
    sharp = tuple(_sharpened(problem, x, found, np.array([one for one, _, _ in scores])))
    if sharp:
        found, scores = (*found, *sharp), [*scores, *score(problem, x, sharp)]
    limit = np.array([quantile(level, max(1, size)) for _, _, size in scores])
    values = np.array([one for one, _, _ in scores])
    order = np.argsort(-np.where(values > limit, values - limit, -np.inf), kind="stable")[:_FITTED]
    told = []
    for i in order:
        if values[i] <= limit[i] or dof - scores[i][2] < 1:
            continue
        own = _fitted(problem, x, found[i], scores[i])
        after = float(tail_probability(own.cost + np.zeros(1), np.array([dof - scores[i][2]]))[0])
        if after >= FITS and cost[0] - own.cost > limit[i]:
            told.append(replace(own, p_before=before, p_after=after))
    return _distinct(told)


def _distinct(told: list[Explained]) -> tuple[Explained, ...]:
    """Return explanations that cost about as little as the best, those first; of equal ones the simplest."""
    # one row has an offset, a scale and a drift alike, and so have rows of one place
    simple = sorted(told, key=lambda one: (_is_stretched(one), _ORDER.index(one.candidate.form), one.cost))
    kept: list[Explained] = []
    for one in simple:
        same = [other for other in kept if other.candidate.bias.members == one.candidate.bias.members]
        if not any(_stands_for(other, one) for other in same):
            kept.append(one)
    kept.sort(key=lambda one: one.cost)
    return tuple(one for one in kept if one.cost <= kept[0].cost + _RIVAL)


def _stands_for(other: Explained, one: Explained) -> bool:
    """Return whether an explanation makes another one of the same station not worth telling."""
    if _is_stretched(one) and not _is_stretched(other):
        return other.cost - one.cost < _STRETCHED_TIME
    return abs(other.cost - one.cost) < _SAME


def _is_stretched(one: Explained) -> bool:
    """Return whether an explanation is a scale of times."""
    form, kind = form_of(one.candidate.bias), one.candidate.kind
    return form.enters == "scales" and kind != "" and _is_of_arrivals(kind)


def _is_of_arrivals(kind: str) -> bool:
    """Return whether rows of a kind are times that clocks of their stations tell: differences, or since an emission."""
    model = MODELS[kind]
    return model.quantity == "length" and (model.emission or model.stations == 2)


def candidates(problem: Problem) -> tuple[Candidate, ...]:
    """Return the systematic errors that rows of a problem could have and that its biases do not hold already."""
    names = problem.stations.names
    present = np.broadcast_to(problem.weight, (1, problem.count))[0] > 0.0
    out: list[Candidate] = []
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        own = present[start : start + rows.count]
        if not own.any():
            continue
        taken = MODELS[rows.kind].stations
        heard = np.unique(np.concatenate([index[own] for index in (rows.a, rows.b)[:taken]] or [np.zeros(0, int)]))
        for form in _forms(problem, rows.kind):
            out.append(_candidate(problem, form, "kind", rows.kind, None))
            out += [_candidate(problem, form, "station", rows.kind, names[i]) for i in heard if i >= 0]
    out += list(_turns(problem, present))
    return (*out, *_steps(problem, out))


def _forms(problem: Problem, kind: str) -> Iterator[FormName]:
    yield "offset"
    if MODELS[kind].period is None:  # an angle has no scale
        yield "scale"
    # a line through two epochs is two offsets
    if len(np.unique(problem.times)) > 2 and np.isfinite(problem.times).all():
        yield "drift"


def _candidate(problem: Problem, form: FormName, per: Per, kind: str | None, station: str | None) -> Candidate:
    members = None if station is None else (station,)
    names = problem.stations.names
    bias = family(problem.rows, names, f"{form} that is tested", per=per, form=form, kind=kind, members=members)
    return Candidate(bias, per, kind or "")


def _turns(problem: Problem, present: Array) -> Iterator[Candidate]:
    """Yield the turns of stations in space: those in the plane are offsets of the azimuth."""
    angles = [
        index
        for rows, start in zip(problem.rows, problem.starts, strict=True)
        if MODELS[rows.kind].axes
        for index in rows.a[present[start : start + rows.count]].tolist()
    ]
    # three angles from fewer rows than four say nothing
    if problem.dimension == 3:
        for i in sorted(set(angles)):
            if angles.count(i) > 3:
                yield _candidate(problem, "rotation", "station", None, problem.stations.names[i])


def _steps(problem: Problem, found: list[Candidate]) -> Iterator[Candidate]:
    """Yield offsets of stations that begin in the middle of a run, and those that end there too."""
    k = problem.epochs
    if k < _STEP_EPOCHS or not np.isfinite(problem.times).all():
        return
    cuts = np.unique(np.linspace(1, k - 1, min(k - 1, _STEP_TIMES)).round().astype(int)).tolist()
    # a burst before the first cut is a step there, and after the last one too
    spans = [*((first, k) for first in cuts), *pairwise(cuts)]
    stations = [one for one in found if one.is_channel_offset]
    for first, last in spans:
        yield from (made for one in stations for made in _lasting(problem, one, first, last))


def _lasting(problem: Problem, one: Candidate, first: int, last: int) -> Iterator[Candidate]:
    """Yield an offset of the epochs first <= k < last alone, where that is not nothing and not all."""
    when = problem.epoch[one.bias.row]
    inside = (when >= first) & (when < last)
    if inside.any() and not inside.all():
        until = float(problem.times[last]) if last < problem.epochs else float("nan")
        yield replace(one, bias=_of_rows(one.bias, inside), since=float(problem.times[first]), until=until)


def _sharpened(problem: Problem, x: Array, found: Sequence[Candidate], values: Array) -> list[Candidate]:
    """Return the best step and the best burst with their ends at the epochs that the test likes best.

    Between the times that are tried at first an error of many sigma leaves a misfit that hides what it is.
    """
    out, around = [], _around(problem)
    for form in ("step", "burst"):
        own = [i for i, one in enumerate(found) if one.form == form]
        if not own:
            continue
        best = found[max(own, key=lambda i: values[i])]
        # the same channel, all the time
        whole = next(
            one
            for one in found
            if one.is_channel_offset and (one.kind, one.bias.members) == (best.kind, best.bias.members)
        )
        for end in range(1 if form == "step" else 2):
            ends = _ends(problem, best)
            near = np.clip(ends[end] + np.arange(-around, around + 1), 1 if end == 0 else ends[0] + 1, problem.epochs)
            spans = [(k, ends[1]) if end == 0 else (ends[0], k) for k in np.unique(near).tolist()]
            tried = tuple(made for span in spans if span[0] < span[1] for made in _lasting(problem, whole, *span))
            best = tried[int(np.argmax([value for value, _, _ in score(problem, x, tried)]))]
        out.append(best)
    return out


def _around(problem: Problem) -> int:
    """Return how many epochs lie between the times that are tried at first."""
    return -(-problem.epochs // _STEP_TIMES)


def _ends(problem: Problem, one: Candidate) -> tuple[int, int]:
    """Return the first epoch of what does not last all the time, and the one after its last."""
    last = int(np.searchsorted(problem.times, one.until)) if np.isfinite(one.until) else problem.epochs
    return int(np.searchsorted(problem.times, one.since)), last


def _of_rows(bias: Bias, inside: Array) -> Bias:
    """Return a bias that touches only some of its rows."""
    return replace(bias, row=bias.row[inside], member=bias.member[inside], coefficient=bias.coefficient[inside])


# The tests themselves.


def score(problem: Problem, x: Array, found: tuple[Candidate, ...]) -> list[tuple[float, Array, int]]:
    """Return Rao's statistic, the estimate (q,) of one step and q of every candidate.

    With the whitened residual r and columns J of the unknowns and c of the candidate, u = c - J J^+ c, the statistic is
    ``(u'r)' (u'u)^-1 (u'r)``: what all other unknowns can take up is projected out.

    Parameters
    ----------
    problem : Problem
        Flat batch of one problem.
    x : array (1, size)
        Its fix.
    found : tuple of Candidate
        What is tested.
    """
    larger, places = _with_families(problem, found)
    layout = larger.layout
    information, vector = _shared(larger, _embed(problem, larger, x))
    own = [slice(*(layout.find(name)[0].start + end for end in ends)) for name, ends in places]
    inside = np.concatenate([np.arange(part.start, part.stop) for part in own])
    rest = np.setdiff1d(np.arange(layout.n_shared), inside)
    space = np.eye(layout.n_shared)[:, rest]
    if (held := Equalities.of(problem)).lasting:
        # along the equalities only: the other unknowns cannot leave them
        along = held.lasting_space(x)[0]
        old = [layout.find(slot.name)[0].start + i for slot in problem.layout.shared for i in range(slot.size)]
        space = np.zeros((layout.n_shared, along.shape[1]))
        space[old] = along
    root = space @ linalg.root(space.T @ information @ space)[0]
    out = []
    for part in own:
        coupling = root.T @ information[:, part]
        left = information[part, part] - coupling.T @ coupling
        pull = vector[part] - coupling.T @ (root.T @ vector)
        told = np.diagonal(left) > _OPEN * np.diagonal(information[part, part])
        half, _ = linalg.root(left)
        inverse = half @ half.T if told.all() else np.zeros_like(left)
        value = inverse @ pull
        out.append((float(pull @ value), value, part.stop - part.start))
    return out


def _shared(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return information (n, n) and vector (n,) of the shared unknowns of one problem, local ones eliminated."""
    information, vector = Equalities.of(problem).shared(equations_at(problem, x), x)
    return information[0], vector[0]


def _with_families(problem: Problem, found: tuple[Candidate, ...]) -> tuple[Problem, list[tuple[str, tuple[int, int]]]]:
    """Return the problem with all candidates, those of a form as one bias, and the bias and entries of each.

    A bias of many members costs no more than one of a single member.
    """
    more, places = [], [("", (0, 0))] * len(found)
    for form in dict.fromkeys(one.bias.form for one in found):
        own = [i for i, one in enumerate(found) if one.bias.form == form]
        parts = [found[i].bias for i in own]
        name, size = f"{form} that is tested", prod(FORMS[form].shape(parts[0], problem.dimension)[1:])
        member = np.concatenate([np.full(len(part.row), j) for j, part in enumerate(parts)])
        row, coefficient = (np.concatenate([getattr(part, key) for part in parts]) for key in ("row", "coefficient"))
        more.append(replace(parts[0], name=name, members=tuple(map(str, own)), row=row, member=member))
        more[-1] = replace(more[-1], coefficient=coefficient)
        for j, i in enumerate(own):
            places[i] = name, (size * j, size * (j + 1))
    return replace(problem, biases=(*problem.biases, *more)), places


def _with(problem: Problem, found: tuple[Candidate, ...]) -> Problem:
    """Return the problem with candidates among its biases, each under a name of its own."""
    more = tuple(replace(one.bias, name=f"{one.bias.name} {i}") for i, one in enumerate(found))
    return replace(problem, biases=(*problem.biases, *more))


def _embed(problem: Problem, larger: Problem, x: Array) -> Array:
    """Return vectors (N, size) of a problem with more biases, which are zero."""
    shared, n = np.zeros((len(x), larger.layout.n_shared)), problem.layout.n_shared
    for slot in problem.layout.shared:
        new, _ = larger.layout.find(slot.name)
        shared[:, new.start : new.start + new.size] = x[:, slot.start : slot.start + slot.size]
    return np.concatenate([shared, x[:, n:]], axis=1)


def _fitted(problem: Problem, x: Array, one: Candidate, scored: tuple[float, Array, int]) -> Explained:
    """Return what a candidate explains once it is estimated with all other unknowns."""
    larger = _with(problem, (one,))
    slot, _ = larger.layout.find(larger.biases[-1].name)
    part = slice(slot.start, slot.start + slot.size)
    start = _embed(problem, larger, x)
    # of a drift or turn that is large the step of the test is as good a start as none: the better descent counts
    start = np.concatenate([start, start])
    start[1, part] = scored[1]
    both, cost = descend(larger.take(np.zeros(2, dtype=int)), start)
    best = int(np.argmin(cost))
    sigma = _sigma(larger, both[best][None], part)
    return Explained(one, both[best, part], sigma, scored[0], float(cost[best]), np.nan, np.nan)


def _sigma(problem: Problem, x: Array, part: slice) -> Array:
    """Return the standard deviations (q,) of a part of the shared unknowns."""
    information, _ = _shared(problem, x)
    space = Equalities.of(problem).lasting_space(x)[0]
    root = space @ linalg.root(space.T @ information @ space)[0]
    return np.asarray(np.sqrt((root[part] ** 2).sum(-1)))


# Refits.

# Length of the last step, standard deviations, at which a refit ends: its cost is then known to 1e-8.
_CLOSE = 1e-4
# Steps at most: a search drops descents that run away, and those that arrive take a dozen.
_STEPS = 30
# Distances of the starts from the middle of the stations, spreads: inside the network, at its edge, and two outside.
_DISTANCES = (0.4, 1.2, 4.0, 15.0)
# Spreads of the stations beyond which a place is a direction, and differences of ranges begin to be rounding.
_FLAT = 1e6


def descend(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return vectors (M, size) of least squares next to starts, and their costs (M,).

    Parameters
    ----------
    problem : Problem
        Flat batch of M problems; equalities are kept, inequalities are not looked at.
    x : array (M, size)
        Starts.
    """
    done = refine(problem, np.array(x), tolerance=_CLOSE, limit=_STEPS, face=exact(problem))
    return done.x, np.where(np.isfinite(done.cost), done.cost, np.inf)


@dataclass(frozen=True, slots=True)
class ScoreFit:
    """The best of many descents of a flat batch of N problems.

    Parameters
    ----------
    x : array (N, size)
        Vectors.
    cost : array (N,)
        Their costs; infinite where every descent failed.
    """

    x: Array
    cost: Array


def fit_anywhere(problem: Problem, more: Array | None = None) -> ScoreFit:
    """Return the best fit of problems of one position by descents from all around the stations.

    Nothing is proven: a search that misses the best place makes an advice be missed, not a wrong one be given.

    Parameters
    ----------
    problem : Problem
        Flat batch of N problems that have a position.
    more : array (N, size), optional
        Another start; NaN where there is none.
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
    many = problem.take(np.repeat(np.arange(n), x.shape[1]))
    found, cost = (part.reshape(*x.shape[:2], -1) for part in descend(many, x.reshape(-1, layout.size)))
    away = found[..., slot.start : slot.start + slot.size] - centre[..., None, :]
    far = np.abs(away).max(-1) > _FLAT * np.reshape(spread, (-1, 1))
    cost = np.where(far, np.inf, cost[..., 0])
    best, rows = cost.argmin(1), np.arange(n)
    return ScoreFit(found[rows, best], cost[rows, best])


def _directions(d: int) -> Array:
    """Return unit vectors (q, d): every 45 degrees of the plane; in space axes and corners of a cube."""
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * d), axis=-1).reshape(-1, d)
    kept = grid[np.isin(np.abs(grid).sum(-1), (1, d))]
    return np.asarray(kept / np.sqrt((kept**2).sum(-1, keepdims=True)))


def one_place(problem: Problem) -> bool:
    """Return whether the unknowns of a problem are one position of one epoch and what goes with it."""
    return problem.epochs == 1 and problem.layout.shares("position")
