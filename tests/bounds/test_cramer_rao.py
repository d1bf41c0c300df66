"""The Cramer-Rao bound: against its textbook form, against all unknowns kept, and in the course of a run."""

from dataclasses import replace

import numpy as np
import pytest

from optloc import InvalidProblem, Motion, Stations, assemble, crlb, measured, with_bias
from optloc.base.frames import Frame
from optloc.bounds.cramer_rao import _inverse, crlb_course
from optloc.bounds.rank import observability
from optloc.lab.papers import registration as scenes
from optloc.linear.constraints import height
from optloc.linear.normal import linearise, prior_parts
from optloc.problem import Prior


def problem_of(epochs, *, moving=True, prior=None, span="noise", station_sigma=1.0, scene=scenes.SPATIAL, gain=None):
    """Return a run of a scene and its true vector; states and offsets of stations are zero."""
    scene = scenes.MOVING if moving and scene is scenes.PRINTED else scene
    problem = scenes.problem(scene, epochs, prior=prior, station_sigma=station_sigma, gain_sigma=gain)
    truth = scenes.truth(scene, problem)
    stations = problem.stations
    if span != "noise" and stations.covariance is not None:
        covariance = stations.covariance
        problem = assemble(
            Stations(stations.position, stations.names, covariance=covariance, span=span),
            measured("tdoa", a=problem.rows[0].a, b=0, epoch=problem.rows[0].epoch, arrival_sigma=scene.sigma),
            times=problem.times,
            motions=problem.motions,
        )
        problem = with_bias(problem, "delay", per="pair", sigma=prior)
        truth = np.concatenate([truth, np.zeros(problem.layout.size - len(truth))])
    return problem, truth


def by_hand(problem, truth):
    """Return the bound of the shared unknowns from one dense matrix over all unknowns, local ones kept."""
    layout, linear = problem.layout, linearise(problem, truth)
    jacobian = np.zeros((problem.count, layout.size))
    jacobian[:, : layout.n_shared] = linear.shared
    for row, epoch in enumerate(problem.epoch):
        start = layout.n_shared + epoch * layout.n_local
        jacobian[row, start : start + layout.n_local] = linear.local[row]
    covariance = np.zeros((problem.count, problem.count))
    for block in problem.noise.blocks:
        for group, rows in enumerate(block.row):
            covariance[np.ix_(rows, rows)] = block.covariance[group if len(block.covariance) > 1 else 0]
    information = jacobian.T @ np.linalg.solve(covariance, jacobian)
    for name, _, precision in prior_parts(problem):
        slot, shared = layout.find(name)
        for epoch in [None] if shared else range(layout.epochs):
            start = slot.start + (0 if shared else layout.n_shared + epoch * layout.n_local)
            part = slice(start, start + slot.size)
            information[part, part] += precision if shared else precision[0]
    scale = 1.0 / np.sqrt(np.diagonal(information))
    inverse = np.linalg.inv(information * scale[:, None] * scale) * scale[:, None] * scale
    return inverse[: layout.n_shared, : layout.n_shared]


@pytest.mark.parametrize("prior", [None, 200.0])
@pytest.mark.parametrize("span", ["epoch", "run"])
def test_eliminated_station_errors_are_those_of_the_full_matrix(span, prior):
    problem, truth = problem_of(12, span=span, prior=prior)
    assert problem.layout.size == 7 + (12 if span == "epoch" else 1) * 15
    full = by_hand(problem, truth)
    np.testing.assert_allclose(crlb(problem, truth), full, rtol=1e-8, atol=1e-8 * np.abs(full).max())
    course = crlb_course(problem, truth).covariance[-1]
    np.testing.assert_allclose(course, full, rtol=1e-7, atol=1e-8 * np.abs(full).max())


@pytest.mark.parametrize("prior", [None, 200.0])
def test_station_errors_as_noise_or_as_unknowns_bound_alike(prior):
    one, two = (crlb_course(*problem_of(60, span=span, prior=prior)) for span in ("noise", "epoch"))
    np.testing.assert_allclose(one.covariance[10:], two.covariance[10:], rtol=1e-6)


