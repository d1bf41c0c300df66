"""Sensor placement: search, result, accuracy at each place and check by simulated fixes.

`place` builds the candidates, searches the best set with a proven bound, and simulates fixes with it. If too
many of these fixes are ambiguous, `place` takes the next best set.

Letters: P places, n sites, q recorded moments of the search, d coordinates.

Arguments of many functions: `candidates` are the sites as arrays, `task` is the search task, and `chosen`
(n,) is a set of sites: 1 for each taken site.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from formulations.placement import covariances
from optloc.bounds import BoundMap, bound_map, crlb, extent, map_coordinates
from optloc.engine import degrees_of_freedom, simulate
from optloc.problem import Array, HasShortForm, InvalidProblem, Problem, Status, plot_of
from optloc.sites.placement.best_set import BestSetResult, SearchTask, random_sets, search
from optloc.sites.placement.sites import LETTER, Candidates, SiteSelection, candidates_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from optloc.sites.placement.placement_map import StationLoss

PRIOR = 0.01
"""Share of the prior in the variance at a place; above it, the sites alone do not determine the position."""

AMBIGUOUS = 0.05
"""Share of ambiguous fixes above which `place` rejects a set and tries the next best."""

# Limit for flat stations: smallest singular value of the centred stations, divided by the bound at a place.
# Below it, an error of this many standard deviations moves the fix to its mirror image.
_FLAT = 3.0
# Number of random sets; if no site is kept, the median of these sets is the comparison "before".
_RANDOM = 25
# Points along each side of a map.
_MAP_POINTS = 80
# The 95 % quantile of chi-square with two and three degrees of freedom.
_QUANTILE = {2: 5.991464547107979, 3: 7.814727903251179}


@dataclass(frozen=True, slots=True)
class Swap:
    """The effect of the loss of one station on the criterion.

    Parameters
    ----------
    name : str
        The station that is lost.
    value : float
        The criterion without this station, m^2.
    replacement : str
        The site that replaces it best; empty if the rules allow none. The replacement of a kept station is beyond the
        number of new sites and the budget.
    replaced : float
        The criterion with the replacement, m^2; equal to `value` without a replacement.
    """

    name: str
    value: float
    replacement: str
    replaced: float


@dataclass(frozen=True, slots=True)
class Draws:
    """Statistics of simulated fixes with the chosen stations.

    Parameters
    ----------
    count : int
        Simulated fixes at each place.
    ambiguous : array (P,)
        Share of ambiguous fixes at each place: the data fit another position about equally well.
    ratio : array (P,)
        Root mean square error of the unambiguous fixes, divided by the bound; NaN without unambiguous fixes.
    coverage : array (P,)
        Share of the unambiguous fixes whose 95 % ellipse contains the place.
    flat : array (P,)
        Distance of the stations in sight from their best plane (root of the sum of squares), divided by the bound
        at the place. A small number means that a mirror image fits equally well.
    """

    count: int
    ambiguous: Array
    ratio: Array
    coverage: Array
    flat: Array

    @property
    def clean(self) -> bool:
        """Return whether the mean share of ambiguous fixes is at most `AMBIGUOUS`."""
        return float(self.ambiguous.mean()) <= AMBIGUOUS


@dataclass(frozen=True, slots=True, repr=False)
class Placement(HasShortForm):
    """A set of sites, with a proven bound for all sets of the candidates (P places).

    Parameters
    ----------
    chosen, kept : tuple of str
        New sites, and sites that exist already.
    criterion : str
        "rms", "volume" or "axis".
    value, bound : float
        The criterion of this set, and a lower bound for all sets that meet the rules, square metres. At each place,
        the criterion is the squared error ("rms"), the geometric mean of the variances along the axes ("volume"),
        or the largest variance ("axis"). The value is the mean over the places (geometric for "volume"), or their
        maximum if the selection has `worst`. With `fail_one`, it is the value after the worst loss of one site.
    gap : float
        Relative difference of value and bound: 1 - bound / value.
    closed : bool
        Whether the gap is at most the requested gap.
    reason : str
        The meaning of gap and bound, as a sentence.
    per_place, failed : array (P,)
        Bound of the position error at each place (root of the trace), metres: with this set, and after the worst
        loss of one site at this place.
    before : array (P,)
        The same bound for the kept sites. If the kept sites give no fix, it is the bound of the median of random
        sets.
    before_sites : tuple of str
        Sites of `before`.
    share_of_prior : array (P,)
        Share of the variance that the prior causes.
    redundancy : int array (P,)
        Rows in sight minus unknowns; at 0, a wrong row cannot be detected.
    swaps : tuple of Swap
        Effect of the loss of each taken site, largest first.
    alternatives : tuple of (tuple of str, float)
        New sites of the best sets of the search, with their values, square metres.
    following : tuple of (str, float)
        Sites that can be added, with the value after each addition, square metres, best first.
    course : array (q, 3)
        Seconds, and bound and value (square metres), at q moments of the search.
    nodes : int
        Number of solved relaxations.
    draws : Draws, optional
        Statistics of simulated fixes.
    banned : tuple of tuple of str
        Better sets that were rejected because their fixes are ambiguous.
    refined : array (k, d), optional
        Positions of the k new sites after continuous refinement, metres.
    refined_value : float
        The criterion at these positions, square metres; the bound does not apply to it. NaN without refinement.
    selection : SiteSelection, optional
        The selection that was passed to `place`, for pictures.
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
    selection: SiteSelection | None = field(default=None, repr=False)

    def plot(self, **options: Any) -> Axes:
        """Return a map of the bound in matplotlib axes; see `optloc.sites.placement_axes` for the options."""
        return plot_of(self, **options)

    @property
    def sigma(self) -> float:
        """Return the square root of the value, metres."""
        return float(np.sqrt(self.value))


