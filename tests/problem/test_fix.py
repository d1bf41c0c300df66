"""The answer as a value: parts of it, its ellipse, its Gaussian, its place on the globe, and its refusal."""

import pickle

import numpy as np
import pymap3d
import pytest
from cases import CASES, ENU, STATIONS, TARGET
from often import few
from scipy.stats import chi2

from optloc import NoSolution, Status, assemble, measured, simulate, solve
from optloc.problem import ECEF


def many(name="tdoa-3d", trials=6, seed=3):
    case = CASES[name]
    return solve(simulate(case.problem, case.truth, seed, trials=trials))


def arrays(fix):
    out = [fix.x, fix.cov, fix.code, fix.cost, fix.dof, fix.weights, fix.alternatives.x, fix.alternatives.gap]
    return [*out, fix.reason, fix.certificate]


def test_indexing_picks_everything():
    fix = many()
    for index in (3, slice(1, 4), np.array([5, 0]), fix.cost > np.median(fix.cost)):
        part = fix[index]
        for whole, some in zip(arrays(fix), arrays(part), strict=True):
            assert np.shape(some) == np.shape(whole[index])
            if whole.dtype != object:
                assert np.array_equal(some, whole[index], equal_nan=True)
    assert fix[3].status is Status.OK
    assert isinstance(fix[3].certificate.proof, str)
    assert len(fix) == 6
    assert [float(one.cost) for one in (fix[i] for i in range(6))] == fix.cost.tolist()


def test_reshape_and_flat_undo_each_other():
    fix = many()
    square = fix.reshape((2, 3))
    assert square.shape == (2, 3)
    assert square.covariance().shape == (2, 3, 3, 3)
    assert np.array_equal(square[1, 2].x, fix[5].x)
    assert np.array_equal(square.flat().x, fix.x)
    single = fix[0]
    assert single.shape == ()
    assert single.flat().shape == (1,)
    assert single.flat().reshape(()).status == single.status


def test_flat_works_without_alternatives_and_without_problems():
    fix = many()
    none = fix[np.zeros(6, dtype=bool)]
    assert len(none) == 0
    assert none.flat().shape == (0,)
    assert none.require() is none


def test_named_parts():
    case = CASES["tdoa+fdoa-3d"]
    fix = many("tdoa+fdoa-3d")
    assert np.array_equal(fix.position, fix.x[:, :3])
    assert np.array_equal(fix.velocity, fix.x[:, 3:6])
    assert np.array_equal(fix.take("velocity"), fix.velocity)
    assert np.array_equal(fix.covariance("velocity"), fix.cov[:, 3:, 3:])
    assert np.allclose(fix.sigma() ** 2, np.diagonal(fix.cov, axis1=-2, axis2=-1)[:, :3])
    assert np.abs(fix.velocity - case.truth[3:]).max() < 10.0
    toa = many("toa-2d")
    assert set(toa.bias) == {"emission"}
    assert np.abs(toa.bias["emission"] + 1234.0).max() < 60.0
    mean, cov = fix.gaussian()
    assert np.array_equal(mean, fix.x)
    assert np.array_equal(cov, fix.cov)
    assert toa.gaussian()[0].shape == (6, 2)


@pytest.mark.parametrize("probability", [0.5, 0.95, 0.99])
@pytest.mark.parametrize("name", ["tdoa-2d", "range-3d"])
def test_the_ellipse_holds_its_probability(name, probability):
    fix = many(name, trials=1)[0]
    rng = np.random.default_rng(1)
    cloud = rng.multivariate_normal(fix.position, fix.covariance(), 40000)
    axes, directions = fix.ellipse(probability)
    assert (np.diff(axes) >= 0.0).all()
    assert np.allclose(directions.T @ directions, np.eye(len(axes)), atol=1e-12)
    inside = ((((cloud - fix.position) @ directions) / axes) ** 2).sum(1) <= 1.0
    assert inside.mean() == pytest.approx(probability, abs=4.0 * np.sqrt(probability * (1 - probability) / 40000))


@pytest.mark.parametrize("trials", few([200, 2000], 1))
def test_the_ellipse_holds_the_target_that_often(trials):
    """Not only its own Gaussian: simulated fixes."""
    case = CASES["range-2d"]
    fix = many("range-2d", trials=trials, seed=8)
    axes, directions = fix.ellipse(0.9)
    error = np.einsum("nij,ni->nj", directions, case.truth - fix.position) / axes
    assert ((error**2).sum(1) <= 1.0).mean() == pytest.approx(0.9, abs=4.0 * np.sqrt(0.9 * 0.1 / trials))
    squared = np.einsum("ni,nij,nj->n", error * axes, np.zeros((1, 2, 2)) + np.eye(2), error * axes)
    assert np.isfinite(squared).all()


