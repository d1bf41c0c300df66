"""The definition of a site selection, and its rows, rules and priors as arrays.

A site is a possible position of a station. A place is a possible position of the target. `candidates_of`
linearises the rows of all sites at all places, so that the search (`optloc.sites.placement.best_set`) needs
no measurement model.

Letters: P places, n sites, s stations, d coordinates. m is the number of rows of the problem; in arrays
with a last axis of sites, and in (P, m, m), m is the number of unknowns of the target.

Arguments of many functions: `problem` has the rows of all sites, `names` are the names of the sites, and
`vectors` are the unknowns of the target at each place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from formulations.placement import Criterion, Design
from optloc.engine import Normal, linearise, with_priors
from optloc.models import MODELS
from optloc.problem import Array, InvalidProblem, Prior, Problem, as_arrivals, emission_name, nearest, variances
from optloc.sites.placement.counts import CountGroup, check_groups

Name = Literal["rms", "volume", "axis"]
"""Criteria: mean-square error, volume and longest axis of the error ellipsoid."""

__all__ = ["LETTER", "Candidates", "CountGroup", "Name", "SiteSelection", "candidates_of"]

LETTER: dict[str, Criterion] = {"rms": "A", "volume": "D", "axis": "E"}
"""Letter of each criterion in the literature."""

# Least distance of a site and a place, metres: closer, the direction between them has no meaning.
_SAME = 1e-3
# Share of the mean variance below which the variance of an arrival is artificial: `as_arrivals` gives an exact
# arrival 1e-6.
_EXACT = 1e-5
# Standard deviation of the emission time, in half extents of the area: so wide that any arrival is far more
# precise.
_EMISSION = 10.0
# Smallest half extent of the area that becomes a prior, metres: a single place has no extent.
_EXTENT = 1.0


@dataclass(frozen=True, slots=True)
class SiteSelection:
    """A site selection: candidate sites, places of the target, rules and criterion.

    Parameters
    ----------
    problem : Problem
        One epoch with one target, at rest or with a velocity. Each station that measures is a site and has the
        rows that it would add. The measured values are not used. The priors describe the target before any site
        measures; the default prior of the position covers the area of sites and places.
    places : array (p, d), or (p, n)
        Possible positions of the target, metres; for states with a velocity, whole parameter vectors.
    weights : array (p,), optional
        Positive weight of each place in the mean; equal by default.
    choose : int, optional
        Number of sites to take in addition to the kept sites; with a budget, the largest number.
    budget : float, optional
        Largest total cost of the new sites; kept sites are free.
    cost : array (s,), optional
        Cost of each station, not negative.
    kept, forbidden : tuple of str
        Sites that are always taken, and sites that are never taken.
    groups : tuple of CountGroup
        Further rules.
    criterion : "rms", "volume" or "axis"
        Mean-square error (A), determinant (D) or largest eigenvalue (E) of the covariance of the position.
    worst : bool
        Whether the criterion is the maximum over the places, instead of the weighted mean.
    fail_one : bool
        Whether the criterion is the value after the worst loss of one site.
    sight : array (p, s), optional
        Factor, 1 or more, on the standard deviations of a station's rows at a place; 0 if the place is out of
        sight.
    reach : array (m,), optional
        Largest distance to the target at which a row is measured, metres.
    gap : float
        Relative gap between value and bound at which the search stops.
    seconds : float
        Time limit of the search, seconds.
    alternatives : int
        Number of best sets in the result.
    by : "station" or "row"
        Whether the selection takes whole stations or single rows.
    names : tuple of p str
        Names of the places.
    seed : int
        Seed of the random sets.
    """

    problem: Problem
    places: Array
    weights: Array | None = None
    choose: int | None = None
    budget: float | None = None
    cost: Array | None = None
    kept: tuple[str, ...] = ()
    forbidden: tuple[str, ...] = ()
    groups: tuple[CountGroup, ...] = ()
    criterion: Name = "rms"
    worst: bool = False
    fail_one: bool = False
    sight: Array | None = None
    reach: Array | None = None
    gap: float = 0.01
    seconds: float = 60.0
    alternatives: int = 5
    by: Literal["station", "row"] = "station"
    names: tuple[str, ...] = ()
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Candidates:
    """The candidate sites of a selection as arrays: rows at each place, rules and states (P places, n sites, m rows).

    Parameters
    ----------
    selection : SiteSelection
        The selection as given.
    problem : Problem
        A batch of P problems, one for each place, with the rows of all sites and with priors. Rows out of sight
        have weight 0.
    vectors : array (P, size)
        Parameter vector of the target at each place.
    site : int array (m,)
        Site of each row.
    names : tuple of n str
        Names of the sites.
    design : Design
        Whitened rows and prior information at each place.
    rules, limits : array (R, n), (R,)
        Linear rules rules @ w <= limits for a set w (n,) of 0 and 1; the first rule is the count or the cost.
    state : int array (n,)
        -1 for a free site, 0 for a forbidden site, 1 for a kept site.
    """

    selection: SiteSelection
    problem: Problem
    vectors: Array
    site: Array
    names: tuple[str, ...]
    design: Design
    rules: Array
    limits: Array
    state: Array

    @property
    def group_rules(self) -> tuple[Array, Array]:
        """Return the rules and limits of the groups. The other rules are the number and the cost of new sites."""
        count = sum((group.most is not None) + (group.least is not None) for group in self.selection.groups)
        first = len(self.rules) - count
        return self.rules[first:], self.limits[first:]

    def assembled(self, chosen: Array) -> Problem:
        """Return the batch of P problems with the rows of the taken sites, as input of `optloc.crlb`.

        `chosen` (n,) is 1 for each taken site; the rows of other sites get the weight 0.
        """
        taken = np.asarray(chosen, dtype=float)[self.site]
        return self.problem.with_rows(weight=self.problem.weight * taken)


def candidates_of(selection: SiteSelection) -> Candidates:
    """Return the candidate sites of a selection as arrays.

    Raises
    ------
    InvalidProblem
        If an argument, site or place is invalid; the message names it.
    """
    selection = _check_options(selection)
    problem = _as_arrival_times(selection.problem)
    site, names = _sites(problem, selection)
    size, d = problem.layout.size, problem.dimension
    places = np.atleast_2d(np.asarray(selection.places, dtype=float))
    if places.ndim != 2 or places.shape[1] not in (d, size) or not np.isfinite(places).all() or not len(places):
        what = f"the places have shape {np.shape(selection.places)} or contain a number that is not finite"
        raise InvalidProblem(what, "places", f"give finite numbers (places, {d}), metres")
    vectors = np.zeros((len(places), size))
    vectors[:, : places.shape[1]] = places
    _check_apart(problem, site, names, places[:, :d])
    batch = problem.with_rows(weight=_row_weights(selection, problem, places[:, :d]))
    batch = _with_prior(batch, places[:, :d])
    weight = _place_weights(selection, len(places))
    design = Design(_whitened_rows(batch, vectors, site, len(names)), _prior_information(batch, vectors), weight, d)
    rules, limits, state = _rules(selection, names, site)
    candidates = Candidates(selection, batch, vectors, site, names, design, rules, limits, state)
    _check_determined(candidates)
    return candidates


def _check_options(selection: SiteSelection) -> SiteSelection:
    """Return the selection unchanged, or raise if an option is invalid."""
    if selection.criterion not in LETTER:
        what = f"there is no criterion {selection.criterion!r}"
        raise InvalidProblem(what, "criterion", nearest(str(selection.criterion), list(LETTER)))
    if not 0.0 < selection.gap < 1.0:
        raise InvalidProblem(f"the gap {selection.gap:g} is not between 0 and 1", "gap", "give a share, such as 0.01")
    if not selection.seconds > 0.0:
        raise InvalidProblem(f"the time {selection.seconds:g} s is not positive", "time", "give seconds, such as 60")
    if selection.choose is None and selection.budget is None:
        raise InvalidProblem("the number of sites to take is missing", "choose", "give choose, or budget with cost")
    return selection


def _as_arrival_times(problem: Problem) -> Problem:
    """Return the problem with arrival times instead of range differences.

    The information of a difference depends on the other sites of a set; the information of arrival times adds up.
    """
    if problem.epochs != 1 or len(problem.motions) != 1 or problem.motions[0].known is not None:
        what = "a placement needs one target with an unknown position, at one epoch"
        raise InvalidProblem(
            what, "problem", "give a problem with one epoch and one target, and its positions as places"
        )
    pairs = [rows.kind for rows in problem.rows if MODELS[rows.kind].signs == (1, -1)]
    if not pairs:
        return problem
    made = as_arrivals(problem.flat()) if pairs == ["tdoa"] else None
    # The rows of independent pairs are equal to arrivals with one noise-free reference. No station is such a
    # reference.
    if made is None or (variance := variances(made.problem.noise, made.problem.count)).min() < _EXACT * variance.mean():
        what = f"{pairs[0]} rows need pairs of stations, but each set of stations has other pairs"
        raise InvalidProblem(what, "measurements", "give toa rows, or tdoa rows with an arrival_sigma")
    return made.problem.take(np.zeros(1, dtype=int))


def _sites(problem: Problem, selection: SiteSelection) -> tuple[Array, tuple[str, ...]]:
    """Return the site (m,) of each row, and the names (n,) of the sites: stations that measure, or single rows."""
    a, b = (np.concatenate([getattr(rows, end) for rows in problem.rows]) for end in ("a", "b"))
    stations = problem.stations.names
    if (a < 0).any():
        what = "a row without a station cannot belong to a site"
        raise InvalidProblem(what, "measurements", "remove height rows, or use a prior of the position")
    if selection.by == "row":
        kinds = [rows.kind for rows in problem.rows for _ in range(rows.count)]
        named = [f"{kind} {stations[i]}" for kind, i in zip(kinds, a, strict=True)]
        seen = {name: named.count(name) for name in named}
        if max(seen.values()) > 1:
            named = [f"{name} {i + 1}" for i, name in enumerate(named)]
        return np.arange(len(a)), tuple(named)
    measuring = np.unique(a)
    site = np.searchsorted(measuring, a)
    names = tuple(stations[i] for i in measuring)
    lone = set(names) - set(selection.kept)
    for other in np.unique(b[b >= 0]):
        if stations[other] in lone:
            what = f"station {stations[other]!r} is a candidate and also the second station of a row"
            raise InvalidProblem(what, "measurements", "keep this station, or remove the rows that it measures")
    return site, names


def _check_apart(problem: Problem, site: Array, names: Sequence[str], places: Array) -> None:
    """Raise if a place (P, d) is at a station, or if two stations have the same position."""
    stations = problem.stations.position.reshape(-1, problem.dimension)
    apart = np.linalg.norm(places[:, None] - stations[None], axis=-1)
    p, s = np.unravel_index(int(apart.argmin()), apart.shape)
    if apart[p, s] < _SAME:
        what = f"place {p + 1} is at the position of station {problem.stations.names[s]!r}"
        raise InvalidProblem(what, "places", "move the place or the station by more than a millimetre")
    # The first station at each position is valid; the others repeat its position.
    first = np.unique(stations, axis=0, return_index=True)[1]
    repeated = np.setdiff1d(np.arange(len(stations)), first)
    if len(repeated):
        name = problem.stations.names[int(repeated[0])]
        raise InvalidProblem(
            f"station {name!r} has the position of another station", "candidates", "remove one of them"
        )


def _place_weights(selection: SiteSelection, count: int) -> Array:
    """Return the weights (P,) of the places, sum 1; `count` is the number P of places."""
    weight = np.ones(count) if selection.weights is None else np.asarray(selection.weights, dtype=float)
    if weight.shape != (count,) or not (weight > 0.0).all() or not np.isfinite(weight).all():
        what = f"the weights are not {count} positive numbers, one for each place"
        raise InvalidProblem(what, "weights", "give each place a weight above 0, or leave it out")
    return np.asarray(weight / weight.sum())


def _row_weights(selection: SiteSelection, problem: Problem, places: Array) -> Array:
    """Return the weights (P, m) of the rows: 0 out of sight or reach, and smaller where `sight` raises sigma.

    `places` (P, d) are positions of the target, metres.
    """
    count, stations = len(places), problem.stations.count
    weight = np.broadcast_to(problem.weight, (count, problem.count)).copy()
    end = np.concatenate([rows.a for rows in problem.rows])
    if selection.sight is not None:
        sight = np.asarray(selection.sight, dtype=float)
        if sight.shape != (count, stations) or not ((sight == 0.0) | (sight >= 1.0)).all():
            what = f"the sight is not an array of {count} places and {stations} stations with values 0 or at least 1"
            raise InvalidProblem(what, "sight", "give 0 for a station out of sight, otherwise a factor on sigma")
        factor = sight[:, end]
        weight = np.where(factor > 0.0, weight / np.maximum(factor, 1.0) ** 2, 0.0)
    if selection.reach is not None:
        reach = np.asarray(selection.reach, dtype=float)
        if reach.shape != (problem.count,) or not (reach > 0.0).all():
            what = f"the reach is not {problem.count} positive numbers, one for each row"
            raise InvalidProblem(what, "reach", "give each row a distance in metres")
        position = problem.stations.position.reshape(-1, problem.dimension)[end]
        weight[np.linalg.norm(places[:, None] - position, axis=-1) > reach] = 0.0
    return weight


def _with_prior(problem: Problem, places: Array) -> Problem:
    """Return the problem with priors for position and emission time, so that the information is never singular.

    The default sigma of the position is half the extent of sites and places, metres. For the emission time it
    is ten times that length. Unknowns with a given prior keep it. `places` is (P, d).
    """
    known = {prior.name for prior in problem.priors}
    points = np.concatenate([places, problem.stations.position.reshape(-1, problem.dimension)])
    half = max(0.5 * float(np.ptp(points, axis=0).max()), _EXTENT)
    priors = list(problem.priors)
    if "position" not in known:
        priors.append(Prior("position", np.zeros(problem.dimension), half**2 * np.eye(problem.dimension)))
    if problem.emitting and emission_name(0, 1) not in known:
        priors.append(Prior(emission_name(0, 1), np.zeros(1), np.full((1, 1), (_EMISSION * half) ** 2)))
    return replace(problem, priors=tuple(priors))


def _whitened_rows(problem: Problem, vectors: Array, site: Array, count: int) -> Array:
    """Return the whitened rows (P, r, m, n) of each site; sites with fewer than r rows are padded with zeros.

    r is the largest number of rows of a site, m the number of unknowns, and n = `count` the number of sites.
    `vectors` (P, m) are the unknowns at each place, and `site` gives the site of each row. A row is the
    derivative of a measurement by the unknowns, divided by its sigma.
    """
    linear = linearise(problem, vectors)
    jacobian = np.concatenate([linear.shared, linear.local], axis=-1)
    # A whitener covers groups of rows with common noise; each group must belong to one site.
    found: list[list[Array]] = [[] for _ in range(count)]
    for whitener in linear.noise:
        owner = site[whitener.row]
        if (owner != owner[:, :1]).any():
            what = "the noise correlates rows of different sites, so their information does not add up"
            raise InvalidProblem(what, "measurements", "give independent noise to each site")
        white = np.broadcast_to(whitener.apply(jacobian), (len(vectors), whitener.row.size, jacobian.shape[-1]))
        white = white.reshape(len(vectors), *whitener.row.shape, -1)
        for group, one in enumerate(owner[:, 0]):
            found[one] += [white[:, group, i] for i in range(whitener.row.shape[1])]
    out = np.zeros((len(vectors), max(map(len, found)), jacobian.shape[-1], count))
    for i, rows in enumerate(found):
        for q, row in enumerate(rows):
            out[:, q, :, i] = row
    return out


def _prior_information(problem: Problem, vectors: Array) -> Array:
    """Return the prior information (P, m, m) at each place: the inverse covariance of the priors of the m unknowns."""
    n, length, size = problem.layout.n_shared, problem.layout.n_local, len(vectors)
    empty = Normal(
        np.zeros((size, n, n)),
        np.zeros((size, 1, length, length)),
        np.zeros((size, 1, n, length)),
        np.zeros((size, n)),
        np.zeros((size, 1, length)),
        np.zeros(size),
    )
    known = with_priors(problem, vectors, empty)
    out = np.zeros((size, n + length, n + length))
    out[:, :n, :n], out[:, n:, n:] = known.shared, known.local[:, 0]
    if (np.diagonal(out, axis1=1, axis2=2) <= 0.0).any():
        unknown = problem.layout.labels()[int(np.argmin(np.diagonal(out[0])))] if n else "emission"
        what = f"the unknown {unknown!r} has no prior"
        raise InvalidProblem(what, "priors", "give it a prior, which can be wide")
    return out


def _rules(selection: SiteSelection, names: tuple[str, ...], site: Array) -> tuple[Array, Array, Array]:
    """Return rules (R, n), limits (R,) and states (n,) of the sites; a set w is allowed if rules @ w <= limits.

    The rules are the number of sites, the budget and the groups. Only the group rules count the kept sites.
    `names` are the n sites, and `site` gives the site of each row.
    """
    n, index = len(names), {name: i for i, name in enumerate(names)}

    def indices_of(wanted: Sequence[str], argument: str) -> Array:
        """Return the indices (k,) of sites by name; an unknown name is an error in `argument`."""
        for name in wanted:
            if name not in index:
                raise InvalidProblem(f"there is no site {name!r}", argument, nearest(name, list(names)))
        return np.array([index[name] for name in wanted], dtype=int)

    state = np.full(n, -1, dtype=np.int64)
    kept = indices_of(selection.kept, "kept")
    state[indices_of(selection.forbidden, "forbidden")] = 0
    if (state[kept] == 0).any():
        raise InvalidProblem("a site is kept and forbidden", "forbidden", "remove it from one of the two lists")
    state[kept] = 1
    free = (state == -1).astype(float)
    rules, limits = [], []
    if selection.choose is not None:
        if not 1 <= selection.choose <= free.sum():
            what = f"{selection.choose} sites are wanted, but there are {int(free.sum())} candidates"
            raise InvalidProblem(what, "choose", "choose fewer sites, or add candidates")
        rules.append(free + 0.0)
        limits.append(float(selection.choose))
    if selection.budget is not None:
        rules.append(_costs(selection, n, site) * free)
        limits.append(float(selection.budget))
    marks = [
        np.isin(np.arange(n), indices_of(g.members, f"groups, entry {i + 1}")) for i, g in enumerate(selection.groups)
    ]
    inside = np.array(marks, dtype=bool).reshape(-1, n)
    check_groups(selection.groups, inside, names, state, selection.choose)
    if selection.choose is not None and selection.budget is None and selection.groups:
        # Without groups, a full set is always best, so the upper limit is enough. Groups need the exact number as a
        # second rule.
        rules.append(-free)
        limits.append(-float(selection.choose))
    for group, taken in zip(selection.groups, inside, strict=True):
        members = taken.astype(float)
        if group.most is not None:
            rules.append(members)
            limits.append(float(group.most))
        if group.least is not None:
            rules.append(-members)
            limits.append(-float(group.least))
    # Divide each rule by its largest entry: then budgets and counts have the same scale for the interior-point
    # method.
    size = np.array([np.abs(rule).max() or 1.0 for rule in rules])
    return np.array(rules) / size[:, None], np.array(limits) / size, state


def _costs(selection: SiteSelection, n: int, site: Array) -> Array:
    """Return the cost (n,) of each site; `site` gives the site of each row."""
    stations = np.concatenate([rows.a for rows in selection.problem.rows])
    cost = None if selection.cost is None else np.asarray(selection.cost, dtype=float)
    if cost is None or cost.shape != (selection.problem.stations.count,) or not (cost >= 0.0).all():
        what = "a budget needs a cost for each station, and no cost is negative"
        raise InvalidProblem(what, "cost", "give one number for each station")
    if not np.isfinite(cost).all() or not 0.0 <= float(selection.budget or 0.0) < np.inf:
        raise InvalidProblem("a cost or the budget is not a finite number", "budget", "give finite numbers")
    out = np.zeros(n)
    measuring = np.unique(stations) if selection.by == "station" else None
    if measuring is None:
        return np.asarray(cost[stations])
    out[:] = cost[measuring]
    return out


def _check_determined(candidates: Candidates) -> None:
    """Raise if all sites together do not determine the position at a place: then no set of sites has a fix there.

    The prior alone would then set the position, and the criterion would have no meaning.
    """
    in_sight = (candidates.design.rows != 0.0).any(axis=(1, 2)) & (candidates.state != 0)
    rows = candidates.design.rows[..., candidates.state != 0]
    # `flat` (P, n r, m) are all rows of the allowed sites at each place, and `scale` are the prior sigmas.
    places, r, m, n = rows.shape
    flat = np.moveaxis(rows, -1, 1).reshape(places, n * r, m)
    prior = candidates.design.prior
    scale = 1.0 / np.sqrt(np.diagonal(prior, axis1=1, axis2=2))
    for p in range(places):
        # Scale each direction by the prior: if the rows determine it no better than the prior does, it is open.
        singular = np.linalg.svd(flat[p] * scale[p], compute_uv=False)
        known = int((singular > 1.0).sum())
        if known < m:
            name = candidates.selection.names[p] if candidates.selection.names else str(p + 1)
            what = f"place {name!r} is in sight of {int(in_sight[p].sum())} sites, which do not determine its position"
            raise InvalidProblem(what, "places", "add candidates in sight of this place, or remove it")