def place(
    selection: SiteSelection,
    *,
    draws: int = 0,
    tell: Callable[[float, float, int], None] = lambda bound, value, nodes: None,
) -> Placement:
    """Return the best set of sites, with a proven bound for all sets of the candidates.

    Parameters
    ----------
    selection : SiteSelection
        Candidates, places and rules.
    draws : int
        Simulated fixes at each place that check the set for ambiguity. If a set fails the check, the next best
        set is tried, at most `selection.alternatives` times. If all fail, the best set is returned. 0: no check.
    tell : callable of (bound, value, nodes)
        Progress callback during the search, in the units of the criterion.

    Returns
    -------
    Placement
        If `closed` is False, the time limit ended the search; `gap` is the proven gap at that time.

    Raises
    ------
    InvalidProblem
        If an argument, site or place is invalid, or if no set meets the rules; the message names the cause.

    References
    ----------
    S. Joshi and S. Boyd, "Sensor selection via convex optimization", IEEE Trans. Signal Process. 57 (2009).
    """
    candidates = candidates_of(selection)
    task, banned, first = task_of(candidates), list[Array](), None
    while True:
        found = search(
            _ban_sets(task, banned),
            gap=selection.gap,
            seconds=selection.seconds,
            keep=selection.alternatives,
            seed=selection.seed,
            tell=tell,
        )
        if not found.best:
            if first is None:
                advice = "relax the rules of a group, choose fewer sites, or add candidates"
                raise InvalidProblem("no set of sites meets the rules", "groups", advice)
            return _placement(candidates, task, *first, [])
        chosen = found.best[0][1]
        checked = drawn(candidates, chosen, draws, selection.seed) if draws else None
        if checked is None or checked.clean:
            return _placement(candidates, task, found, checked, banned)
        first = first or (found, checked)
        if len(banned) >= selection.alternatives:  # all sets are as ambiguous as the best, so nothing is gained
            return _placement(candidates, task, *first, [])
        banned.append(chosen)


def task_of(candidates: Candidates) -> SearchTask:
    """Return the search task for the best set of the candidates: their design and rules, and the criterion."""
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


def _ban_sets(task: SearchTask, banned: Sequence[Array]) -> SearchTask:
    """Return the task with one more rule for each banned set: at least one of its sites is not taken.

    `banned` contains sets (n,), 1 for each taken site. A rule also excludes larger sets that contain a banned
    set.
    """
    # Divide each rule by the size of its set, so that its entries are at most 1 as in the other rules.
    rules = np.array([chosen / chosen.sum() for chosen in banned]).reshape(len(banned), len(task.state))
    limits = np.array([1.0 - 1.0 / chosen.sum() for chosen in banned])
    return replace(task, rules=np.vstack([task.rules, rules]), limits=np.concatenate([task.limits, limits]))