@pytest.mark.parametrize("trials", few([200, 2000], 1))
def test_p_values_are_uniform_if_the_model_is_right(trials):
    fix = many("range-2d", trials=trials, seed=9)
    assert np.allclose(fix.p_value, chi2.sf(fix.cost, fix.dof), rtol=1e-9)
    for level in (0.05, 0.5, 0.95):
        assert (fix.p_value < level).mean() == pytest.approx(level, abs=4.0 * np.sqrt(level * (1 - level) / trials))
    exact = solve(assemble(STATIONS[2], measured("range", [5e3, 9e3], a=[0, 1], sigma=1.0)))
    assert exact.dof == 0
    assert np.isnan(exact.p_value)


def test_require():
    fix = many()
    assert fix.require() is fix
    bad = solve(assemble(STATIONS[3], measured("range", [5e3, 9e3], a=[0, 1], sigma=1.0)))
    with pytest.raises(NoSolution) as caught:
        bad.require()
    assert caught.value.fix.status == Status.TOO_FEW_ROWS
    assert Status.TOO_FEW_ROWS.sentence in str(caught.value)
    z = simulate(CASES["tdoa-3d"].problem, TARGET[3], 3, trials=4).z
    z[2, 0] = np.nan
    mixed = solve(CASES["tdoa-3d"].problem.with_rows(z=z))
    with pytest.raises(NoSolution, match="not a finite number"):
        mixed.require()
    assert mixed[np.array([0, 1, 3])].require().shape == (3,)


def test_where_there_is_no_answer_there_are_no_numbers():
    bad = solve(assemble(STATIONS[3], measured("range", [5e3, 9e3], a=[0, 1], sigma=1.0)))
    axes, directions = bad.ellipse()
    assert np.isnan(axes).all()
    assert np.isnan(directions).all()
    assert np.isnan(bad.position).all()
    assert not bad.answered
    assert bad.certificate.proof == "unknown"


def test_certificates_say_what_is_proven_and_what_is_searched():
    for name in ("tdoa-3d", "azimuth-2d", "range-2d"):
        fix = many(name)
        assert {c.proof for c in fix.certificate} <= {"global", "region", "unknown"}
        assert all(c.reason for c in fix.certificate)
        assert all(("searched" in c.reason) != c.unique for c in fix.certificate if c.proof == "global")


def test_geodetic_in_enu():
    case = CASES["tdoa+height-3d"]
    fix = solve(case.problem)
    lat, lon, height = fix.geodetic
    origin = (np.degrees(ENU.origin[0]), np.degrees(ENU.origin[1]), ENU.origin[2])
    expected = pymap3d.enu2geodetic(*fix.position, *origin)
    assert np.degrees(lat) == pytest.approx(expected[0], abs=1e-10)
    assert np.degrees(lon) == pytest.approx(expected[1], abs=1e-10)
    assert height == pytest.approx(expected[2], abs=1e-6)


def test_the_same_scene_in_ecef_is_the_same_fix():
    """Stations and axes moved to ECEF: positions, covariance and height agree with the local frame."""
    case = CASES["height-3d"]
    local = solve(case.problem)
    place = ENU.to_ecef(STATIONS[3])
    rows = case.problem.rows
    globe = assemble(
        place,
        measured("range", rows[0].z, a=rows[0].a, sigma=5.0),
        measured("height", rows[1].z, sigma=10.0),
        frame=ECEF,
    )
    fix = solve(globe)
    assert fix.status == local.status
    assert np.allclose(ENU.from_ecef(fix.position), local.position, atol=1e-4)
    R = ENU.rotation_to_ecef()
    assert np.allclose(R.T @ fix.cov @ R, local.cov, rtol=1e-6, atol=1e-8)
    for mine, theirs in zip(fix.geodetic, local.geodetic, strict=True):
        assert mine == pytest.approx(theirs, rel=1e-9)
    assert fix.geodetic[2] == pytest.approx(rows[1].z[0], abs=60.0)


def test_ecef_far_from_the_origin_loses_no_digits():
    place = ENU.to_ecef(STATIONS[3])
    a = np.arange(1, len(place))
    exact = simulate(assemble(place, measured("tdoa", a=a, b=0, sigma=1e-3), frame=ECEF), ENU.to_ecef(TARGET[3]), 2)
    fix = solve(exact)
    assert fix.status == Status.OK
    assert np.linalg.norm(fix.position - ENU.to_ecef(TARGET[3])) < 0.02


def test_a_fix_and_a_problem_survive_pickling():
    fix = many()
    again = pickle.loads(pickle.dumps(fix))
    assert np.array_equal(again.x, fix.x)
    assert again.layout == fix.layout
    problem = pickle.loads(pickle.dumps(CASES["tdoa-3d"].problem))
    assert problem.structure == CASES["tdoa-3d"].problem.structure