@pytest.mark.parametrize(
    ("scene", "epochs", "sigma", "expected"),
    [
        ("PRINTED", 600, 1.0, 40.2826),
        ("PRINTED", 600, 5.0, 74.2775),
        ("PRINTED", 700, 1.0, 29.7915),
        ("MOVING", 600, 1.0, 602.48),
    ],
)
def test_numbers_of_an_independent_computation(scene, epochs, sigma, expected):
    problem, truth = problem_of(epochs, scene=getattr(scenes, scene), moving=scene == "MOVING", station_sigma=sigma)
    course = crlb_course(problem, truth, [epochs])
    assert course.total("position")[0] == pytest.approx(expected, rel=2e-5)


@pytest.mark.parametrize(
    "options",
    [{}, {"prior": 200.0}, {"gain": 3e-4}, {"scene": scenes.PRINTED}],
    ids=["unknown", "prior", "gain ratios", "moving target"],
)
def test_the_course_is_the_bound_of_each_shorter_run(options):
    problem, truth = problem_of(120, **options)
    course = crlb_course(problem, truth)
    np.testing.assert_array_equal(course.counts, np.arange(1, 121))
    np.testing.assert_array_equal(course.times, problem.times)
    for count in (30, 77, 120):
        own, x = problem_of(count, **options)
        bound = crlb(own, x)
        scale = np.sqrt(np.diagonal(bound))
        difference = (course.covariance[count - 1] - bound) / scale / scale[:, None]
        assert np.abs(difference).max() < 1e-5
    known = np.isfinite(course.covariance).all((-1, -2))
    assert (np.diff(known.astype(int)) >= 0).all()
    total = course.total("position")[known]
    assert (np.diff(total) < 0.0).all()


def test_known_biases_leave_the_bound_of_a_problem_without_them():
    problem, truth = problem_of(200, moving=False, scene=scenes.PRINTED)
    free = assemble(
        problem.stations,
        measured("tdoa", a=problem.rows[0].a, b=0, epoch=problem.rows[0].epoch, arrival_sigma=3.0),
        times=problem.times,
    )
    course = crlb_course(problem, truth, [1, 200], known=["delay"])
    np.testing.assert_allclose(course.covariance[-1, :3, :3], crlb(free, truth[:3]), rtol=1e-8)
    assert (course.sigma("delay") == 0.0).all()
    unknown = crlb_course(problem, truth, [200])
    assert unknown.total("position")[0] > 3.0 * course.total("position")[1]
    # A prior as narrow as the noise of the mean is worth as much as knowledge; a wide one nothing.
    for prior, rel in ((1e-4, 1e-4), (1e6, None)):
        with_prior, _ = problem_of(200, moving=False, scene=scenes.PRINTED, prior=prior)
        wanted = course.total("position")[1] if rel else unknown.total("position")[0]
        assert crlb_course(with_prior, truth, [200]).total("position")[0] == pytest.approx(wanted, rel=1e-4)


def test_what_is_not_yet_determined_is_nan():
    problem, truth = problem_of(30)
    course = crlb_course(problem, truth)
    assert np.isnan(course.covariance[0]).all()
    assert np.isfinite(course.covariance[-1]).all()
    assert np.isfinite(crlb_course(problem_of(5, prior=200.0)[0], truth).covariance[0]).all()


def test_free_positions_and_emission_times_are_eliminated():
    """Clocks of six stations that hear pulses from anywhere: the bound is that of the full matrix."""
    rng = np.random.default_rng(1)
    epoch, a = np.repeat(np.arange(9), 6), np.tile(np.arange(6), 9)
    problem = assemble(
        rng.uniform(-5e3, 5e3, (6, 3)), measured("toa", a=a, epoch=epoch, sigma=3.0), motions=[Motion(0, "epoch")]
    )
    problem = with_bias(problem, "clock", sigma=50.0)
    x = np.zeros(problem.layout.size)
    x[6:] = rng.uniform(-9e3, 9e3, 36)
    np.testing.assert_allclose(crlb_course(problem, x).covariance[-1], by_hand(problem, x), rtol=1e-6)