def _placement(
    candidates: Candidates, task: SearchTask, found: BestSetResult, checked: Draws | None, banned: Sequence[Array]
) -> Placement:
    """Return the result of a search with its accuracy at each place, losses and next sites.

    `found` is the result of the search. `checked` are the statistics of simulated fixes, or None. `banned`
    are the rejected sets (n,).
    """
    selection, names = candidates.selection, candidates.names
    value, chosen = found.best[0]
    bound, reached = task.scale(found.bound), task.scale(value)
    gap = max(0.0, 1.0 - bound / reached)
    before, sites = _bounds_before(candidates, task)
    per_place, share = _bound_and_prior_share(candidates, chosen)
    others = "no set of these candidates" + (", except the rejected sets," if banned else "")
    claim = f"{others} has a value more than {100 * gap:.2g} % lower"
    reason = claim if found.closed else f"the time limit ended the search: {claim}; raise the time limit or the gap"
    new = (chosen == 1) & (candidates.state != 1)
    if selection.choose is not None and (count := int(new.sum())) < selection.choose:
        reason += f"; only {count} of the {selection.choose} wanted sites: "
        reason += "more exceed the budget, do not help or are ambiguous"
    return Placement(
        _select_names(names, new),
        _select_names(names, candidates.state == 1),
        selection.criterion,
        reached,
        bound,
        gap,
        found.closed,
        reason,
        per_place,
        _bounds_after_loss(candidates, chosen),
        before,
        sites,
        share,
        _redundancy(candidates, chosen),
        tuple(_swaps(candidates, chosen)),
        tuple((_select_names(names, (one == 1) & (candidates.state != 1)), task.scale(v)) for v, one in found.best),
        tuple(_next_sites(task, names, chosen)),
        _course_in_m2(task, found.course),
        found.nodes,
        checked,
        tuple(_select_names(names, one == 1) for one in banned),
        selection=selection,
    )


def _course_in_m2(task: SearchTask, course: Array) -> Array:
    """Return the recorded points (q, 3) of the search with bound and value as variances, m^2."""
    out = course.copy()
    out[:, 1:] = [[task.scale(v) for v in row] for row in course[:, 1:]]
    return out


def _select_names(names: Sequence[str], mask: Array) -> tuple[str, ...]:
    """Return the names at the true entries of a mask (n,)."""
    return tuple(names[i] for i in np.flatnonzero(mask).tolist())


def _bound_and_prior_share(candidates: Candidates, chosen: Array) -> tuple[Array, Array]:
    """Return the bound (P,) of the position error, metres, and the share (P,) of its variance from the prior.

    `chosen` (n,) is 1 for each taken site. If the share is large, the sites alone do not determine the
    position.
    """
    covariance = np.asarray(crlb(candidates.assembled(chosen), candidates.vectors))
    d = candidates.design.dimension
    variance = np.trace(covariance[..., :d, :d], axis1=-2, axis2=-1)
    information = candidates.design.prior + np.einsum(
        "prmn,n,prkn->pmk", candidates.design.rows, chosen.astype(float), candidates.design.rows
    )
    # Noise of the prior contributes C M^-1 M0 M^-1 C' to the covariance (M information, M0 prior, C selects position).
    inverse = np.linalg.inv(information)[:, :d]
    from_prior = np.trace(inverse @ candidates.design.prior @ np.swapaxes(inverse, 1, 2), axis1=1, axis2=2)
    return np.sqrt(variance), from_prior / variance


def _bounds_after_loss(candidates: Candidates, chosen: Array) -> Array:
    """Return the bound (P,) of the position error at each place after the worst loss of one site there, metres.

    `chosen` (n,) is 1 for each taken site.
    """
    # Line i of `lost` is the set without its i-th site.
    lost = np.repeat(chosen[None], int(chosen.sum()), axis=0)
    lost[np.arange(len(lost)), np.flatnonzero(chosen)] = 0
    variance = np.trace(covariances(candidates.design, lost), axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(variance.max(0)))


