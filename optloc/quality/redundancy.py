"""What the residuals of fixes say of every error and offset: its size, its test, its redundancy.

A problem linearised at its fix is v = J dx + B e + E b + n: v residuals, e independent errors of the groups' noise with
covariance diag(theta), b offsets of the groups, n what has a covariance C of its own. With V = B diag(theta) B' + C and
P = V^-1 - V^-1 J (J' V^-1 J)^-1 J' V^-1, which annihilates J, all that follows needs only T = F' P F and t = F' P v of
the columns F = [B, E]: t_j / T_jj is the size of an error along column j that the other rows show (for a row, its
leave-one-out residual), 1 / sqrt(T_jj) its standard deviation, and t_j / sqrt(T_jj) is standard normal without one.

W. Baarda, "A testing procedure for use in geodetic networks" (1968), section 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc import linalg
from optloc.quality.elements import Elements
from optloc.types import Array

_NOTHING = 1e-9


@dataclass(frozen=True, slots=True)
class Tested:
    """T = F' P F and t = F' P v for the columns F = [B, E], and what is left of the residuals.

    Parameters
    ----------
    matrix : array (N, q + c, q + c)
        T.
    vector : array (N, q + c)
        t.
    errors : int
        q, the number of columns that are errors.
    cost : array (N,)
        v' P v, chi-square distributed with `dof` degrees of freedom.
    dof : array (N,)
        Rank of P.
    """

    matrix: Array
    vector: Array
    errors: int
    cost: Array
    dof: Array

    @property
    def size(self) -> Array:
        """Return the diagonal of T, (N, q + c)."""
        return np.asarray(np.diagonal(self.matrix, axis1=-2, axis2=-1))

    @property
    def sigmas(self) -> Array:
        """Return the tests t / sqrt(T) of all columns (N, q + c); 0 where nothing can be tested."""
        size = self.size
        return np.where(size > 0.0, self.vector / np.sqrt(np.where(size > 0.0, size, 1.0)), 0.0)

    def without(self, column: Array) -> Tested:
        """Return the same with an error of unknown size along one column (N,) of each problem; -1 for none."""
        items = np.flatnonzero(column >= 0)
        j = column[items]
        matrix, vector, cost, dof = self.matrix.copy(), self.vector.copy(), self.cost.copy(), self.dof.copy()
        along, own = matrix[items, :, j], matrix[items, j, j]
        vector[items] -= along * (self.vector[items, j] / own)[:, None]
        matrix[items] -= along[:, :, None] * along[:, None, :] / own[:, None, None]
        cost[items] -= self.vector[items, j] ** 2 / own
        dof[items] -= 1
        gone = np.diagonal(matrix[items], axis1=-2, axis2=-1) <= _NOTHING * self.size[items]
        matrix[items] *= ~(gone[:, :, None] | gone[:, None, :])
        vector[items] *= ~gone
        return Tested(matrix, vector, self.errors, cost, dof)


def tested(made: Elements, variance: Array) -> Tested:
    """Return what the residuals say of every error and offset.

    Parameters
    ----------
    made : Elements
        N problems.
    variance : array (N, q) or ()
        Theta, the variance of each error.
    """
    q = made.effect.shape[-1]
    scaled = made.effect * np.sqrt(np.broadcast_to(variance, made.of_effect.shape))[:, None]
    covariance = scaled @ np.swapaxes(scaled, 1, 2) + made.fixed
    whiten = linalg.whitening(covariance)
    columns = np.concatenate([made.effect, made.offset, made.residual[..., None]], axis=-1)
    white, known = whiten @ columns, whiten @ made.jacobian
    root, _ = linalg.root(np.swapaxes(known, 1, 2) @ known)
    basis = known @ root
    free = white - basis @ (np.swapaxes(basis, 1, 2) @ white)
    gram = np.swapaxes(free, 1, 2) @ free
    rank = (whiten != 0.0).any(-1).sum(-1) - (root != 0.0).any(-2).sum(-1)
    matrix = gram[:, :-1, :-1]
    size = np.diagonal(np.swapaxes(white, 1, 2) @ white, axis1=-2, axis2=-1)[:, :-1]
    seen = np.diagonal(matrix, axis1=-2, axis2=-1) > _NOTHING * size
    both = seen[:, :, None] & seen[:, None, :]
    return Tested(np.where(both, matrix, 0.0), np.where(seen, gram[:, :-1, -1], 0.0), q, gram[:, -1, -1], rank)
