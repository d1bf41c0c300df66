"""A smaller sigma never turns `ok` into `unproven`: exact measurements, whose noise is stated ever finer."""

from __future__ import annotations

import numpy as np
import pytest
from often import few
from verdict.exact import COUNT, draw

from optloc import Frame, Motion, Status, assemble, certify, constraints, measured, solve
from optloc.kernels.jit import enabled
from optloc.linear.evaluate import predict
from optloc.problem import ECEF
from optloc.proof.local_search import COARSE
from optloc.solvers.certificates.branch_and_bound import FINE
from optloc.solvers.certificates.position_cost import eliminate_nuisance, prove

Array = np.ndarray
needs_code = pytest.mark.skipif(not enabled(), reason="proofs around the Earth take thousands of boxes")


def exactly(problem, x):
    """Return a problem with what it measures of a parameter vector, whose last entries are zero."""
    x = np.concatenate([x, np.zeros(problem.layout.size - len(x))])
    return problem.with_rows(z=predict(problem, x))


def above(place: Array, count: int, radius: float, rng: np.random.Generator, least: float = 15.0) -> Array:
    """Return satellites at a radius that stand above an elevation in degrees."""
    up, out = place / np.linalg.norm(place), []
    while len(out) < count:
        way = rng.standard_normal(3)
        one = radius * way / np.linalg.norm(way)
        if (one - place) @ up > np.sin(np.radians(least)) * np.linalg.norm(one - place):
            out.append(one)
    return np.array(out)