def _bounds_before(candidates: Candidates, task: SearchTask) -> tuple[Array, tuple[str, ...]]:
    """Return the bounds (P,) of the position error before the choice, metres, and the names of their sites.

    The sites are the kept sites, if they determine the position at each place. Otherwise they are the median
    of random sets, so that the user can compare.
    """
    kept = (candidates.state == 1).astype(np.int64)
    if kept.any():
        per_place, share = _bound_and_prior_share(candidates, kept)
        if (share <= PRIOR).all():
            return per_place, _select_names(candidates.names, kept)
    sets = np.array(list(random_sets(task, _RANDOM, candidates.selection.seed)))
    middle = sets[np.argsort(task.score(sets))[len(sets) // 2]]
    return _bound_and_prior_share(candidates, middle)[0], _select_names(candidates.names, middle)


def _redundancy(candidates: Candidates, chosen: Array) -> Array:
    """Return the degrees of freedom (P,) of a fix at each place: rows in sight and given priors minus unknowns.

    `chosen` (n,) is 1 for each taken site. The default priors of the search do not count.
    """
    problem = replace(candidates.assembled(chosen), priors=candidates.selection.problem.priors)
    return np.asarray(degrees_of_freedom(problem))


def _swaps(candidates: Candidates, chosen: Array) -> Iterator[Swap]:
    """Yield the effect of the loss of each taken site, with the best replacement; largest loss first.

    `chosen` (n,) is 1 for each taken site. The replacement of a kept site is one new site more than the search took. So
    only the rules of the groups apply to it: the number of new sites and the budget do not limit it.
    """
    task, names, found = task_of(candidates), candidates.names, []
    rules, limits = candidates.group_rules
    for_kept = replace(task, rules=rules, limits=limits)
    for i in np.flatnonzero(chosen).tolist():
        without = chosen.copy()
        without[i] = 0
        value = task.scale(float(task.score(without[None])[0]))
        tries = np.repeat(without[None], len(chosen), axis=0)
        tries[np.arange(len(chosen)), np.arange(len(chosen))] = 1
        allowed = (for_kept if task.state[i] == 1 else task).fits(tries)
        others = np.flatnonzero((chosen == 0) & (task.state != 0) & allowed).tolist()
        if others:
            values = task.score(tries[others])
            best = int(values.argmin())
            found.append(Swap(names[i], value, names[others[best]], task.scale(float(values[best]))))
        else:
            found.append(Swap(names[i], value, "", value))
    yield from sorted(found, key=lambda swap: -swap.value)


def _next_sites(task: SearchTask, names: Sequence[str], chosen: Array) -> Iterator[tuple[str, float]]:
    """Yield each site that is not taken or forbidden, with the criterion after its addition, m^2; best first.

    The rules are ignored: the list is for a user who can take more sites.
    """
    others = np.flatnonzero((chosen == 0) & (task.state != 0)).tolist()
    if not others:
        return
    tries = np.repeat(chosen[None], len(others), axis=0)
    tries[np.arange(len(others)), others] = 1
    values = task.score(tries)
    yield from ((names[others[i]], task.scale(float(values[i]))) for i in np.argsort(values, kind="stable").tolist())


def drawn(candidates: Candidates, chosen: Array, count: int, seed: int = 0) -> Draws:
    """Return the statistics of fixes from simulated measurements with a set of sites, method "auto".

    `chosen` (n,) is 1 for each taken site, and `count` is the number of simulated fixes at each place. The
    fixes have only the given priors. They show ambiguities that the bound, a local quantity, cannot show.
    """
    from optloc.solvers import solve

    places, d = len(candidates.vectors), candidates.design.dimension
    flat = replace(candidates.assembled(chosen), priors=candidates.selection.problem.priors).flat()
    bounds = _bound_and_prior_share(candidates, chosen)[0]
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
    return Draws(count, ambiguous, ratio, coverage, _thickness_over_bound(candidates, chosen, bounds))


def _thickness_over_bound(candidates: Candidates, chosen: Array, bounds: Array) -> Array:
    """Return the distance of the stations in sight from their best plane, divided by the bound at each place (P,).

    The distance is the smallest singular value of the centred positions, metres; in 2D, it is the distance
    from a line. `bounds` (P,) are the bounds of the position error, metres. A small ratio means an ambiguous
    mirror image.
    """
    stations = candidates.problem.stations.position.reshape(-1, candidates.design.dimension)
    weight = candidates.assembled(chosen).weight
    out = np.empty(len(bounds))
    owner = np.concatenate([rows.a for rows in candidates.problem.rows])
    for p in range(len(bounds)):
        in_sight = stations[np.unique(owner[weight[p] > 0.0])]
        thickness = np.linalg.svd(in_sight - in_sight.mean(0), compute_uv=False)[-1] if len(in_sight) > 1 else 0.0
        out[p] = thickness / bounds[p]
    return out


class PlacementMaps(NamedTuple):
    """Maps of the bound before and after a placement (P places, s candidates).

    - maps: the bound with the stations before, and with the taken stations.
    - taken: two arrays (s,), True for the stations of each map.
    - places (P, 2), weights (P,): places of interest in the coordinates of the maps.
    """

    maps: tuple[BoundMap, BoundMap]
    taken: tuple[Array, Array]
    places: Array
    weights: Array


def maps_of(selection: SiteSelection, found: Placement) -> PlacementMaps:
    """Return the maps of a placement; raise InvalidProblem if the selection takes single rows.

    `selection` was passed to `place`, and `found` is its result.
    """
    problem, names = selection.problem, np.array(selection.problem.stations.names)
    if selection.by == "row":
        raise InvalidProblem("a choice of single rows has no map", "plot", "choose stations")
    single = problem.flat().take(np.zeros(1, dtype=int)) if problem.batch_shape else problem
    places = np.atleast_2d(np.asarray(selection.places, dtype=float))[:, : problem.dimension]
    truth = np.zeros(problem.layout.size)
    truth[: problem.dimension] = places[0]
    flat = map_coordinates(problem.frame, places, problem.frame.geodetic and problem.dimension == 3)
    height = float(np.median(flat[:, 2])) if problem.dimension == 3 else 0.0
    x0, x1, y0, y1 = extent(problem, places, widen=0.08)
    grid = np.linspace(x0, x1, _MAP_POINTS), np.linspace(y0, y1, _MAP_POINTS)
    end = np.concatenate([rows.a for rows in problem.rows])
    before, after = (np.isin(names, sites) for sites in (found.before_sites, (*found.chosen, *found.kept)))
    bound = partial(_bound_with, single, truth, grid, height, end)
    weights = np.ones(len(places)) if selection.weights is None else np.asarray(selection.weights)
    return PlacementMaps((bound(before), bound(after)), (before, after), flat[:, :2], weights)


def _bound_with(
    single: Problem, truth: Array, grid: tuple[Array, Array], height: float, end: Array, mask: Array
) -> BoundMap:
    """Return the map of the bound with the stations of a mask (s,).

    `single` is the problem of all candidates, and `truth` are its unknowns at one place. `grid` are the grid lines in
    x and y. `height` is the height of the map, m. `end` (m,) are the stations of the rows.
    """
    return bound_map(single.with_rows(weight=single.weight * mask[end]), truth, *grid, height)


def picture(selection: SiteSelection, found: Placement) -> Figure:
    """Return a figure: maps of the bound before and after on one scale, and the loss of each station.

    Parameters
    ----------
    selection : SiteSelection
        The selection that was passed to `place`.
    found : Placement
        The result of `place`.

    Raises
    ------
    InvalidProblem
        If the selection takes single rows: these have no map.
    """
    from optloc.sites.placement.placement_map import plot_placement

    made = maps_of(selection, found)
    kept = set(found.before_sites) == set(found.kept)
    titles = (
        "before: kept stations" if kept else "before: a random set",
        f"after: {found.sigma:.3g} m{', one failed' * selection.fail_one}",
    )
    return plot_placement(*made, losses_of(found), found.sigma, titles)


def losses_of(found: Placement) -> list[StationLoss]:
    """Return the loss of each taken station as standard deviations, largest first."""
    from optloc.sites.placement.placement_map import StationLoss

    root = [np.sqrt(np.maximum([one.value, one.replaced], 0.0)).tolist() for one in found.swaps]
    return [StationLoss(one.name, a, one.replacement, b) for one, (a, b) in zip(found.swaps, root, strict=True)]
