"""Independent routes to one answer: IPOPT, Newton on three satellites, the truth as a start of a bistatic course."""

import numpy as np
import pytest
from cases import CASES
from often import few
from verdicts import alone

import optloc
from optloc import Motion, Status, assemble, measured, simulate, solve
from optloc.base.frames import geodetic_to_ecef
from optloc.engine import predict
from optloc.linear.constraints import height
from optloc.models.primitives import geodetic_normal
from optloc.problem import ECEF

SATELLITES = geodetic_to_ecef(*np.radians([[24.44, 25.09, 24.44], [125.21, 125.68, 125.99]]), np.full(3, 800e3))


@pytest.mark.parametrize("name", few((name for name in CASES if not name.startswith("height")), 18))
def test_ipopt_and_the_refinement_agree(name):
    case = CASES[name]
    problem = simulate(case.problem, case.truth, seed=11, trials=3)
    ours, theirs = solve(problem, "roots+lsr"), solve(problem, "roots+nlp")
    both = (ours.code == Status.OK) & (theirs.code == Status.OK)
    sigma = np.sqrt(np.diagonal(ours.cov, axis1=-2, axis2=-1))
    n = sigma.shape[-1]
    assert np.all(np.abs(ours.x[both, :n] - theirs.x[both, :n]) < 1e-6 * sigma[both])


def visible(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and heights of targets that see all three satellites."""
    rng = np.random.default_rng(12)
    away, bearing = np.radians(24.0 * np.sqrt(rng.uniform(size=3 * count))), rng.uniform(0.0, 2.0 * np.pi, 3 * count)
    latitude = np.radians(24.6) + away * np.cos(bearing)
    longitude = np.radians(125.6) + away * np.sin(bearing) / np.cos(np.radians(24.6))
    up = rng.uniform(0.0, 500.0, 3 * count)
    x = geodetic_to_ecef(latitude, longitude, up)
    normal = np.stack(geodetic_normal((x[:, 0], x[:, 1], x[:, 2])), axis=-1)
    seen = (((SATELLITES - x[:, None]) * normal[:, None]).sum(-1) > 0.0).all(1)
    return x[seen][:count], up[seen][:count]


def nearest(fix: optloc.Fix, x: np.ndarray) -> np.ndarray:
    """Return the distance of the nearest listed position."""
    points = np.concatenate([fix.x[:, None], fix.alternatives.x], axis=1)
    return np.nanmin(np.linalg.norm(points - x[:, None], axis=-1), axis=1)


@pytest.mark.parametrize("count", few([50, 2000], 1))
def test_three_satellites_and_a_height_find_every_visible_target(count):
    x, up = visible(count)
    template = assemble(
        SATELLITES, measured("tdoa", a=[0, 0], b=[1, 2], sigma=1e-3), frame=ECEF, constraints=[height(exactly=up)]
    )
    fix = solve(template.with_rows(z=predict(template, x)))
    clear = alone(fix)
    assert np.linalg.norm(fix.x - x, axis=1)[clear].max() < 1e-3
    assert set(fix.code[~clear].tolist()) <= {int(Status.AMBIGUOUS)}
    assert nearest(fix, x).max() < 1e-3
    assert clear.mean() > 0.98


def newton(x: np.ndarray, z: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return where Newton's iteration from x meets two range differences and a height."""
    for _ in range(30):
        line = x - SATELLITES
        r = np.linalg.norm(line, axis=1)
        u = line / r[:, None]
        normal = np.array(geodetic_normal(tuple(x)))
        misfit = np.array([*z, up]) - [r[0] - r[1], r[0] - r[2], ECEF.to_geodetic(x)[2]]
        x = x + np.linalg.solve(np.stack([u[0] - u[1], u[0] - u[2], normal]), misfit)
    return x


def test_three_satellites_with_noise_end_where_newton_from_the_truth_does():
    x, up = visible(40)
    template = assemble(
        SATELLITES, measured("tdoa", a=[0, 0], b=[1, 2], sigma=15.0), frame=ECEF, constraints=[height(exactly=up)]
    )
    problem = simulate(template, x, seed=13)
    fix = solve(problem)
    with np.errstate(all="ignore"):
        expected = np.array([newton(*row) for row in zip(x, problem.z, up, strict=True)])
    met = np.isfinite(expected).all(1) & (np.linalg.norm(expected - x, axis=1) < 50e3)
    assert met.mean() > 0.9
    assert nearest(fix[met], expected[met]).max() < 1e-3


def test_the_relaxation_that_knows_the_height_is_the_answer_of_sdp_alone():
    x, up = visible(20)
    template = assemble(
        SATELLITES, measured("tdoa", a=[0, 0], b=[1, 2], sigma=15.0), frame=ECEF, constraints=[height(exactly=up)]
    )
    drawn = simulate(template, x, seed=14)
    alone, refined = solve(drawn, "sdp", refine=False).position, solve(drawn, "sdp+lsr").position
    assert np.median(np.linalg.norm(alone - refined, axis=1)) < 1.0


@pytest.mark.parametrize("trials", few([10, 30], 1))
@pytest.mark.parametrize("order", [0, 1])
def test_one_receiver_and_one_illuminator_reach_the_minimum_beside_the_truth(order, trials):
    epochs = np.arange(30)
    zero, one = np.zeros_like(epochs), np.ones_like(epochs)
    template = assemble(
        np.array([[0.0, 0.0, 0.0], [150e3, 0.0, 0.0]]),
        measured("range_sum", a=zero, b=one, epoch=epochs, sigma=6.0),
        measured("azimuth", a=zero, epoch=epochs, sigma=np.radians(1.0)),
        measured("elevation", a=zero, epoch=epochs, sigma=np.radians(1.0)),
        motions=[Motion(order=order)],
    )
    truth = np.array([10031.0, 79960.0, 9962.0, 4.0, 10.0, 6.0])[: 3 * (order + 1)]
    problem = simulate(template, truth, seed=14, trials=trials)
    fix, beside = solve(problem), solve(problem, "lsr", start=truth)
    assert alone(fix).all()
    assert fix.has(Status.CURVED).all()  # a degree at 80 km, and ranges of 6 m: an arc
    assert np.all(fix.cost <= beside.cost + 1e-6 * (1.0 + beside.cost))
