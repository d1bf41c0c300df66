"""The covariance of a fix is the covariance of its error, and no larger than the Cramer-Rao bound allows."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
from monte_carlo.layouts import DAILY, KINDS, NAMES, SEED, Y_ARRAY, Y_TARGETS, Case, fixed, model
from monte_carlo.tables import ledger
from monte_carlo.trials import automatic, position, trials
from scipy.constants import speed_of_light
from scipy.stats import chi2, poisson

from optloc import Status, crlb, solve

DEFAULT, FULL, MANY = 60, 2000, 20_000
# What a covariance promises: shares of the errors that its ellipsoids hold, and how far off they may be where there are
# fixes enough to tell.
LEVELS, PROMISED, ENOUGH = (0.95, 0.999), ((0.93, 0.97), (0.995, 1.0)), 1500
# The band that all cases together meet with 99 %: few trials leave single cases to chance.
EVERY_CASE = 1.0 - 0.01 / len(DAILY)


@dataclass(frozen=True)
class Regular:
    """A fixed layout with one emitter."""

    name: str
    kind: str
    stations: np.ndarray
    emitter: np.ndarray
    sigma: float


_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
REGULAR = {
    layout.name: layout
    for layout in (
        Regular(
            "octahedron, emitter inside, 10 m",
            "tdoa",
            np.concatenate([np.eye(3), -np.eye(3)]) * [5e3, 5e3, 3e3],
            np.array([1e3, 2e3, 1e3]),
            10.0,
        ),
        Regular(
            "corners of the box, emitter at 17 km, 10 m",
            "tdoa",
            _SIGNS * [5e3, 5e3, 3e3],
            np.array([15e3, 8e3, 4e3]),
            10.0,
        ),
        Regular("planar Y, first target, 10 ns", "tdoa, white", Y_ARRAY, Y_TARGETS[0], 10e-9 * speed_of_light),
    )
}


@pytest.fixture(scope="module")
def nees_book():
    header = ["case", "ok", "share", "NEES / d", "99 % band", "in the 95 % ellipsoid", "in the 99.9 % ellipsoid"]
    with ledger("nees", header, NAMES, f"seed {SEED}, {FULL} trials a case") as made:
        yield made


@pytest.fixture(scope="module")
def bound_book():
    header = ["layout", "RMSE, m", "bound, m", "RMSE / bound"]
    with ledger("bound", header, list(REGULAR), f"seed {SEED}, {MANY} trials a layout") as made:
        yield made


def nees(name: str, count: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the normalised squared errors of all fixes that are ok, and where the truth is at a listed alternative.

    An alternative that costs 9 more is the right one once in a hundred times: how often that is expected comes last.
    """
    run, fix = trials(name, count), automatic(name, count)
    ok = fix.code == Status.OK
    error = (position(fix) - run.truth)[ok, :, None]
    squared = (np.swapaxes(error, 1, 2) @ np.linalg.solve(fix.covariance()[ok], error))[:, 0, 0]
    others = fix.alternatives.x[ok][..., : error.shape[1]] - run.truth[ok, None]
    nearest = np.where(np.isnan(others), np.inf, others)
    elsewhere = (nearest**2).sum(-1).min(1, initial=np.inf) < (error[..., 0] ** 2).sum(-1)
    return squared, elsewhere, float(fix.alternatives.doubt[ok].sum())


def band(degrees: int, probability: float = 0.99) -> tuple[float, float]:
    """Return the band of a mean of squared unit normals."""
    tail = (1.0 - probability) / 2.0
    return chi2.ppf(tail, degrees) / degrees, chi2.ppf(1.0 - tail, degrees) / degrees


def summary(name: str, count: int, probability: float):
    """Return how many are ok, their mean squared error per axis in units of its variance, its band, and coverages.

    A single error of kilometres, where the truth is at an alternative, rules a mean: it counts for the coverage alone.
    """
    squared, elsewhere, expected = nees(name, count)
    assert elsewhere.sum() <= poisson.isf(1e-4, expected), (elsewhere.sum(), expected)
    d = trials(name, count).truth.shape[1]
    mean = squared[~elsewhere].mean() / d if len(squared) else np.nan
    held = [float((squared <= chi2.ppf(level, d)).mean()) if len(squared) else np.nan for level in LEVELS]
    return len(squared), mean, band(max(len(squared) * d, 1), probability), held


@pytest.mark.parametrize("name", DAILY)
def test_errors_are_as_large_as_the_covariance_says(name):
    used, mean, (low, high), _ = summary(name, DEFAULT, EVERY_CASE)
    assert not used or low <= mean <= high, f"NEES/d {mean:.3f} of {used} fixes, band {low:.3f} to {high:.3f}"


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_errors_are_as_large_as_the_covariance_says_in_full(name, nees_book):
    used, mean, (low, high), held = summary(name, FULL, 0.99)
    shares = [f"{100.0 * share:.1f} %" if used else "" for share in held]
    nees_book.add(name, used, f"{100.0 * used / FULL:.1f} %", f"{mean:.3f}", f"{low:.3f} to {high:.3f}", *shares)
    low, high = band(max(used, 1) * trials(name, FULL).truth.shape[1], 1.0 - 0.01 / len(NAMES))
    assert not used or low <= mean <= high, f"NEES/d {mean:.3f} of {used} fixes, band {low:.3f} to {high:.3f}"
    if used >= ENOUGH:
        assert all(least <= share <= most for share, (least, most) in zip(held, PROMISED, strict=True)), held


def rmse(layout: Regular, count: int) -> tuple[float, float]:
    """Return the root mean square error of a layout and its bound."""
    kind = KINDS[layout.kind]
    places, truth = fixed(layout.stations, None, count), fixed(layout.emitter, None, count)
    own = model(kind, places, layout.sigma)
    exact = own.exact(truth)
    case = Case(layout.name, layout.kind, partial(fixed, layout.stations), partial(fixed, layout.emitter), 1.0, 1.0)
    rng = np.random.default_rng(case.seed)
    root = np.linalg.cholesky(kind.covariance(exact.shape[1], layout.sigma))
    problem = kind.problem(places, exact + rng.standard_normal(exact.shape) @ root.T, layout.sigma)
    fix = solve(problem)
    assert (fix.code == Status.OK).all()
    _, J = own.residual(truth[:1], exact[:1], np.array([0]))
    bound = np.linalg.inv(J[0].T @ J[0])
    np.testing.assert_allclose(crlb(problem, truth)[0], bound, rtol=1e-6)
    return float(np.sqrt(((position(fix) - truth) ** 2).sum(1).mean())), float(np.sqrt(np.trace(bound)))


@pytest.mark.parametrize("name", REGULAR)
def test_errors_meet_the_bound_within_their_scatter(name):
    found, bound = rmse(REGULAR[name], DEFAULT)
    low, high = np.sqrt(band(DEFAULT))  # of one axis: the widest
    assert low <= found / bound <= high


@pytest.mark.full
@pytest.mark.parametrize("name", REGULAR)
def test_errors_meet_the_bound_in_full(name, bound_book):
    found, bound = rmse(REGULAR[name], MANY)
    bound_book.add(name, f"{found:.2f}", f"{bound:.2f}", f"{found / bound:.4f}")
    assert found == pytest.approx(bound, rel=0.05)
