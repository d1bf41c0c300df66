"""Proofs of fixes in a steady wind: a linear map of the positions gives an equal problem with straight rays at rest.

Let r point from target to station. Let c be the wave speed, w the wind, m = w / c and q = 1 - m'm.
`optloc.models.wind` gives the travel time times c:

    f = (sqrt((m'r)^2 + q r'r) - m'r) / q = |L r| - k'r;

k is m / q, and L is symmetric with L L = (m m' + q I) / q^2.

In the coordinates y = L x, the first term is a range. The second term is a constant of the station and a linear
function of the position. Differences of arrivals do not contain the linear function. For arrival times, it is a part of
the unknown emission time. So every position has the same cost in both problems, and a claim about one is valid for the
other. Ranges keep the linear function, so the map is not for them.

Letters: N problems, d coordinates, `size` numbers of a parameter vector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from optloc.base.frames import CARTESIAN
from optloc.base.records import overwrite, take
from optloc.base.types import Array, Band, Rows
from optloc.linear.normal import prior_parts
from optloc.models import MODELS
from optloc.models.medium import Wind
from optloc.problem.claims import Claims
from optloc.problem.fix import Fix
from optloc.problem.forms import form_of
from optloc.problem.problem import Problem
from optloc.solvers.certificates.branch_and_bound import (
    certify_stage,
    claim_sentence,
    claims_before,
    count_listed,
    fixes_to_prove,
    keep_evidence,
)
from optloc.solvers.certificates.mapped_claims import claims_so_far, drop_lost, improved
from optloc.solvers.pool import Pool, offer
from optloc.solvers.stages import lsr
from optloc.solvers.verdict.judge import judge

Prove = Callable[[Problem, Pool, Array | None, float, float], Pool]

# Kinds at rest whose rows contain no linear function of the position.
_KINDS = ("toa", "tdoa")


@dataclass(frozen=True, slots=True)
class StillProblem:
    """A problem in a medium at rest with the same costs as a problem in a wind, in the coordinates y = L x.

    Parameters
    ----------
    problem : Problem
        The problem at rest.
    stretch : array (d, d)
        The symmetric matrix L.
    drift : array (d,)
        The vector k, by which the emission time depends on the position: its change is k'x, metres.
    """

    problem: Problem
    stretch: Array
    drift: Array

    def at_rest(self, x: Array) -> Array:
        """Return the parameter vectors (..., size) of the problem at rest for vectors in the wind."""
        return self._mapped(x, self.stretch, 1.0)

    def in_wind(self, x: Array) -> Array:
        """Return the parameter vectors (..., size) in the wind for vectors of the problem at rest."""
        return self._mapped(x, np.linalg.inv(self.stretch), -1.0)

    def _mapped(self, x: Array, matrix: Array, sign: float) -> Array:
        """Return vectors (..., size) with positions mapped by a matrix, and with the emission times that follow."""
        layout, out = self.problem.layout, np.array(x)
        slot, _ = layout.find("position")
        place = x[..., slot.start : slot.start + slot.size]
        out[..., slot.start : slot.start + slot.size] = place @ matrix
        in_the_wind = place if sign > 0.0 else place @ matrix
        change = sign * in_the_wind @ self.drift
        for each in layout.local:
            if each.name == "emission":
                first = layout.n_shared + each.start
                out[..., first :: layout.n_local] += change[..., None]
        return out

    def around(self, corners: Array) -> Array:
        """Return the corners (2, d) of a box at rest that contains a box in the wind, given by its corners (2, d)."""
        middle, half = corners.mean(0), np.ptp(corners, axis=0) / 2.0
        centre, reach = middle @ self.stretch, half @ np.abs(self.stretch)
        return np.stack([centre - reach, centre + reach])

    def inside(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Return the corners of a box in the wind inside a box at rest, given by its corners; each is (d,)."""
        middle, half = (lower + upper) / 2.0, (upper - lower) / 2.0
        centre, shape = np.linalg.solve(self.stretch, middle), half / np.diag(self.stretch)
        reach = shape * (half / (shape @ np.abs(self.stretch))).min()
        return centre - reach, centre + reach


def problem_at_rest(problem: Problem) -> StillProblem | None:
    """Return the problem at rest with the costs of a flat batch of problems in a wind; None for other problems.

    The map is for arrival times and their differences from a target that does not move, with exact stations. Known
    planes are constraints of both problems; a map changes the shape of other constraints.
    """
    medium = problem.medium
    if not isinstance(medium, Wind) or not _fits(problem):
        return None
    d = problem.dimension
    share = np.array([*medium.velocity, 0.0][:d]) / medium.speed
    rest = 1.0 - float(share @ share)
    # L has the eigenvalue 1 / q along the wind, and 1 / sqrt(q) across it
    strength = float(np.linalg.norm(share))
    axis = share / strength if strength > 0.0 else share
    stretch = (np.sqrt(rest) * np.eye(d) + (1.0 - np.sqrt(rest)) * np.outer(axis, axis)) / rest
    drift = share / rest
    position = problem.stations.position
    still = replace(
        problem,
        stations=replace(problem.stations, position=position @ stretch),
        rows=tuple(_at_rest(rows, position, drift) for rows in problem.rows),
        constraints=tuple(_plane_at_rest(band, np.linalg.inv(stretch)) for band in problem.constraints),
        # the Earth has another shape in these coordinates, so nothing is hidden behind it
        frame=CARTESIAN,
        medium=None,
    )
    return StillProblem(still, stretch, drift)


