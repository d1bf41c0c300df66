"""Where to put stations: the set of sites, how far from the best it can be, and what becomes of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from formulations.placement import covariances
from optloc.bounds import bound_map, crlb, extent, map_coordinates
from optloc.engine import degrees_of_freedom, simulate
from optloc.problem import Array, InvalidProblem, Status
from optloc.sites.placement.best_set import BestSetResult, SearchTask, random_sets, search
from optloc.sites.placement.sites import LETTER, Candidates, SiteSelection, candidates_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PRIOR = 0.01
"""Share of the variance at a place that is owed to the prior, above which the place has no fix of its own."""

AMBIGUOUS = 0.05
"""Share of ambiguous fixes above which a set is given up for the next."""

# Singular values of stations about their centre, over the bound of a place, below which they are flat: a mirror image
# is told from the place by an error of so many standard deviations.
_FLAT = 3.0
# Random sets whose median stands for what there was before, where nothing is kept.
_RANDOM = 25
# Points along each side of a map.
_MAP_POINTS = 80
# The 95 % quantile of chi-square with two and three degrees of freedom.
_QUANTILE = {2: 5.991464547107979, 3: 7.814727903251179}


@dataclass(frozen=True, slots=True)
class Swap:
    """What the loss of a station costs.

    Parameters
    ----------
    name : str
        The station.
    value : float
        The criterion without it, square metres.
    replacement : str
        What would best take its place; empty where there is nothing.
    replaced : float
        The criterion then.
    """

    name: str
    value: float
    replacement: str
    replaced: float


@dataclass(frozen=True, slots=True)
class Draws:
    """What became of simulated fixes with the chosen stations.

    Parameters
    ----------
    count : int
        Draws at each place.
    ambiguous : array (P,)
        Share of fixes at each place whose data fit another position about as well.
    ratio : array (P,)
        Root mean square error over the bound, of the fixes that are not ambiguous; NaN where there are none.
    coverage : array (P,)
        Share of these whose 95 % ellipse holds the place.
    flat : array (P,)
        How far stations in sight are off their best plane (root of the sum of squares), in bounds of the place; a small
        number says mirror image.
    """

    count: int
    ambiguous: Array
    ratio: Array
    coverage: Array
    flat: Array

    @property
    def clean(self) -> bool:
        """Return whether few enough fixes are ambiguous."""
        return float(self.ambiguous.mean()) <= AMBIGUOUS


@dataclass(frozen=True, slots=True)
class Placement:
    """A set of sites, and a proof of how good any set of the candidates can be.

    Parameters
    ----------
    chosen, kept : tuple of str
        Sites that were taken beyond those that were there; and those.
    criterion : str
        "rms", "volume" or "axis".
    value, bound : float
        The criterion of the set, and what no set that meets the rules is below, square metres: the mean over places of
        the squared error, of the geometric mean of the variances along the axes, or of the largest of them.
    gap : float
        Share of the value by which the bound is below it.
    closed : bool
        Whether the gap is no larger than was asked.
    reason : str
        What that means, in a sentence.
    per_place, failed : array (P,)
        Bound of the position error at each place (root of the trace), metres: of the set, and with the worst loss of
        one site at this place.
    before : array (P,)
        The same of the kept sites, or of the median of random sets where those have no fix.
    before_sites : tuple of str
        Whose they are.
    share_of_prior : array (P,)
        Share of the variance that is owed to the prior.
    redundancy : int array (P,)
        Rows in sight less unknowns: with none a wrong one is not noticed.
    swaps : tuple of Swap
        What the loss of each taken site costs, the dearest first.
    alternatives : tuple of (tuple of str, float)
        The best sets that were seen, and their values, square metres.
    following : tuple of (str, float)
        What another site would bring: names and values, square metres, the best first.
    course : array (q, 3)
        Seconds, bound and value while it searched.
    nodes : int
        Relaxations that were solved.
    draws : Draws, optional
        What simulated fixes say.
    banned : tuple of tuple of str
        Better sets that were given up because their fixes are ambiguous.
    refined : array (k, d), optional
        Positions of the taken sites after continuous refinement, metres.
    refined_value : float
        The criterion there; the bound says nothing about it.
    """

    chosen: tuple[str, ...]
    kept: tuple[str, ...]
    criterion: str
    value: float
    bound: float
    gap: float
    closed: bool
    reason: str
    per_place: Array
    failed: Array
    before: Array
    before_sites: tuple[str, ...]
    share_of_prior: Array
    redundancy: Array
    swaps: tuple[Swap, ...]
    alternatives: tuple[tuple[tuple[str, ...], float], ...]
    following: tuple[tuple[str, float], ...]
    course: Array
    nodes: int
    draws: Draws | None = None
    banned: tuple[tuple[str, ...], ...] = ()
    refined: Array | None = None
    refined_value: float = float("nan")

    @property
    def sigma(self) -> float:
        """Return the root of the value, metres."""
        return float(np.sqrt(self.value))


def place(
    selection: SiteSelection,
    *,
    draws: int = 0,
    tell: Callable[[float, float, int], None] = lambda bound, value, nodes: None,
) -> Placement:
    """Return which sites to take, with a bound of what any choice of the candidates can reach.

    Parameters
    ----------
    selection : SiteSelection
        Candidates, places and rules.
    draws : int
        Simulated fixes at each place that check the set for ambiguity; a set that fails is given up for the next best,
        as often as `selection.alternatives` says. 0: none.
    tell : callable of (bound, value, nodes)
        Told now and then how far the search is; in the units of the criterion.

    Returns
    -------
    Placement
        Where `closed` is False, the time was up: the gap says what is known.

    Raises
    ------
    InvalidProblem
        Naming the argument, site or place that cannot be right, or the rules that allow no set.

    References
    ----------
    S. Joshi and S. Boyd, "Sensor selection via convex optimization", IEEE Trans. Signal Process. 57 (2009).
    """
    candidates = candidates_of(selection)
    task, banned = task_of(candidates), list[Array]()
    while True:
        found = search(
            _without(task, banned),
            gap=selection.gap,
            seconds=selection.seconds,
            keep=selection.alternatives,
            seed=selection.seed,
            tell=tell,
        )
        if not found.best:
            what = "no set of sites meets the rules" if not banned else "every set that meets the rules is ambiguous"
            raise InvalidProblem(what, "groups", "allow more sites of a group, ask for fewer, or name more candidates")
        chosen = found.best[0][1]
        checked = drawn(candidates, chosen, draws, selection.seed) if draws else None
        if checked is None or checked.clean or len(banned) >= selection.alternatives:
            return _answer(candidates, task, found, checked, banned)
        banned.append(chosen)


def task_of(candidates: Candidates) -> SearchTask:
    """Return the search for the best set of some candidates."""
    selection = candidates.selection
    return SearchTask(
        candidates.design,
        LETTER[selection.criterion],
        selection.worst,
        selection.fail_one,
        candidates.rules,
        candidates.limits,
        candidates.state,
    )


def _without(task: SearchTask, banned: Sequence[Array]) -> SearchTask:
    """Return a task that does not allow some sets."""
    rules = np.array([chosen / chosen.sum() for chosen in banned]).reshape(len(banned), len(task.state))
    limits = np.array([1.0 - 1.0 / chosen.sum() for chosen in banned])
    return replace(task, rules=np.vstack([task.rules, rules]), limits=np.concatenate([task.limits, limits]))


def _answer(
    candidates: Candidates, task: SearchTask, found: BestSetResult, checked: Draws | None, banned: Sequence[Array]
) -> Placement:
    selection, names = candidates.selection, candidates.names
    value, chosen = found.best[0]
    bound, reached = task.scale(found.bound), task.scale(value)
    gap = max(0.0, 1.0 - bound / reached)
    before, sites = _before(candidates, task)
    per_place, share = _per_place(candidates, chosen)
    told = f"no set of these candidates has a value more than {100 * gap:.2g} % lower"
    reason = told if found.closed else f"the time was up: {told}; give it more time, or accept a larger gap"
    new = (chosen == 1) & (candidates.state != 1)
    if selection.choose is not None and (count := int(new.sum())) < selection.choose:
        reason += (
            f"; {count} of the {selection.choose} sites that were asked for: more exceed the budget, or do not help"
        )
    return Placement(
        _named(names, new),
        _named(names, candidates.state == 1),
        selection.criterion,
        reached,
        bound,
        gap,
        found.closed,
        reason,
        per_place,
        _failed(candidates, chosen),
        before,
        sites,
        share,
        _redundancy(candidates, chosen),
        tuple(_swaps(task, names, chosen)),
        tuple((_named(names, (one == 1) & (candidates.state != 1)), task.scale(v)) for v, one in found.best),
        tuple(_following(task, names, chosen)),
        _course(task, found.course),
        found.nodes,
        checked,
        tuple(_named(names, one == 1) for one in banned),
    )


def _course(task: SearchTask, course: Array) -> Array:
    out = course.copy()
    out[:, 1:] = [[task.scale(v) for v in row] for row in course[:, 1:]]
    return out


def _named(names: Sequence[str], mask: Array) -> tuple[str, ...]:
    return tuple(names[i] for i in np.flatnonzero(mask).tolist())


def _per_place(candidates: Candidates, chosen: Array) -> tuple[Array, Array]:
    """Return the bound (P,) of the position error of a set, metres, and the prior's share of its variance."""
    covariance = np.asarray(crlb(candidates.assembled(chosen), candidates.vectors))
    d = candidates.design.dimension
    variance = np.trace(covariance[..., :d, :d], axis1=-2, axis2=-1)
    information = candidates.design.prior + np.einsum(
        "prmn,n,prkn->pmk", candidates.design.rows, chosen.astype(float), candidates.design.rows
    )
    inverse = np.linalg.inv(information)[:, :d]
    owed = np.trace(inverse @ candidates.design.prior @ np.swapaxes(inverse, 1, 2), axis1=1, axis2=2)
    return np.sqrt(variance), owed / variance