@needs_code
@pytest.mark.parametrize("number", few(range(6), 4))
def test_three_satellites_and_an_exact_height(number):
    """The truth is the only minimum that is visible, or another one costs as little: never is there no proof."""
    rng = np.random.default_rng(number)
    lat, lon, level = np.arcsin(rng.uniform(-1.0, 1.0)), rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 9e3)
    x = np.asarray(ECEF.from_geodetic(lat, lon, level))
    place = above(x, 3, (26.56e6, 7.2e6, 42.16e6)[number % 3], rng)
    kind = ("tdoa", "toa")[number // 3]
    told = []
    for sigma in (100.0, 1.0, 0.1):
        rows = (
            measured("tdoa", a=[1, 2], b=0, arrival_sigma=sigma)
            if kind == "tdoa"
            else measured("toa", a=[0, 1, 2], sigma=sigma)
        )
        problem = assemble(place, rows, frame=ECEF, constraints=constraints.height(exactly=level))
        fix = solve(exactly(problem, x))
        told.append(fix.status)
        if fix.status is Status.OK:
            assert np.linalg.norm(fix.position - x) < 1e-6
            assert fix.certificate.unique
    assert Status.UNPROVEN not in told
    assert len(set(told)) == 1


@needs_code
@pytest.mark.parametrize(("lat", "lon"), [(89.9, 10.0), (-35.0, 179.99)])
def test_bearings_that_meet_the_surface_again_on_the_other_side(lat, lon):
    """Planes of bearings through a local vertical cut the surface of a height twice, once at the antipodes."""
    frame, reach = Frame.enu(lat_deg=lat, lon_deg=lon), 4e4
    rng = np.random.default_rng(7)
    place = np.column_stack([rng.uniform(-reach, reach, (5, 2)), rng.uniform(0.0, 300.0, 5)])
    lat_of, lon_of, _ = frame.to_geodetic(np.array([3e3, 2e4, 2e3]))
    x = np.asarray(frame.from_geodetic(lat_of, lon_of, 2e3))
    for sigma in (1e-3, 1e-5, 1e-9):
        rows = measured("azimuth", a=np.arange(5), sigma=sigma)
        fix = solve(exactly(assemble(place, rows, frame=frame, constraints=constraints.height(exactly=2e3)), x))
        assert fix.status is Status.OK, (sigma, str(fix.reason))


@needs_code
@pytest.mark.parametrize("kind", ["range", "tdoa", "azimuth", "toa"])
def test_a_target_that_moves(kind):
    rng, epochs, size = np.random.default_rng(11), 7, 1e4
    place, times = size * rng.uniform(-1.0, 1.0, (4, 2)), np.linspace(0.0, 30.0, 7)
    x = np.array([2e3, -3e3, 60.0, 40.0])
    limits = (*constraints.box([-5e4, -5e4], [5e4, 5e4]), *constraints.speed(400.0))
    for share in (1e-4, 1e-9):
        a = np.tile(np.arange(1 if kind == "tdoa" else 0, 4), epochs)
        epoch = np.repeat(np.arange(epochs), len(a) // epochs)
        sigma = share if kind == "azimuth" else share * size
        rows = measured(kind, a=a, b=0 if kind == "tdoa" else None, epoch=epoch, sigma=sigma)
        motion = Motion(1, reference=float(times.mean()))
        fix = solve(exactly(assemble(place, rows, times=times, motions=(motion,), constraints=limits), x))
        assert fix.status is Status.OK, (share, str(fix.reason))


def test_a_height_that_is_held_is_refined_however_fine_the_noise():
    """Coordinates that are put back onto a height are off by a rounding from the Earth's centre."""
    rng, frame = np.random.default_rng(2), Frame.enu(lat_deg=47.0, lon_deg=9.0)
    place = np.column_stack([rng.uniform(-5e3, 5e3, (6, 2)), rng.uniform(0.0, 500.0, 6)])
    x = np.asarray(frame.from_geodetic(*frame.to_geodetic(np.array([1.3e3, -7.4e3, 1.1e4]))[:2], 10951.0))
    for sigma in (1e-3, 5e-6):
        rows = measured("tdoa", a=np.arange(1, 6), b=0, arrival_sigma=sigma)
        fix = solve(exactly(assemble(place, rows, frame=frame, constraints=constraints.height(exactly=10951.0)), x))
        assert fix.answered, str(fix.reason)
        assert np.linalg.norm(fix.position - x) < 1e-6


@needs_code
@pytest.mark.parametrize(("kind", "count", "reach"), [("toa", 5, 3.7e3), ("toa", 6, 3.2e3), ("tdoa", 6, 3.2e3)])
def test_a_small_network_in_coordinates_from_the_centre_of_the_earth(kind, count, reach):
    """Coordinates are a thousand times as large as ranges: lines to stations keep their digits, and so do costs."""
    rng = np.random.default_rng([count, len(kind)])
    frame, level = Frame.enu(lat_deg=rng.uniform(-80.0, 80.0), lon_deg=rng.uniform(-180.0, 180.0)), 9e3
    flat = np.column_stack([rng.uniform(-reach, reach, (count, 2)), rng.uniform(0.0, 500.0, count)])
    place = flat @ frame.rotation_to_ecef().T + frame.origin_ecef()
    lat, lon, _ = frame.to_geodetic(np.array([*rng.uniform(-1.5 * reach, 1.5 * reach, 2), level]))
    x = np.asarray(ECEF.from_geodetic(lat, lon, level))
    ends = {"a": np.arange(1, count), "b": 0} if kind == "tdoa" else {"a": np.arange(count)}
    for share in (1e-6, 1e-9):
        rows = measured(kind, sigma=share * reach, **ends)
        fix = solve(exactly(assemble(place, rows, frame=ECEF, constraints=constraints.height(exactly=level)), x))
        assert fix.status is Status.OK, (share, str(fix.reason))
        assert np.linalg.norm(fix.position - x) < 1e-6


@pytest.mark.parametrize("kind", ["range", "tdoa"])
def test_what_rounding_hides_is_not_claimed(kind):
    """Beyond double precision there is no proof, the reason is true, and a bound is below the cost by the rounding."""
    rng = np.random.default_rng(4)
    place, x = 1e7 * rng.uniform(-1.0, 1.0, (5, 2)), np.array([1e6, 2e6])
    more = {"b": 0, "a": np.arange(1, 5)} if kind == "tdoa" else {"a": np.arange(5)}

    def of(sigma):
        return exactly(assemble(place, measured(kind, sigma=sigma, **more)), x)

    good, fine, none = (solve(of(sigma)) for sigma in (1e-2, 1e-4, 1e-9))
    assert good.status is fine.status is Status.OK
    assert good.certificate.gap <= 2e-6
    assert 2e-6 < fine.certificate.gap < 1.0
    assert none.status is Status.UNPROVEN
    assert str(none.reason) == FINE


@pytest.mark.parametrize("noise", [1.0, 30.0])
def test_bounds_are_below_the_cost_of_noisy_fixes_of_fine_noise(noise):
    """What counts as equal grows with the cost: the fix of noisy data is found to be the best one all the same."""
    rng = np.random.default_rng(8)
    place, x, sigma = 2.66e7 * rng.uniform(-1.0, 1.0, (7, 3)), np.array([1e6, 2e6, 3e6]), 1e-2
    z = np.linalg.norm(place - x, axis=1) + noise * sigma * rng.standard_normal(7)
    problem = assemble(place, measured("range", z, a=np.arange(7), sigma=sigma))
    fix = certify(problem, solve(problem))
    assert fix.certificate.unique
    assert fix.certificate.bound <= float(fix.cost)
    assert fix.certificate.gap < 0.1 * (1.0 + float(fix.cost))


def test_a_question_that_rounding_cannot_answer_has_a_verdict_of_its_own():
    problem = exactly(
        assemble(
            1e7 * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]), measured("range", a=range(4), sigma=1e-10)
        ),
        np.array([3e6, 4e6]),
    ).flat()
    from optloc.proof.batch import ProofRequest

    one, none = np.zeros(1, dtype=np.int64), np.full((1, 2, 2), np.nan)
    asked = ProofRequest(
        x=np.array([[3e6, 4e6]]),
        others=np.zeros((1, 0, 2)),
        known=one,
        hidden=one,
        gaps=np.array([[25.0, 0.0]]),
        eps=np.array([1e-6]),
        region=none,
        fallback=none,
        budget=np.array([500]),
        planes=np.zeros((1, 0, 3)),
        surface=np.zeros((1, 0)),
    )
    answer = prove(eliminate_nuisance(problem), asked)
    assert answer.verdict[0] == COARSE
    assert answer.bound[0] == -np.inf


