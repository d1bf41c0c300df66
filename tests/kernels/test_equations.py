"""Normal equations by machine code against numpy, for every kind and every form of unknown."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET, kitchen_sink, random_vector
from linear.test_normal import regular_sink
from runs import drawn, estimated, run, truth

from optloc import Motion, assemble, measured, simulate, station_array
from optloc.kernels import sums as hooks
from optloc.kernels.equations import normal_at
from optloc.kernels.pack import pack
from optloc.kernels.sums import equations_at, summed
from optloc.linear.normal import linearise, normal, whitener_at, with_priors
from optloc.models import MODELS
from optloc.models.primitives import distance
from optloc.problem import Prior

COUNT = 4


def by_numpy(problem, x):
    return with_priors(problem, x, normal(linearise(problem, x), problem.epochs))


def by_kernel(problem, x, **more):
    found = pack(problem, whitener_at(problem, x))
    assert found is not None
    return normal_at(found, x, np.arange(len(x)) % max(1, *problem.batch_shape, 1), priors=True, **more)


def differences(one, two, coarse=0.0):
    """The largest difference of two sets of equations, entry by entry relative to the size of their rows.

    `coarse` is the whitened size of numbers that cancel in a residual.
    """

    def size(matrix):
        return np.sqrt(np.abs(np.diagonal(matrix, axis1=-2, axis2=-1))) + 1e-100

    s, local, cost = size(two.shared), size(two.local), np.sqrt(np.abs(two.cost)) + coarse + 1e-100
    scales = {
        "shared": s[..., :, None] * s[..., None, :],
        "local": local[..., :, None] * local[..., None, :],
        "cross": s[..., None, :, None] * local[..., None, :],
        "shared_vector": s * cost[..., None],
        "local_vector": local * cost[..., None, None],
        "cost": cost**2,
    }
    return max(
        (np.abs(getattr(one, name) - getattr(two, name)) / scale).max(initial=0.0) for name, scale in scales.items()
    )


def tried(problem, x, seed=4):
    """Measurements of several problems, some far from the places where the equations are wanted."""
    return simulate(problem, x, seed).flat()


@pytest.mark.parametrize("name", CASES)
def test_every_kind(name):
    case = CASES[name]
    x = case.truth + np.random.default_rng(0).normal(0.0, 50.0, (COUNT, len(case.truth)))
    problem = tried(case.problem, x)
    coarse = 6.4e6 / 10.0 if "height" in name else 0.0  # a height is what is left of the Earth's radius
    assert differences(by_kernel(problem, x + 3.0), by_numpy(problem, x + 3.0), coarse) < 1e-12


SINKS = [(d, span, build) for d in (2, 3) for span in ("epoch", "run") for build in (kitchen_sink, regular_sink)]


@pytest.mark.parametrize(("d", "span", "build"), SINKS)
def test_every_form_of_unknown(d, span, build):
    """Moving and known targets, turns, axes, offsets, scales, drifts, station errors, emission times, priors."""
    problem = build(d, span).flat()
    x = np.stack([random_vector(problem, seed) for seed in range(COUNT)])
    problem = tried(problem, x)
    assert differences(by_kernel(problem, x + 0.05), by_numpy(problem, x + 0.05)) < 1e-12


@pytest.mark.parametrize("d", [2, 3])
def test_absent_rows_may_hold_anything_and_weights_differ(d):
    problem, rng = regular_sink(d, "epoch").flat(), np.random.default_rng(3)
    x = np.stack([random_vector(problem, seed) for seed in range(COUNT)])
    problem = tried(problem, x)
    weight = rng.choice([0.0, 0.3, 1.0], problem.z.shape)
    problem = problem.with_rows(z=np.where(weight > 0.0, problem.z, np.nan), weight=weight)
    assert differences(by_kernel(problem, x), by_numpy(problem, x)) < 1e-12


def test_targets_that_are_free_at_each_epoch():
    sink = regular_sink(3, "epoch")
    keep = tuple(prior for prior in sink.priors if "position" in prior.name)
    problem = replace(
        sink, motions=(Motion(1, span="epoch"), Motion(0, span="epoch"), sink.motions[2]), priors=keep
    ).flat()
    x = np.stack([random_vector(problem, seed) for seed in range(COUNT)])
    problem = tried(problem, x)
    assert differences(by_kernel(problem, x), by_numpy(problem, x)) < 1e-12


def test_angles_are_wrapped():
    case = CASES["angles-3d"]
    turns = 2.0 * np.pi * np.arange(-2, 2)[:, None]
    problem = case.problem.with_rows(z=case.problem.z + turns)
    x = np.tile(case.truth, (COUNT, 1))
    found = by_kernel(problem, x)
    assert np.allclose(found.cost, found.cost[0], rtol=1e-10)
    assert differences(found, by_numpy(problem, x)) < 1e-12


def test_every_problem_has_its_own_stations_axes_priors_and_noise():
    rng = np.random.default_rng(5)
    place = STATIONS[3] + rng.normal(0.0, 500.0, (COUNT, 1, *STATIONS[3].shape))
    spread = rng.uniform(1.0, 9.0, (COUNT, 6))
    a = np.arange(6)
    problem = assemble(
        station_array(place), measured("tdoa", a=a + 1, b=0, arrival_sigma=4.0), measured("range", a=a, sigma=spread)
    )
    mean = TARGET[3] + rng.normal(0.0, 30.0, (COUNT, 3))
    covariance = np.stack([np.diag(row) for row in rng.uniform(1e3, 1e4, (COUNT, 3))])
    problem = replace(problem, priors=(Prior("position", mean, covariance),))
    x = TARGET[3] + rng.normal(0.0, 100.0, (COUNT, 3))
    problem = tried(problem, x)
    together = by_kernel(problem, x)
    assert differences(together, by_numpy(problem, x)) < 1e-12
    for i in range(COUNT):
        alone = by_kernel(problem.take(np.array([i])), x[i : i + 1])
        assert np.array_equal(alone.shared[0], together.shared[i])


def test_runs_and_their_unknowns_of_each_epoch():
    for made in (run(40, gain=2e-3, prior=50.0), estimated(run(40))):
        problem = drawn(made, 3, COUNT).flat()
        x = np.tile(truth(problem), (COUNT, 1)) + 0.5
        assert differences(by_kernel(problem, x), by_numpy(problem, x)) < 1e-12


def test_a_kind_that_a_user_registers(monkeypatch):
    def product(t, a, b):
        return distance(t, a) * distance(t, b) / (1.0 + distance(t, a))

    monkeypatch.setitem(MODELS, "product", replace(MODELS["range_sum"], h=product, ranges=None))
    a = np.arange(1, 6)
    problem = assemble(STATIONS[3], measured("product", a=a, b=0, sigma=5.0))
    x = TARGET[3] + np.random.default_rng(1).normal(0.0, 100.0, (COUNT, 3))
    problem = tried(problem, x)
    assert differences(by_kernel(problem, x + 9.0), by_numpy(problem, x + 9.0)) < 1e-12


def test_noise_that_ties_epochs_with_their_own_unknowns_is_left_to_numpy():
    problem = estimated(run(3))
    tied = replace(problem, noise=assemble(STATIONS[3], measured("range", a=[0] * 12, covariance=np.eye(12))).noise)
    assert pack(tied, whitener_at(tied, np.zeros((1, tied.layout.size)))) is None


def test_a_measurement_that_is_not_a_number_stays_where_it_is():
    case = CASES["tdoa-3d"]
    problem = simulate(case.problem, case.truth, 1, trials=70).flat()
    x = np.tile(case.truth, (70, 1))
    clean = by_kernel(problem, x)
    z = problem.z.copy()
    z[11, 2] = np.nan
    x[40] = np.inf
    found = by_kernel(problem.with_rows(z=z), x)
    assert not np.isfinite(found.cost[[11, 40]]).any()
    others = np.delete(np.arange(70), [11, 40])
    for name in ("shared", "shared_vector", "cost"):
        assert np.array_equal(getattr(found, name)[others], getattr(clean, name)[others])


def test_the_sums_of_a_batch_take_this_way(monkeypatch):
    case = CASES["tdoa-3d"]
    problem = simulate(case.problem, case.truth, 1, trials=60).flat()
    x = np.tile(case.truth + 20.0, (60, 1))
    monkeypatch.setattr(hooks, "serves", lambda problem, starts: True)
    found = equations_at(problem, x), summed(problem, x)
    monkeypatch.setattr(hooks, "serves", lambda problem, starts: False)
    assert differences(found[0], equations_at(problem, x)) < 1e-12
    assert differences(found[1], summed(problem, x)) < 1e-12