def _failed(candidates: Candidates, chosen: Array) -> Array:
    """Return the bound (P,) at each place after the loss of the site that is worst there, metres."""
    lost = np.repeat(chosen[None], int(chosen.sum()), axis=0)
    lost[np.arange(len(lost)), np.flatnonzero(chosen)] = 0
    variance = np.trace(covariances(candidates.design, lost), axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(variance.max(0)))


def _before(candidates: Candidates, task: SearchTask) -> tuple[Array, tuple[str, ...]]:
    kept = (candidates.state == 1).astype(np.int64)
    if kept.any():
        per_place, share = _per_place(candidates, kept)
        if (share <= PRIOR).all():
            return per_place, _named(candidates.names, kept)
    sets = np.array(list(random_sets(task, _RANDOM, candidates.selection.seed)))
    middle = sets[np.argsort(task.score(sets))[len(sets) // 2]]
    return _per_place(candidates, middle)[0], _named(candidates.names, middle)


def _redundancy(candidates: Candidates, chosen: Array) -> Array:
    """Return the degrees of freedom (P,) of a fix from chosen sites, with the priors of the selection alone."""
    problem = replace(candidates.assembled(chosen), priors=candidates.selection.problem.priors)
    return np.asarray(degrees_of_freedom(problem))


def _swaps(task: SearchTask, names: Sequence[str], chosen: Array) -> Iterator[Swap]:
    found = []
    for i in np.flatnonzero(chosen).tolist():
        without = chosen.copy()
        without[i] = 0
        value = task.scale(float(task.score(without[None])[0]))
        tries = np.repeat(without[None], len(chosen), axis=0)
        tries[np.arange(len(chosen)), np.arange(len(chosen))] = 1
        others = np.flatnonzero((chosen == 0) & (task.state != 0) & task.fits(tries)).tolist()
        if others:
            values = task.score(tries[others])
            best = int(values.argmin())
            found.append(Swap(names[i], value, names[others[best]], task.scale(float(values[best]))))
        else:
            found.append(Swap(names[i], value, "", value))
    yield from sorted(found, key=lambda swap: -swap.value)


def _following(task: SearchTask, names: Sequence[str], chosen: Array) -> Iterator[tuple[str, float]]:
    others = np.flatnonzero((chosen == 0) & (task.state != 0)).tolist()
    if not others:
        return
    tries = np.repeat(chosen[None], len(others), axis=0)
    tries[np.arange(len(others)), others] = 1
    values = task.score(tries)
    yield from ((names[others[i]], task.scale(float(values[i]))) for i in np.argsort(values, kind="stable").tolist())


def drawn(candidates: Candidates, chosen: Array, count: int, seed: int = 0) -> Draws:
    """Return what becomes of simulated fixes with a set (n,) of sites: `count` at each place, by the method "auto"."""
    from optloc.solvers import solve

    places, d = len(candidates.vectors), candidates.design.dimension
    flat = replace(candidates.assembled(chosen), priors=candidates.selection.problem.priors).flat()
    bounds = _per_place(candidates, chosen)[0]
    ambiguous, ratio, coverage = np.zeros(places), np.full(places, np.nan), np.full(places, np.nan)
    for p in range(places):
        one = flat.take(np.array([p]))
        fix = solve(simulate(one, candidates.vectors[p], seed + p, count), "auto")
        codes = np.broadcast_to(np.asarray(fix.code), fix.cost.shape).ravel()
        position = fix.position.reshape(len(codes), -1)
        error = position - candidates.vectors[p, :d]
        good = (codes != Status.AMBIGUOUS) & np.isfinite(error).all(-1)
        ambiguous[p] = np.mean(~good)
        if good.any():
            ratio[p] = np.sqrt((error[good] ** 2).sum(-1).mean()) / bounds[p]
            cov = fix.covariance().reshape(len(codes), d, d)[good]
            coverage[p] = np.mean(
                np.einsum("qi,qij,qj->q", error[good], np.linalg.inv(cov), error[good]) <= _QUANTILE[d]
            )
    return Draws(count, ambiguous, ratio, coverage, _flat(candidates, chosen, bounds))


def _flat(candidates: Candidates, chosen: Array, bounds: Array) -> Array:
    stations = candidates.problem.stations.position.reshape(-1, candidates.design.dimension)
    weight = candidates.assembled(chosen).weight
    out = np.empty(len(bounds))
    owner = np.concatenate([rows.a for rows in candidates.problem.rows])
    for p in range(len(bounds)):
        heard = stations[np.unique(owner[weight[p] > 0.0])]
        off = np.linalg.svd(heard - heard.mean(0), compute_uv=False)[-1] if len(heard) > 1 else 0.0
        out[p] = off / bounds[p]
    return out


def picture(selection: SiteSelection, found: Placement) -> Figure:
    """Return maps of the bound before and after on one scale, and how the gap closed while it was searched.

    Parameters
    ----------
    selection : SiteSelection
        As it was given to `place`.
    found : Placement
        Its answer.

    Raises
    ------
    InvalidProblem
        Where rows were chosen, which have no map.
    """
    from optloc.sites.placement.placement_map import plot_placement

    problem, names = selection.problem, np.array(selection.problem.stations.names)
    if selection.by == "row":
        raise InvalidProblem("rows that are chosen have no map", "plot", "choose stations")
    single = problem.flat().take(np.zeros(1, dtype=int)) if problem.batch_shape else problem
    places = np.atleast_2d(np.asarray(selection.places, dtype=float))[:, : problem.dimension]
    truth = np.zeros(problem.layout.size)
    truth[: problem.dimension] = places[0]
    flat = map_coordinates(problem.frame, places, problem.frame.geodetic and problem.dimension == 3)
    height = float(np.median(flat[:, 2])) if problem.dimension == 3 else 0.0
    x0, x1, y0, y1 = extent(problem, places, widen=0.08)
    grid = np.linspace(x0, x1, _MAP_POINTS), np.linspace(y0, y1, _MAP_POINTS)
    end = np.concatenate([rows.a for rows in problem.rows])
    maps, taken = [], []
    for sites in (found.before_sites, (*found.chosen, *found.kept)):
        mask = np.isin(names, sites)
        maps.append(bound_map(single.with_rows(weight=single.weight * mask[end]), truth, *grid, height))
        taken.append(mask)
    weights = np.ones(len(places)) if selection.weights is None else np.asarray(selection.weights)
    course: Array = found.course.copy()
    course[:, 1:] = np.sqrt(np.maximum(course[:, 1:], 0.0))
    kept = set(found.before_sites) == set(found.kept)
    titles = (
        "before: kept stations" if kept else "before: a random set",
        f"after: {found.sigma:.3g} m{', one failed' * selection.fail_one}",
    )
    return plot_placement(maps, taken, flat[:, :2], weights, course, titles)