# Sigma over range: from here down every step is tried.
COARSEST, STEPS = 1e-2, 8


def turned_unproven(number: int, steps) -> tuple[str, list[str]]:
    """Return the name of a scene that is `ok` at a sigma and `unproven` at one up to a thousand times finer, or none.

    Statuses of all steps are returned as well.
    """
    scene = draw(number)
    told = [solve(scene.problem(share)).status for share in steps]
    labels = [status.label for status in told]
    for i, share in enumerate(steps):
        later = [one for one, finer in zip(told, steps, strict=True) if share > finer > 0.9e-3 * share]
        if told[i] is Status.OK and Status.UNPROVEN in later:
            return f"{number}: {scene.name}", labels
    return "", labels


@needs_code
def test_a_finer_sigma_leaves_fixes_proven():
    """Some scenes of all families in the plain run; five hundred in full, fifty for each seed.

    The last two are small beside their coordinates: a network, and a course over ground with many rows.
    """
    found = [turned_unproven(number, (1e-6, 1e-9)) for number in (*range(99, 115), 167, 206)]
    assert [name for name, _ in found if name] == []
    assert sum("ok" in labels for _, labels in found) > 10


@needs_code
@pytest.mark.full
def test_a_finer_sigma_leaves_fixes_proven_in_full(seed):
    steps = [COARSEST * 10.0**-k for k in range(STEPS)]
    found = [turned_unproven(COUNT * seed + k, steps) for k in range(COUNT)]
    assert [name for name, _ in found if name] == []
    assert sum("ok" in labels for _, labels in found) > COUNT // 2
