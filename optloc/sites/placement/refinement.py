"""Continuous refinement of a placement: the new sites move inside their regions to reduce the bound.

Letters: P places, k moving sites, n sites, d coordinates, m unknowns of the target.

Arguments of many functions: `candidates` are the sites as arrays, and `places` are positions of the
moving sites, metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from formulations.backend import SolverError
from formulations.placement import PlacementGround, PlacementRegion, refine, value
from optloc.models import MODELS, Point
from optloc.problem import Array, InvalidProblem
from optloc.sites.placement.best_set import exchanged, random_sets
from optloc.sites.placement.chosen import Placement, task_of
from optloc.sites.placement.sites import LETTER, Candidates, SiteSelection, candidates_of

# Random sets that are refined in addition to the chosen set: in three trials they lowered the best value by 7,
# 16 and 1 %.
_STARTS = 10
# Rounding error of the edges of a region, metres.
_EDGE = 1e-6


def refined(
    selection: SiteSelection,
    found: Placement,
    regions: Sequence[PlacementRegion],
    ground: PlacementGround | None = None,
    *,
    starts: int = _STARTS,
) -> Placement:
    """Return the placement with refined positions of its new sites; the kept sites do not move.

    Each site stays in its convex region; a site outside all regions starts in the nearest region. The refinement
    does not update the sight between sites and places. The result is a local optimum. It is never worse than the
    start sets after their move into the regions. The best start may be another set than the chosen one, so the
    refined positions have no site names.

    Parameters
    ----------
    selection : SiteSelection
        The selection that was passed to `place`.
    found : Placement
        The result of `place`.
    regions : sequence of PlacementRegion
        Convex regions that stations can move in.
    ground : PlacementGround, optional
        Terrain; with it, the heights of the regions are heights above the ground.
    starts : int
        Number of random sets that are refined too.

    Raises
    ------
    InvalidProblem
        If rows depend on more than distance and direction to a target at rest, or if no set fits into the
        regions.
    """
    candidates = candidates_of(selection)
    _check_refinable(candidates)
    task, free = task_of(candidates), candidates.state != 1
    taken = np.isin(candidates.names, (*found.chosen, *found.kept)).astype(np.int64)
    # The refinement is local, so random sets give it other starts.
    sets = [taken, *(exchanged(task, one)[1] for one in random_sets(task, starts, selection.seed))]
    best: tuple[float, Array | None] = (np.inf, None)
    position = candidates.problem.stations.position.reshape(-1, candidates.design.dimension)
    owner = _station_of_site(candidates)
    for chosen in sets:
        # Only the new sites move. Each of them starts at the nearest position inside a region and stays in this region.
        sites = np.flatnonzero((chosen == 1) & free)
        start = position[owner[sites]]
        homes = [_nearest_region(place, regions, ground) for place in start]
        begin = np.array([home[1] for home in homes])
        parts = [home[0] for home in homes]
        for places in _local_optima(candidates, sites, begin, parts, ground):
            reached = _criterion_at(candidates, sites, places)
            if reached < best[0]:
                best = reached, places
    if best[1] is None:
        raise InvalidProblem("no set of stations fits into the regions", "refine", "give larger regions")
    return replace(found, refined=best[1], refined_value=task.scale(best[0]))


def _local_optima(
    candidates: Candidates, sites: Array, begin: Array, parts: Sequence[PlacementRegion], ground: PlacementGround | None
) -> list[Array]:
    """Return the start and, if the refinement ends inside the regions, the local optimum; each (k, d), metres.

    `sites` (k,) are the numbers of the moving sites, and `begin` (k, d) are their start positions. `parts`
    are the regions of the sites, and `ground` is the terrain.
    """
    selection, out = candidates.selection, [begin]
    try:
        places = refine(
            lambda symbols: _information(candidates, sites, symbols),
            begin,
            parts,
            candidates.design.weight,
            candidates.design.dimension,
            LETTER[selection.criterion],
            worst=selection.worst,
            fail=selection.fail_one,
            ground=ground,
        )
    except SolverError:
        return out
    if np.isfinite(places).all() and all(
        _inside(place, part, ground) for place, part in zip(places, parts, strict=True)
    ):
        out.append(places)
    return out


def _check_refinable(candidates: Candidates) -> None:
    """Raise if the rows of the candidates do not allow a refinement.

    The refinement needs rows of stations that depend on positions only, with independent noise.
    """
    kinds = {rows.kind for rows in candidates.problem.rows}
    odd = [kind for kind in kinds if MODELS[kind].velocity or MODELS[kind].ecef]
    if odd or candidates.selection.by == "row" or any(len(b.row[0]) > 1 for b in candidates.problem.noise.blocks):
        what = f"{odd[0]} rows" if odd else "single rows or rows with common noise"
        raise InvalidProblem(f"{what} cannot be refined", "refine", "remove the refinement")


def _station_of_site(candidates: Candidates) -> Array:
    """Return the index (n,) of the station of each site."""
    return np.unique(np.concatenate([rows.a for rows in candidates.problem.rows]))


def _nearest_region(
    place: Array, regions: Sequence[PlacementRegion], ground: PlacementGround | None
) -> tuple[PlacementRegion, Array]:
    """Return the nearest region of a position (d,), and the nearest position inside this region (d,), metres."""
    moved = [(region, region.nearest(place, ground)) for region in regions]
    return min(moved, key=lambda pair: float(np.linalg.norm(pair[1] - place)))


def _inside(place: Array, region: PlacementRegion, ground: PlacementGround | None) -> bool:
    """Return whether a position (d,), metres, is inside a region, up to rounding."""
    return bool((region.excess(place, ground) <= _EDGE).all())


def _criterion_at(candidates: Candidates, sites: Array, places: Array) -> float:
    """Return the criterion with the new sites at positions (k, d), metres; the rows are linearised there.

    `sites` (k,) are the numbers of the new sites. The unit is m^2, except for "volume": log det of the
    covariance.
    """
    selection, stations = candidates.selection, candidates.selection.problem.stations
    position = np.array(stations.position)
    position[..., _station_of_site(candidates)[sites], :] = places
    moved = replace(selection, problem=replace(selection.problem, stations=replace(stations, position=position)))
    # Use the priors of the original candidates: default priors depend on the positions of the sites.
    moved = replace(moved, problem=replace(moved.problem, priors=candidates.problem.priors))
    relinearised = candidates_of(moved)
    chosen = (candidates.state == 1).astype(float)
    chosen[sites] = 1.0
    return float(
        value(relinearised.design, chosen, LETTER[selection.criterion], worst=selection.worst, fail=selection.fail_one)
    )


def _information(candidates: Candidates, sites: Array, symbols: Sequence[Any]) -> list[Any]:
    """Return the information (m, m) at each place as CasADi expressions, for the optimiser of the refinement.

    Prior and kept sites are numbers. `symbols` are the positions of the moving sites `sites` (k,); None omits
    a site, for instance after its failure.
    """
    import casadi as ca

    # t is the position of the target, and a is the position of the station. Rows with the same kind, axes and second
    # station share one function of t and a.
    design, d = candidates.design, candidates.design.dimension
    kept = (candidates.state == 1).astype(float)
    base = design.prior + np.einsum("prmn,n,prkn->pmk", design.rows, kept, design.rows)
    totals = [ca.SX(ca.DM(matrix)) for matrix in base]
    t, a = ca.SX.sym("t", d), ca.SX.sym("a", d)
    slopes: dict[tuple[str, bytes, bytes], Any] = {}
    for row in _site_rows(candidates):
        at = np.flatnonzero(sites == row.site)
        if not len(at) or symbols[at[0]] is None:
            continue
        key = (row.kind, row.axes.tobytes(), row.other.tobytes())
        if key not in slopes:
            slopes[key] = ca.Function("slope", [t, a], [ca.jacobian(row.h(ca, t, a), t)])
        for p, place in enumerate(candidates.vectors[:, :d]):
            if row.scale[p] > 0.0:
                slope = slopes[key](ca.DM(place), symbols[at[0]])
                line = ca.horzcat(slope * row.scale[p], ca.DM(row.rest[p][None]))
                totals[p] += ca.mtimes(line.T, line)
    return totals


class _Row:
    """A row of a site: its kind, its second station, and the parts that do not depend on the position of the site.

    `kind` is the kind of measurement, and `site` is the number of the site. `scale` (P,) are the whitening
    factors at each place, 0 out of sight. `rest` (P, m - d) are the whitened derivatives by the unknowns
    other than the position. `axes` (d, d) are the axes of the station, and `other` (d,) is the position of
    the second station; both are empty without them.
    """

    def __init__(self, candidates: Candidates, kind: str, site: int, a: int, b: int, scale: Array, rest: Array) -> None:
        """Store the row of a site; `a` and `b` are the numbers of its stations (b < 0: no second station)."""
        stations, d = candidates.problem.stations, candidates.design.dimension
        self.kind, self.site, self.scale, self.rest = kind, site, scale, rest
        axes = stations.axes
        self.axes = np.zeros(0) if axes is None else axes.reshape(-1, stations.count, d, d)[0, a]
        self.other = np.zeros(0) if b < 0 else stations.position.reshape(-1, stations.count, d)[0, b]

    def h(self, ca: Any, t: Any, a: Any) -> Any:
        """Return the measurement of a target at t by a station at a, as an expression of the CasADi symbols t and a."""
        axes = tuple(tuple(float(v) for v in line) for line in np.atleast_2d(self.axes)) if self.axes.size else None
        station = Point(tuple(ca.vertsplit(a)), axes=axes)
        other = Point(tuple(map(float, self.other))) if self.other.size else station
        return MODELS[self.kind].h(Point(tuple(ca.vertsplit(t))), station, other)


def _site_rows(candidates: Candidates) -> list[_Row]:
    """Return the rows of all sites, with whitening factors and derivatives by the unknowns other than the position.

    They are computed once at the original positions of the sites, because they do not change during the
    refinement.
    """
    from optloc.engine import linearise

    linear, d = linearise(candidates.problem, candidates.vectors), candidates.design.dimension
    jacobian = np.concatenate([linear.shared, linear.local], axis=-1)
    places = len(candidates.vectors)
    scale = np.zeros((places, candidates.problem.count))
    for whitener in linear.noise:
        scale[:, whitener.row[:, 0]] = np.broadcast_to(whitener.matrix[..., 0, 0], (places, len(whitener.row)))
    out = []
    for block, start in zip(candidates.problem.rows, candidates.problem.starts, strict=True):
        for i in range(block.count):
            g = start + i
            rest = np.broadcast_to(jacobian[:, g, d:], (places, jacobian.shape[-1] - d)) * scale[:, g, None]
            ends = int(block.a[i]), int(block.b[i])
            out.append(_Row(candidates, block.kind, int(candidates.site[g]), *ends, scale[:, g], rest))
    return out
