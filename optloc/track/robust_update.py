"""Updates that a wrong row moves little: any filter with rows weighed by a loss."""

from __future__ import annotations

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Array
from optloc.linear.evaluate import differentiate
from optloc.problem.loss import LOSSES, Loss
from optloc.problem.problem import Problem
from optloc.solvers.robust.reweighting import Doubt, doubted
from optloc.track.track import filter_of
from optloc.track.updates import Update, Updated

_LIMIT, _SETTLED = 30, 1e-6


def reweighted(update: Update | str, loss: Loss | str) -> Update:
    """Return a filter whose update is repeated with rows weighed by a loss of their residuals, until the weights stay.

    The first weights are those of the innovations in their own standard deviations, prediction included; later ones
    those of the residuals at the updated state, as in `optloc.solve` with this loss. With "iekf" the state is then a
    stationary point of prior and loss together; the covariance is that of least squares with these weights.

    Parameters
    ----------
    update : callable or str
        A filter, or its name in `UPDATES`.
    loss : Loss or str
        A loss, or its name in `optloc.LOSSES`.

    Raises
    ------
    InvalidProblem
        For an unknown filter or loss.

    References
    ----------
    C. J. Masreliez, R. D. Martin, "Robust Bayesian estimation for the linear model and robustifying the Kalman filter",
    IEEE Trans. Autom. Control 22 (1977).
    """
    rule = filter_of(update)
    if isinstance(loss, str):
        if loss not in LOSSES:
            raise InvalidProblem(f"unknown loss {loss!r}", "loss", nearest(loss, list(LOSSES)))
        loss = LOSSES[loss]
    chosen: Loss = loss

    def robust(scan: Problem, mean: Array, cov: Array) -> Updated:
        many = np.broadcast_shapes(scan.batch_shape, mean.shape[:-1])
        x, flat = np.broadcast_to(mean, (*many, mean.shape[-1])).reshape(-1, mean.shape[-1]), scan.flat()
        doubt = Doubt.of(flat, x)
        residual, H = differentiate(flat, x)
        spread = ((H @ np.broadcast_to(cov, (*many, *cov.shape[-2:])).reshape(-1, *cov.shape[-2:])) * H).sum(-1)
        u = np.where(doubt.base > 0.0, residual, 0.0) / np.sqrt(doubt.own + spread)
        weight = chosen.weight(doubted(chosen, u, doubt.sided))
        for _ in range(_LIMIT):
            found = rule(scan.with_rows(weight=doubt.row_weight(weight).reshape(*many, -1)), mean, cov)
            u = doubt.residual(flat, found.mean.reshape(x.shape), weight)
            before, weight = weight, chosen.weight(doubted(chosen, u, doubt.sided))
            if not np.abs(weight - before).max(initial=0.0) >= _SETTLED:
                break
        return found

    return robust
