"""Residuals in sigma and the weights that a loss gives them, for rows of any noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.evaluate import predict
from optloc.loss import Loss
from optloc.models import MODELS, wrap
from optloc.noise import Noise, variances, whiten
from optloc.problem import Problem
from optloc.types import Array
from optloc.weigh import weighed

# Rows of a correlated group are never quite absent while their weights are sought: their partners still foretell them.
_LEAST = 1e-6
_LATE = frozenset(("range", "toa", "range_sum"))


@dataclass(frozen=True, slots=True)
class Doubt:
    """What a loss needs to know of the rows of a flat batch of N problems; it does not change during an iteration.

    A loss gives row i an error of its own with variance ``t_i = s_i (1 / weight_i - 1)``, where s_i is the variance of
    the row given all other rows (its own variance where rows are independent). Residuals r and weights then are a
    stationary point of

        r' (R + diag t)^-1 r  +  sum of rho(u_i) - weight_i u_i^2,

    which for independent rows is the sum of rho(r_i / sigma_i): the line process of a loss (M. J. Black, A. Rangarajan,
    "On the unification of line processes, outlier rejection, and robust statistics", Int. J. Comput. Vis. 19 (1996),
    section 3), with a covariance R.

    Parameters
    ----------
    noise : Noise
        Station errors of span "noise" included.
    base : array (N, m)
        Weights of the rows before any doubt; 0 = absent.
    own, given : array (N, m)
        Variance of each row, and its variance given all others that are present.
    sided : bool array (m,)
        Which rows are off to the positive side only when they are late.
    """

    noise: Noise
    base: Array
    own: Array
    given: Array
    sided: Array

    @classmethod
    def of(cls, problem: Problem, at: Array) -> Doubt:
        """Return what a loss needs to know of N problems; noise that depends on the place is that at x (N, size)."""
        noise, size = weighed(problem, at).noise, len(at)
        base = np.broadcast_to(problem.weight, (size, problem.count))
        own = np.broadcast_to(variances(noise, problem.count), base.shape)
        given = own / np.where(base > 0.0, base, 1.0)
        for whitener in whiten(noise, problem.weight):
            if whitener.row.shape[1] > 1:
                rows = whitener.row
                present = base[:, rows] > 0.0
                full = np.broadcast_to((whitener.matrix != 0.0).any(-1).sum(-1), present.shape[:-1]) == present.sum(-1)
                precision = (whitener.matrix**2).sum(-2)
                known = present & full[..., None] & (precision > 0.0)
                given[:, rows] = np.where(known, 1.0 / np.where(known, precision, 1.0), given[:, rows])
        kinds = np.concatenate([np.full(rows.count, rows.kind in _LATE) for rows in problem.rows])
        return cls(noise, base, own, given, kinds)

    def take(self, index: Array) -> Doubt:
        """Return what belongs to some of the problems."""
        blocks = tuple(
            b if b.covariance.ndim == 3 or len(b.covariance) == 1 else replace(b, covariance=b.covariance[index])
            for b in self.noise.blocks
        )
        return Doubt(Noise(blocks), self.base[index], self.own[index], self.given[index], self.sided)

    def row_weight(self, weight: Array) -> Array:
        """Return weights (N, m) as `Problem.with_rows` takes them, of the weights that a loss gives."""
        ratio = self.given / self.own
        with np.errstate(divide="ignore", over="ignore"):
            total = 1.0 / self.base + ratio * (1.0 / weight - 1.0)
            return np.where((self.base > 0.0) & (weight > 0.0), 1.0 / total, 0.0)

    def residual(self, problem: Problem, x: Array, weight: Array) -> Array:
        """Return residuals in sigma (N, m) at vectors x (N, size), zero for absent rows.

        Those of correlated rows are what is left of a row given its partners, which count as much as their weights say.
        """
        left = np.where(self.base > 0.0, residuals(problem, x), 0.0)
        u = left / np.sqrt(self.given)
        if all(block.row.shape[1] == 1 for block in self.noise.blocks):
            return u
        least = np.maximum(weight, _LEAST)
        for whitener in whiten(self.noise, self.row_weight(least)):
            rows = whitener.row
            if rows.shape[1] > 1:
                white = whitener.matrix @ left[:, rows][..., None]
                share = (np.swapaxes(whitener.matrix, -1, -2) @ white)[..., 0]
                u[:, rows] = share * np.sqrt(self.given[:, rows]) / least[:, rows]
        return u


def residuals(problem: Problem, x: Array) -> Array:
    """Return residuals (N, m) of a flat batch at vectors x (N, size); angles wrapped."""
    left = problem.observed - predict(problem, x)
    for rows, start in zip(problem.rows, problem.starts, strict=True):
        if MODELS[rows.kind].period is not None:
            part = slice(start, start + rows.count)
            left[..., part] = wrap(left[..., part])
    return np.asarray(left)


def doubted(loss: Loss, u: Array, sided: Array) -> Array:
    """Return residuals as a loss takes them: of rows that may be off to either side the size alone counts."""
    return np.where(sided, u, np.abs(u)) if loss.one_sided else u
