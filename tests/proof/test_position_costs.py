"""The cost over the position alone, as the proof sees it, against the cost of the whole problem."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, STATIONS, TARGET, pairs, stations
from proof.plain import cost_of

from optloc import Motion, Stations, assemble, measured, simulate, with_bias
from optloc.base.types import Bias
from optloc.kernels.sums import equations_at
from optloc.linear.constraints import box
from optloc.models import MODELS
from optloc.problem import Prior
from optloc.proof.position_costs import position_costs
from optloc.proof.scope import why_unsupported

PLACES = 12


def profiled(problem, x):
    """Return the cost (M,) of the whole problem with everything but the position at its best value."""
    flat, layout = problem.flat(), problem.layout
    n, d = layout.n_shared, problem.dimension
    slot, _ = layout.find("position")
    part = flat.take(np.zeros(len(x), dtype=int))
    full = np.zeros((len(x), layout.size))
    full[:, slot.start : slot.start + d] = x
    rest = np.setdiff1d(np.arange(layout.size), np.arange(slot.start, slot.start + d))
    for _ in range(12):
        at = equations_at(part, full)
        size, k = at.local.shape[-1], layout.epochs
        A, b = np.zeros((len(x), layout.size, layout.size)), np.zeros((len(x), layout.size))
        A[:, :n, :n], b[:, :n] = at.shared, at.shared_vector
        for i in range(k if size else 0):
            own = slice(n + i * size, n + (i + 1) * size)
            A[:, own, own], b[:, own] = at.local[:, i], at.local_vector[:, i]
            A[:, :n, own], A[:, own, :n] = at.cross[:, i], np.swapaxes(at.cross[:, i], 1, 2)
        if not len(rest):
            return at.cost
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(A, axis1=1, axis2=2)[:, rest], 1e-300))
        inner = A[:, rest][:, :, rest] * scale[:, :, None] * scale[:, None]
        step = np.linalg.pinv(inner, rcond=1e-13, hermitian=True) @ (scale * b[:, rest])[..., None]
        full[:, rest] += scale * step[..., 0]
    return equations_at(part, full).cost


def near(problem, seed=3, count=PLACES):
    """Return places around the target of the table, near and far."""
    rng = np.random.default_rng(seed)
    d = problem.dimension
    return TARGET[d] + 10.0 ** rng.uniform(0.0, 4.3, (count, 1)) * rng.standard_normal((count, d))


def agree(problem, rtol=1e-9):
    assert why_unsupported(problem.flat()) == ""
    x = near(problem)
    expected = profiled(problem, x)
    assert np.all(np.isfinite(expected))
    np.testing.assert_allclose(cost_of(problem, x), expected, rtol=rtol, atol=1e-7)
    return expected


SUPPORTED = [name for name in CASES if "tdoa+fdoa" not in name and "rss" not in name]


@pytest.mark.parametrize("name", SUPPORTED)
def test_the_posed_cost_is_that_of_the_problem(name):
    agree(CASES[name].problem)


def tdoa(d, **more):
    a, b = pairs(d)
    return simulate(assemble(stations(d, **more), measured("tdoa", a=a, b=b, arrival_sigma=5.0)), TARGET[d], 4)


def test_absent_and_weakened_rows_count_as_in_the_problem():
    problem = tdoa(3)
    z = problem.z.copy()
    z[2] = np.nan
    weight = np.ones(problem.count)
    weight[[2, 4]] = 0.0, 0.3
    agree(problem.with_rows(z=z, weight=weight))


@pytest.mark.parametrize("sigma", [None, 7.0])
def test_offsets_with_and_without_a_prior(sigma):
    problem = with_bias(
        CASES["range-3d"].problem, "clock", per="kind", mean=0.0 if sigma is None else 30.0, sigma=sigma
    )
    agree(problem)


def test_clocks_with_priors_and_emission_times():
    problem = with_bias(CASES["toa+tdoa-3d"].problem, "clock", mean=3.0, sigma=4.0)
    agree(problem)


def test_offsets_of_angles_with_priors():
    problem = with_bias(CASES["angles-3d"].problem, "north", per="kind", kind="azimuth", sigma=0.01)
    agree(problem)
    level = position_costs(problem.flat()).level
    assert np.all(level > 1e4)
    assert np.all(np.isfinite(level))


@pytest.mark.parametrize("span", ["epoch", "run", "noise"])
@pytest.mark.parametrize("d", [2, 3])
def test_isotropic_station_errors_are_arrival_errors(span, d):
    count = len(STATIONS[d])
    spread = np.linspace(1.0, 9.0, count)[:, None, None] * np.eye(d)
    a, b = pairs(d)
    own = stations(d, covariance=spread, span=span)
    problem = assemble(own, measured("tdoa", a=a, b=b, arrival_sigma=5.0), measured("range", a=[2], sigma=6.0))
    plain = simulate(replace(problem, stations=replace(problem.stations, covariance=None)), TARGET[d], 5)
    problem = problem.with_rows(z=plain.z)
    agree(problem, 1e-7)


def test_station_errors_of_several_epochs():
    d, count = 3, len(STATIONS[3])
    spread = np.linspace(1.0, 9.0, count)[:, None, None] * np.eye(d)
    a, b = (np.tile(v, 2) for v in pairs(d))
    epoch = np.repeat([0, 1], count - 1)
    for span in ("epoch", "run"):
        own = stations(d, covariance=spread, span=span)
        problem = assemble(own, measured("tdoa", a=a, b=b, epoch=epoch, arrival_sigma=5.0), times=[0.0, 9.0])
        plain = simulate(replace(problem, stations=replace(problem.stations, covariance=None)), TARGET[d], 5)
        agree(problem.with_rows(z=plain.z), 1e-7)


def test_stations_that_move_and_drifts_of_several_epochs():
    d, k = 2, 5
    rng = np.random.default_rng(2)
    moving = Stations(STATIONS[d] + rng.normal(0.0, 500.0, (k, 6, d)), tuple("ABCDEF"))
    a, epoch = np.tile([1, 2, 3], k), np.repeat(np.arange(k), 3)
    rows = measured("tdoa", a=a, b=0 * a, epoch=epoch, arrival_sigma=5.0)
    angle = measured("azimuth", a=[4] * k, epoch=np.arange(k), sigma=0.01)
    problem = simulate(assemble(moving, rows, angle, times=3.0 * np.arange(k)), TARGET[d], 6)
    agree(problem)
    drift = Bias("drift", ("x",), np.arange(15), np.zeros(15, int), np.ones(15), "drift", np.zeros(1), np.array([0.5]))
    agree(replace(problem, biases=(drift,)))


def test_a_prior_on_the_position():
    root = np.array([[40.0, 0.0, 0.0], [10.0, 20.0, 0.0], [-5.0, 3.0, 300.0]])
    prior = Prior("position", TARGET[3] + 10.0, root @ root.T)
    agree(replace(tdoa(3), priors=(prior,)))


def test_a_batch_is_posed_as_its_problems_are():
    rng = np.random.default_rng(8)
    z = tdoa(3).z + rng.normal(0.0, 5.0, (4, tdoa(3).count))
    batch = tdoa(3).with_rows(z=z)
    one = position_costs(batch)
    assert len(one.K) == len(one.data) == 1
    assert one.w.shape[0] == 4
    for i in range(4):
        single = position_costs(batch.take(np.array([i])))
        np.testing.assert_allclose(one.w[i], single.w[0], rtol=1e-13)
    places = assemble(
        STATIONS[3] + rng.normal(0, 9.0, (4, 1, 7, 3)),
        measured("tdoa", z, a=pairs(3)[0], b=pairs(3)[1], arrival_sigma=5.0),
    )
    one = position_costs(places.flat())
    assert len(one.data) == 4
    for i in range(4):
        np.testing.assert_allclose(one.data[i], position_costs(places.flat().take(np.array([i]))).data[0])


def test_many_rows_over_few_ranges_are_compressed():
    a, b = (np.tile(v, 30) for v in pairs(3))
    problem = assemble(
        STATIONS[3], measured("tdoa", a=a, b=b, epoch=np.repeat(np.arange(30), 6), arrival_sigma=5.0), times=range(30)
    )
    problem = simulate(problem, TARGET[3], 5)
    agree(problem)
    assert position_costs(problem.flat()).K.shape[-2:] == (8, 7)


def uncertain(problem, variance):
    spread = np.diag(variance) * np.ones((problem.stations.count, 1, 1))
    return replace(problem, stations=replace(problem.stations, covariance=spread))


@pytest.mark.parametrize(
    ("problem", "what"),
    [
        (lambda: replace(CASES["tdoa+fdoa-3d"].problem, constraints=box([-9e4] * 3, [9e4] * 3)), "constraints"),
        (lambda: with_bias(tdoa(3), "scale", per="station", form="scale", sigma=0.1), "several scales"),
        (lambda: with_bias(CASES["angles-3d"].problem, "north", per="kind", kind="azimuth"), "whole turns"),
        (lambda: uncertain(tdoa(3), [1.0, 2.0, 3.0]), "axis to axis"),
        (lambda: uncertain(CASES["groa-3d"].problem, [1.0, 1.0, 1.0]), "groa"),
        (lambda: replace(tdoa(3), motions=(Motion(1),)), "moves"),
        (lambda: replace(tdoa(3), motions=(Motion(), Motion())), "2 targets"),
    ],
)
def test_what_is_beyond_the_proof_is_named(problem, what):
    assert what in why_unsupported(problem().flat())


def test_a_kind_without_nodes_is_beyond_the_proof(monkeypatch):
    bare = replace(MODELS["rss_difference"], nodes=())
    monkeypatch.setattr("optloc.proof.scope.MODELS", {**MODELS, "rss_difference": bare})
    assert "neither sums of ranges or rates" in why_unsupported(CASES["rss_difference-3d"].problem.flat())
