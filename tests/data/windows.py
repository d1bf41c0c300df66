"""What the tests of real data share: least squares started at the truth to judge a fix by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2
from verdicts import alone

from optloc import Fix, Status
from optloc.lab.datasets.reading import Window, Windows


def from_truth(data: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Return least-squares positions (k, d) and costs (k,), started at the truth; nothing of optloc is used."""
    found, cost = np.empty_like(data.truth), np.empty(len(data.windows))
    for k, w in enumerate(data.windows):
        whiten = np.linalg.inv(np.linalg.cholesky(w.covariance))

        def residual(x: np.ndarray, w: Window = w, whiten: np.ndarray = whiten) -> np.ndarray:
            model = np.linalg.norm(x - data.stations[w.a], axis=1)
            if w.b is not None:
                model = model - np.linalg.norm(x - data.stations[w.b], axis=1)
            return whiten @ (w.z - model)

        best = least_squares(residual, w.truth, x_scale="jac", xtol=1e-10, ftol=1e-12)
        found[k], cost[k] = best.x, 2.0 * best.cost
    return found, cost


def quantiles(error: np.ndarray) -> tuple[float, float]:
    """Return median and 95 % of errors."""
    return float(np.median(error)), float(np.quantile(error, 0.95))


def report(text: str) -> None:
    """Print a line that ``pytest -s`` shows."""
    print(text)  # noqa: T201


def statuses(fix: Fix) -> str:
    """Return how often each status occurs, in words."""
    numbers, counts = np.unique(fix.code, return_counts=True)
    return ", ".join(f"{n} {Status(int(s)).label}" for s, n in zip(numbers, counts, strict=True))


def judge(data: Windows, fix: Fix, limit: float = 5.0) -> tuple[float, float]:
    """Assert what must hold for the fixes of a data set made without a guess; print and return median and 95 % error.

    `limit` is the error in metres from which on a fix with nothing against it is called silently wrong.
    """
    answered = fix.answered
    error = np.linalg.norm(fix.position - data.truth, axis=-1)
    position, cost = from_truth(data)
    ours = quantiles(error[answered])
    theirs = quantiles(np.linalg.norm(position - data.truth, axis=-1)[answered])
    seconds = sum(stage.seconds for stage in fix.stages)
    report(
        f"{data.name}: {len(error)} windows ({statuses(fix)}), error median {ours[0]:.3f} m, 95 % {ours[1]:.3f} m; "
        f"started at the truth {theirs[0]:.3f} / {theirs[1]:.3f} m; {1e3 * seconds / len(error):.2f} ms a fix"
    )
    assert answered.mean() >= 0.99, f"{data.name}: {statuses(fix)}"
    assert ours[0] <= 1.05 * theirs[0], data.name
    assert ours[1] <= 1.05 * theirs[1], data.name
    worse = answered & (fix.cost > cost * (1.0 + 1e-6) + 1e-6)
    assert not worse.any(), f"{data.name}: the truth leads to a better minimum in windows {np.flatnonzero(worse)}"
    wrong = alone(fix) & ~(error <= limit)
    assert not wrong.any(), f"{data.name}: silently wrong in windows {np.flatnonzero(wrong)}"
    dof = np.array([len(w.z) - data.stations.shape[1] for w in data.windows])
    assert np.array_equal(fix.dof[answered], dof[answered])
    np.testing.assert_allclose(fix.p_value[answered], chi2.sf(fix.cost, dof)[answered], rtol=1e-9, atol=1e-300)
    return ours


def own_sigmas(data: Windows, fix: Fix) -> np.ndarray:
    """Return how many of its own standard deviations each fix is off: the whole error ellipsoid, not axis by axis."""
    error = fix.position - data.truth
    cov = fix.covariance()
    return np.sqrt(np.einsum("ki,kij,kj->k", error, np.linalg.inv(cov), error))


def judge_consistency(data: Windows, fix: Fix, share: float = 0.01) -> None:
    """Assert that of the fixes whose chi-square is plausible at most a share is more than 5 own sigma off."""
    off = np.full(len(data.windows), np.nan)
    good = fix.answered & (fix.p_value > 1e-3)
    off[good] = own_sigmas(data, fix)[good]
    far = np.flatnonzero(off > 5.0)
    rms = np.sqrt(np.mean(off[good] ** 2 / data.stations.shape[1]))
    report(
        f"{data.name}: {good.sum()} of {len(off)} plausible (p > 0.001), {len(far)} beyond 5 sigma, rms {rms:.2f} sigma"
    )
    listed = _listed(data, fix, off, far)
    assert len(far) <= share * good.sum(), f"{data.name}: {len(far)} of {good.sum()} beyond 5 own sigma\n{listed}"
    assert good.mean() > 0.5, "a chi-square that rejects most windows says that the noise is not the data's"


def _listed(data: Windows, fix: Fix, off: np.ndarray, which: Sequence[int]) -> str:
    error = np.linalg.norm(fix.position - data.truth, axis=-1)
    return "\n".join(f"  window {k}: {off[k]:.1f} sigma, {error[k]:.2f} m, p = {fix.p_value[k]:.3g}" for k in which)
