"""Table of the optimisation problems behind starts and bounds: their kinds, starts, bounds and sources."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from optloc.base.registry import Registry
from optloc.base.types import Array
from optloc.linear.mirror import one_position
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.solvers.certificates.relaxations import Reference, reference_bound
from optloc.solvers.posing.convex_statement import ConicStatement, Locate
from optloc.solvers.posing.gross_errors import pose_sparse
from optloc.solvers.posing.moving_stations import pose_doppler, pose_registration
from optloc.solvers.posing.programs import pose_program, pose_pulses
from optloc.solvers.posing.range_moments import pose_heights, pose_lifted, pose_moments
from optloc.solvers.posing.sight_lines import pose_directions, pose_minimax
from optloc.solvers.posing.squared_ranges import pose_hull, pose_shor
from optloc.solvers.scaled_program import ScaledProblem
from optloc.solvers.starts.angles import Bearings, bearings, by_directions, instrumental, least_worst
from optloc.solvers.starts.doppler import doppler_starts, has_doppler_of_rest
from optloc.solvers.starts.position import height_starts, is_registration_run, over_ground, squared_range_starts
from optloc.solvers.starts.registration import closed_form, run_starts
from optloc.solvers.starts.registration_windows import relax_run
from optloc.solvers.starts.squared_range import hull, minimum, shor, stationary_points


@dataclass(frozen=True, slots=True)
class Formulation:
    """An optimisation problem of the package `formulations`, and how optloc uses it.

    Parameters
    ----------
    summary : str
        What it minimises.
    kinds : str
        Measurement kinds it supports.
    tight : str
        How good its answer is.
    cost : str
        Typical time for one fix.
    source : str
        Publication.
    serves : callable
        Maps a flat batch of problems to True if `starts` supports them; by default problems of one position.
    starts : dict of str to callable
        For each word of a method a callable that maps a flat batch of N problems to candidates; NaN in empty slots. For
        one static target without other unknowns the candidates are positions (N, q, d), metres, else full vectors (N,
        q, size). Several formulations may have the same word: the stage takes the candidates of all that support the
        problem.
    bound : callable, optional
        Maps a flat batch of problems and their fixes to lower bounds of the maximum-likelihood cost.
    words : tuple of str
        Other words of a method that use the formulation.
    needs : callable
        Maps problems without a start from this formulation to the missing input, as a sentence without its subject,
        such as "starts from azimuths". It returns "" if no input is known to be missing.
    """

    summary: str
    kinds: str
    tight: str
    cost: str
    source: str
    serves: Callable[[Problem], bool] = one_position
    starts: Mapping[str, Callable[[Problem], Array]] = field(default_factory=dict)
    bound: Callable[[Problem, Fix], Reference] | None = None
    words: tuple[str, ...] = ()
    needs: Callable[[Problem], str] = lambda problem: ""
    pose: Callable[[Problem, Locate], ConicStatement | ScaledProblem] | None = None
    twin: str = ""


def _from_bearings(locate: Callable[[Bearings], Array]) -> Callable[[Problem], Array]:
    """Return a start for problems from a function of their bearings; the start is NaN without azimuths."""

    def start(problem: Problem) -> Array:
        # NaN without azimuths: other formulations may start the rows
        seen = bearings(problem)
        nowhere = np.full((problem.batch_shape[0], 1, problem.dimension), np.nan)
        return nowhere if seen is None else locate(seen)

    return start


def _needs_sight(problem: Problem) -> str:
    """Return the missing input, as of `Formulation.needs`, if no azimuth is measured; else ""."""
    kinds = dict.fromkeys(rows.kind for rows in problem.rows)
    return "" if "azimuth" in kinds else f"starts from azimuths, and these rows are {' and '.join(kinds)}"


def _needs_bearings(problem: Problem) -> str:
    """Return the missing input as text, as of `Formulation.needs`; "" if two lines of sight are measured.

    A line of sight is an azimuth, in space with an elevation, of one station at one epoch.
    """
    wanted = ("azimuth", "elevation")[: problem.dimension - 1]
    seen = [
        {
            (int(a), int(epoch))
            for rows in problem.rows
            if rows.kind == kind
            for a, epoch in zip(rows.a, rows.epoch, strict=True)
        }
        for kind in wanted
    ]
    if len(set.intersection(*seen)) > 1:
        return ""
    kinds = dict.fromkeys(rows.kind for rows in problem.rows)
    return f"starts from {' and '.join(wanted)} of two stations or more, and these rows are {' and '.join(kinds)}"


def _needs_directions(problem: Problem) -> str:
    """Return the missing input, as of `Formulation.needs`, for a problem in a plane or incomplete bearings; else ""."""
    plane = problem.dimension == 2
    return (
        "relaxes directions in three dimensions, and these rows are in a plane" if plane else _needs_bearings(problem)
    )


# both are refined on block averages and differ in their starts
_start_run, _start_relaxed_run = partial(run_starts, begin=closed_form), partial(run_starts, begin=relax_run)

_RANGES = "range, toa, tdoa, range_sum; azimuth, elevation and groa rows linear in (x, r)"

_PROGRAMS: dict[str, Formulation] = {
    "squared_range": Formulation(
        "squared-range least squares with one quadratic constraint (GTRS), all stationary points",
        _RANGES,
        "exact for its own cost; second weighting close to maximum likelihood",
        "2 us the minimiser, 12 us all points",
        "More 1993; Beck, Stoica, Li 2008",
        starts={
            "gtrs": partial(squared_range_starts, pick=minimum),
            "roots": partial(squared_range_starts, pick=stationary_points),
        },
        twin="squared_range_conic: shor",
    ),
    "squared_range_conic: shor": Formulation(
        "semidefinite twin of the same problem",
        _RANGES,
        "rank one, equal to the GTRS",
        "0.5 ms",
        "Shor 1987",
        starts={"sdp": partial(squared_range_starts, pick=shor)},
        pose=pose_shor,
    ),
    "squared_range_conic: hull": Formulation(
        "second-order cone relaxation |x| <= r of the same problem",
        _RANGES,
        "a lower bound; tight if the linear fit violates |x| <= r, about half of all TDOA cases",
        "0.2 ms",
        "convex hull of the cone",
        starts={"socp": partial(squared_range_starts, pick=hull)},
        pose=pose_hull,
    ),
    "sparse_errors": Formulation(
        "linear rows with a few gross errors, whose sizes are penalised, on the cones of the ranges",
        _RANGES,
        "convex, not exact: a start and a guess of the wrong rows; from about 20 stations both are good",
        "1 ms",
        "Donoho, Johnstone 1994; Yuan, Lin 2006; She, Owen 2011",
        words=("sparse",),
        pose=pose_sparse,
    ),
    "range_height": Formulation(
        "ranges with one common unknown, on an ellipsoid: a quartic, with horizon",
        "tdoa, toa, range_sum with a known height",
        "exact: all points that fit",
        "0.1 ms",
        "Ho, Chan 1997, exact for the ellipsoid",
        serves=over_ground,
        starts={"gtrs": height_starts, "roots": height_starts, "socp": height_starts},
        twin="range_height_conic",
    ),
    "range_height_conic": Formulation(
        "3 x 3 lift after elimination of the range differences, nearest to the subsatellite point",
        "two differences and a height",
        "rank one within 25 degrees of the subsatellite point",
        "1 ms",
        "Shor 1987",
        serves=over_ground,
        starts={"sdp": partial(height_starts, relax=True)},
        pose=pose_heights,
    ),
    "bearing_ls": Formulation(
        "pseudo-linear least squares of angles, weighted, with an instrumental-variable pass",
        "azimuth, elevation",
        "asymptotically unbiased; as good as maximum likelihood to 0.1 %",
        "30 us",
        "Dogancay 2006, 2015",
        starts={"wiv": _from_bearings(instrumental)},
        needs=_needs_sight,
        twin="direction_sdp",
    ),
    "bearing_course": Formulation(
        "the same for a target on a polynomial course, over all epochs; one turning station may be enough",
        "azimuth, elevation of a moving target",
        "asymptotically unbiased; as good as maximum likelihood to 0.1 %",
        "0.5 ms for 100 angles",
        "Dogancay 2006, 2015",
        words=("gtrs", "roots", "wiv"),
        twin="nls",
    ),
    "direction_sdp": Formulation(
        "lifted unit directions that meet in a point; with a minorant a lower bound of the angular cost",
        "azimuth and elevation",
        "100 % to 20 mrad, 98 % at 50 mrad",
        "2 ms two stations, 10 ms four",
        "epipolar equalities; Shor 1987",
        starts={"directions": _from_bearings(by_directions)},
        bound=partial(reference_bound, method="directions"),
        words=("bound",),
        needs=_needs_directions,
        pose=pose_directions,
    ),
    "moment_sdp": Formulation(
        "order-2 moments of position and range errors in a box: a lower bound of the maximum-likelihood cost",
        "range, toa, tdoa, range_sum",
        "89-100 % to 30 m",
        "50 ms five stations, 100 ms six",
        "Lasserre 2001",
        bound=partial(reference_bound, method="moment"),
        words=("bound",),
        pose=pose_moments,
    ),
    "minimax_cone": Formulation(
        "smallest maximal angle, by bisection over second-order cones; proves contradictions of bounds",
        "azimuth, elevation with bounded errors",
        "exact for its own cost",
        "10 ms",
        "Kahl, Hartley 2008",
        starts={"minimax": _from_bearings(least_worst)},
        needs=_needs_bearings,
        pose=pose_minimax,
    ),
    "bistatic": Formulation(
        "closed-form range of one receiver and one illuminator; polynomial course of several epochs",
        "range_sum with azimuth and elevation",
        "exact without noise",
        "50 us",
        "Skolnik 1961",
        words=("gtrs", "roots"),
        twin="nls",
    ),
    "registration": Formulation(
        "position, course and biases of a run: reference ranges projected out, then linked to the lifted course",
        "tdoa, toa, range_sum of moving stations or a moving target",
        "exact without noise; with noise a start near the bound",
        "0.3 ms",
        "Chan, Ho 1994; Beck, Stoica, Li 2008",
        serves=is_registration_run,
        starts={"gtrs": _start_run, "roots": _start_run, "socp": _start_run},
        twin="registration_sdp",
    ),
    "registration_sdp": Formulation(
        "the same, lifted with its reference ranges; penalty on the trace, prior on the biases",
        "tdoa, toa of moving stations",
        "never tight: a start",
        "0.5 s",
        "Shor 1987",
        serves=is_registration_run,
        starts={"sdp": _start_relaxed_run},
        pose=pose_registration,
    ),
    "doppler_sdp": Formulation(
        "position, ranges, unknown rates and their products, lifted; weighted by the ranges of the pass before",
        "range_rate, fdoa of a source at rest, with tdoa, range, range_sum and a known height",
        "never tight: a start, rarely the only minimum; many rows are averaged to normal points",
        "10 ms four stations, 0.1 s a pass of a satellite",
        "Song et al. 2025; Wang, Li, Ansari 2013",
        serves=has_doppler_of_rest,
        starts={"sdp": doppler_starts},
        pose=pose_doppler,
    ),
    "lifted": Formulation(
        "order-1 lift [1, x, r]: a baseline for studies, never a default",
        "tdoa, range",
        "never for tdoa: its optimum is zero for any data",
        "2 ms",
        "Shor 1987",
        pose=pose_lifted,
    ),
    "nuclear_norm": Formulation(
        "times of emission whose centred squared arrivals have the least nuclear norm, then the least truncated one: a "
        "baseline for studies, never a default",
        "toa of stations and pulses at unknown positions, none missing, one clock",
        "never with the nuclear norm alone; truncated, it is exact without noise if its passes converge",
        "0.5 s for 12 stations and 20 pulses",
        "Fazel 2002; Jiang, Kuang, Astrom 2013",
        pose=pose_pulses,
    ),
    "nls": Formulation(
        "weighted nonlinear least squares with bounds, equalities and inequalities (IPOPT)",
        "all",
        "a local minimum",
        "2 ms",
        "Waechter, Biegler 2006",
        words=("nlp",),
        pose=pose_program,
    ),
}

FORMULATIONS: Registry[Formulation] = Registry(
    "optloc.formulations", lambda value: isinstance(value, Formulation), _PROGRAMS
)
"""Formulations by name. A new one needs one file and one entry, or an entry point of ``optloc.formulations`` in another
package.
"""