def _fits(problem: Problem) -> bool:
    """Return whether the map is for the rows, the unknowns and the constraints of a problem in a wind."""
    motions, stations = problem.motions, problem.stations
    if len(motions) != 1 or motions[0].order or motions[0].known is not None or problem.fences:
        return False
    if not problem.layout.shares("position") or stations.covariance is not None:
        return False
    biases = {bias.name for bias in problem.biases}
    return (
        all(MODELS[rows.kind].straight in _KINDS for rows in problem.rows)
        and all(form_of(bias).enters == "adds" for bias in problem.biases)
        and all(name in biases for name, _, _ in prior_parts(problem))
        and all(isinstance(band, Band) and band.kind == "plane" and not band.along for band in problem.constraints)
    )


def _at_rest(rows: Rows, position: Array, drift: Array) -> Rows:
    """Return rows as straight ranges at rest: the constants of the stations become known corrections.

    `position` (..., k or 1, s, d) are the stations in the wind.
    """
    kind = MODELS[rows.kind].straight
    assert kind is not None
    epoch = rows.epoch if position.shape[-3] > 1 else np.zeros_like(rows.epoch)
    constant = -(position[..., epoch, rows.a, :] @ drift)
    if kind == "tdoa":
        constant = constant + position[..., epoch, rows.b, :] @ drift
    return replace(rows, kind=kind, correction=rows.correction + constant)


def _plane_at_rest(band: object, inverse: Array) -> Band:
    """Return a plane in the coordinates at rest, with a unit normal if it had one; `inverse` is the inverse of L."""
    assert isinstance(band, Band)
    normal = band.coefficients @ inverse
    size = np.linalg.norm(normal, axis=-1) / np.linalg.norm(band.coefficients, axis=-1)
    return replace(band, coefficients=normal / size[..., None], lower=band.lower / size, upper=band.upper / size)


def certified_at_rest(
    problem: Problem, pool: Pool, still: StillProblem, prove: Prove, region: Array | None, margin: float, effort: float
) -> Pool:
    """Return the pools of a flat batch in a wind with certificates of the problems at rest.

    `still` is the problem at rest of `problem`, and `prove` proves its fixes. The other parameters are as for
    `optloc.solvers.certificates.admitted.certified`.
    """
    began, fix, stages = perf_counter(), judge(problem, pool), pool.stages
    asked, proven_before = fixes_to_prove(pool, fix)
    claims = claims_so_far(pool, proven_before)
    items = np.flatnonzero(asked & ~proven_before)
    if not len(items):
        return replace(pool, proven=claims, stages=(*stages, certify_stage("nothing to prove", began)))
    part, before, rest = problem.take(items), take(pool, items), still.problem.take(items)
    own = replace(before, proven=None, tried_before=None)
    start = keep_evidence(lsr(rest, offer(rest, still.at_rest(before.x), own, "certify", began)), own)
    done = prove(rest, start, None if region is None else still.around(region), margin, effort)
    found, old = judge(rest, done), fix[items]
    new = keep_evidence(lsr(part, offer(part, still.in_wind(done.x), before, "certify", began)), before)
    judged = judge(part, new)
    changed = improved(old, judged)
    pool = pool.merge(items[changed], take(new, changed))
    now = overwrite(old, changed, judged[changed])
    claims.write(items, _claims_in_wind(now, found, done, still))
    detail = f"{done.stages[-1].detail}, in coordinates without wind"
    return replace(pool, proven=claims, stages=(*stages, certify_stage(detail, began)))


def _claims_in_wind(fix: Fix, found: Fix, done: Pool, still: StillProblem) -> Claims:
    """Return the claims about N fixes in the wind, from the fixes `found` at rest and their pool `done`.

    A claim is valid only if both fixes have the same cost and list the same number of other minima.
    """
    claims = claims_before(done)
    for i in range(len(claims.proof)):
        if claims.region[i] is None:
            continue
        low, high = still.inside(*(np.array(corner) for corner in claims.region[i]))
        claims.region[i] = region = tuple(low.tolist()), tuple(high.tolist())
        claims.reason[i] = claim_sentence(float(claims.margin[i]), int(count_listed(found)[i]), region)
    drop_lost(claims, fix, found)
    return claims