def test_a_position_prior_counts_once():
    problem = assemble(
        np.array([[0.0, 0.0], [4e3, 0.0], [0.0, 3e3]]),
        measured("range", a=np.tile([0, 1, 2], 5), epoch=np.repeat(np.arange(5), 3), sigma=10.0),
        priors=[Prior("position", np.zeros(2), np.diag([100.0, 400.0]))],
    )
    x = np.array([1e3, 2e3])
    each = np.linalg.inv(crlb(problem, x)) - np.diag([1 / 100.0, 1 / 400.0])
    for k, bound in enumerate(crlb_course(problem, x).covariance, start=1):
        np.testing.assert_allclose(np.linalg.inv(bound), each * k / 5 + np.diag([1 / 100.0, 1 / 400.0]), rtol=1e-9)


def test_equalities_leave_the_bound_of_their_surface():
    """A known height is worth as much as measuring it almost exactly, alone, in a batch and in the course of a run."""
    frame, rng = Frame.enu(lat_deg=47.0, lon_deg=8.0, height=400.0), np.random.default_rng(4)
    places = rng.uniform(-5e3, 5e3, (5, 3))
    rows = measured("range", a=np.tile(np.arange(5), 3), epoch=np.repeat(np.arange(3), 5), sigma=3.0)
    x = np.array([9e3, 3e3, 800.0, 0.0])
    h = float(frame.to_geodetic(x[:3])[2])
    biased = with_bias(assemble(places, rows, frame=frame, constraints=[height(exactly=h)]), "delay", per="kind")
    measuring = measured("height", z=[h], sigma=1e-4)
    free = with_bias(assemble(places, rows, measuring, frame=frame), "delay", per="kind", kind="range")
    bound = crlb(biased, x)
    np.testing.assert_allclose(bound, crlb(free, x), rtol=1e-5, atol=1e-5)
    assert np.linalg.matrix_rank(bound, tol=1e-9) == 3
    np.testing.assert_allclose(crlb(biased, np.stack([x, x]))[1], bound)
    np.testing.assert_allclose(crlb_course(biased, x, [3]).covariance[0], bound, rtol=1e-9, atol=1e-9)
    known = crlb_course(biased, x, [3], known=["delay"]).covariance[0]
    np.testing.assert_allclose(known[:3, :3], crlb(replace(biased, biases=()), x[:3]), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diagonal(bound)), observability(biased, x).posterior, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"counts": [0]}, "1 to 4"),
        ({"counts": [5]}, "1 to 4"),
        ({"known": ["clock"]}, "'clock'.*position, velocity, delay"),
    ],
)
def test_mistakes(options, words):
    problem, truth = problem_of(4, scene=scenes.PRINTED)
    with pytest.raises(InvalidProblem, match=words):
        crlb_course(problem, truth, **options)


def test_epochs_tied_by_noise_have_no_course():
    tied = assemble(
        np.array([[0.0, 0.0], [4e3, 0.0], [0.0, 3e3]]),
        measured("range", a=[0, 1, 2], epoch=[0, 0, 1], covariance=np.eye(3) + 0.5),
    )
    with pytest.raises(InvalidProblem, match="correlates the epochs"):
        crlb_course(tied, np.array([1e3, 1e3]))


@pytest.mark.filterwarnings("error")
def test_information_beyond_all_numbers_is_as_good_as_none():
    information = np.array([np.full((2, 2), np.inf), [[4.0, 0.0], [0.0, 1.0]]])
    found = _inverse(information, np.array([[np.inf, np.inf], [4.0, 1.0]]), np.eye(2))
    assert np.isnan(found[0]).all()
    assert found[1] == pytest.approx(np.diag([0.25, 1.0]))
    hardly = np.diag([1e-310, 1e-310])  # its inverse is beyond all numbers
    assert not np.isfinite(_inverse(hardly[None], np.full((1, 2), 1e-310), np.eye(2))).any()
