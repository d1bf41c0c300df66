"""One epoch of rows that do not say whose they are, and what a set of them costs as one emitter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from optloc import noise as noises
from optloc.errors import InvalidProblem
from optloc.models import MODELS
from optloc.problem import Problem
from optloc.several.enclose import KINDS
from optloc.track.candidates import candidates, channels_of
from optloc.track.sets import Clutter
from optloc.types import Array

# Share of its variance that a row must have of its own, or the likelihood of sets of rows is endless.
_OWN = 1e-9


@dataclass(frozen=True, slots=True)
class Scene:
    """The values measured in each channel (a kind at its stations) of one epoch, and the prices of sets of them.

    A set T of values, one or none of each channel, costs as one emitter, against all of them being false, ::

        c(T) = min_x chi2(T, x) + ln|2 pi R_T| - sum_T 2 ln(pd / density) - (m - |T|) 2 ln(1 - pd) + penalty,

    twice the negative logarithm of the generalised likelihood ratio of Deb et al. (1997), and a penalty.
    The penalty is what the d most telling rows are worth: a position is stated by d numbers, and d rows fit it
    whatever they read, so that only rows beyond them speak for an emitter. In other words, the d rows that place an
    emitter are taken to read anything as readily as false ones do (Rissanen 1978: a parameter costs the logarithm of
    its range over its precision).

    Parameters
    ----------
    scan : Problem
        One row for each channel; the only unknown is the position.
    z : array (m, c)
        Values, known corrections taken off; NaN where there are fewer than c.
    row : int array (m, c)
        Global row of each value in the problem; -1 where there is none.
    R : array (m, m)
        Covariance of one row of each channel.
    gain : array (m,)
        2 ln(pd / density) of each channel.
    missed : float
        -2 ln(1 - pd), what an emitter pays for a channel without it.
    penalty : float
        What an emitter pays for being one.

    References
    ----------
    S. Deb, M. Yeddanapudi, K. Pattipati, Y. Bar-Shalom, "A generalized S-D assignment algorithm for
    multisensor-multitarget state estimation", IEEE Trans. Aerosp. Electron. Syst. 33 (1997).
    J. Rissanen, "Modeling by shortest data description", Automatica 14 (1978).
    """

    scan: Problem
    z: Array
    row: Array
    R: Array
    gain: Array
    missed: float
    penalty: float

    @property
    def sigma(self) -> Array:
        """Return the standard deviation of each channel, (m,)."""
        return np.asarray(np.sqrt(np.diagonal(self.R)))

    @property
    def periodic(self) -> Array:
        """Return which channels are angles, (m,)."""
        return np.concatenate([np.full(b.count, MODELS[b.kind].period is not None) for b in self.scan.rows])

    @property
    def independent(self) -> bool:
        """Return whether the errors of the channels are independent."""
        return not np.any(self.R - np.diag(np.diagonal(self.R)))

    @property
    def least(self) -> int:
        """Return the least number of rows that can speak for an emitter, more than there are channels if none can."""
        worth = np.sort(self.missed + self.gain - np.log(2.0 * np.pi * own_variance(self.R)))[::-1]
        best = self.penalty + self.missed * len(worth) - np.cumsum(worth)
        return int(np.argmax(best < 0.0)) + 1 if (best < 0.0).any() else len(worth) + 1

    def determinant(self, picks: Array) -> Array:
        """Return ln|2 pi R_T| (q,) of the sets of given picks (q, m)."""
        used = picks >= 0
        both = used[:, :, None] & used[:, None, :]
        matrix = np.where(both, 2.0 * np.pi * self.R, np.eye(len(self.R)))
        return np.asarray(np.linalg.slogdet(matrix)[1])

    def constant(self, picks: Array) -> Array:
        """Return what sets (q, m) cost beyond their chi-square, (q,)."""
        used = picks >= 0
        rows = used @ -self.gain + self.missed * (~used).sum(-1)
        return np.asarray(self.determinant(picks) + rows + self.penalty)


def own_variance(R: Array) -> Array:
    """Return the variance (m,) that each row has of its own once all others are known."""
    scale = np.sqrt(np.diagonal(R))
    return np.asarray(scale**2 / np.diagonal(np.linalg.inv(R / scale / scale[:, None])))


def scenes(problem: Problem, clutter: Clutter, penalty: float | None) -> Iterator[Scene]:
    """Yield the epochs of a problem without batch axes that have channels, in their order.

    Parameters
    ----------
    problem : Problem
        Rows of several emitters; whose they are said to be does not matter.
    clutter : Clutter
        Detection and false rows.
    penalty : float or None
        See `Scene`; None for the value told there.

    Raises
    ------
    InvalidProblem
        For kinds, unknowns or noise that sets of rows cannot be scored with.
    """
    _check(problem)
    given = candidates(problem)
    _, members = channels_of(problem)
    epoch = given.channels.epoch
    for k, (_, scan, z) in enumerate(given.scans(0)):
        if not scan.rows:
            continue
        row = np.full(z.shape, -1)
        for i, channel in enumerate(np.flatnonzero(epoch == k)):
            row[i, : len(members[channel])] = members[channel]
        yield _scene(scan, z, np.where(np.isfinite(z), row, -1), clutter, penalty)


def _scene(scan: Problem, z: Array, row: Array, clutter: Clutter, penalty: float | None) -> Scene:
    R = noises.dense(scan.noise, np.arange(scan.count))
    variance, density = np.diagonal(R), clutter.of(scan)
    smallest = np.linalg.eigvalsh(R / np.sqrt(variance) / np.sqrt(variance)[:, None])[0]
    if not smallest > _OWN:
        advice = "give each row an error of its own as well (sigma beside arrival_sigma), or leave out rows that repeat"
        raise InvalidProblem("some rows of an epoch are exact sums of others", "noise", advice)
    worth = np.sort(-2.0 * np.log(density) - np.log(2.0 * np.pi * variance))[::-1]
    own = float(np.maximum(worth, 0.0)[: scan.dimension].sum()) if penalty is None else float(penalty)
    gain = 2.0 * np.log(clutter.detection / density)
    return Scene(scan, z, row, R, gain, -2.0 * float(np.log1p(-clutter.detection)), own)


def _check(problem: Problem) -> None:
    if problem.batch_shape:
        raise InvalidProblem("the problem has batch axes", "problem", "give its problems one by one")
    for block in problem.rows:
        if block.kind not in KINDS:
            what = f"{block.kind} rows cannot be told apart"
            raise InvalidProblem(what, "kind", f"use {', '.join(KINDS)}")
    for name, given in (
        ("biases", problem.biases),
        ("priors", problem.priors),
        ("constraints", problem.constraints),
        ("stations", problem.stations.covariance is not None),
    ):
        if given:
            advice = "leave them out: here positions are all that is unknown, and a region is given beside the problem"
            raise InvalidProblem(f"{name} with unknowns or limits of their own", name, advice)
