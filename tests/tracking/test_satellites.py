"""Three satellites and a height: four filters, their bound, starts, and what is done about the height."""

from dataclasses import replace

import numpy as np
import pytest
from often import few

from optloc import InvalidProblem, Motion, assemble, measured, simulate, solve, station_array, with_bias
from optloc.base.frames import ecef_to_geodetic, geodetic_to_ecef
from optloc.base.types import Status
from optloc.linear.constraints import height as known_height
from optloc.problem import ECEF
from optloc.problem.epochs import cut
from optloc.tracking import followed, polynomial
from optloc.tracking.constants import begun_with_constants, followed_with_constants
from optloc.tracking.start import first_fix, state_of, two_point, with_height_rows
from optloc.tracking.track import State
from optloc.tracking.whole_run import posterior_bound

SAT = geodetic_to_ecef(np.radians([24.44, 25.09, 24.44]), np.radians([125.21, 125.68, 125.99]), np.full(3, 800e3))
P0 = geodetic_to_ecef(np.radians(25.80), np.radians(127.37), 0.0)
V0 = np.array([20.0, 20.0, 0.0])
SR, SH, DRIVE = 50e-9 * 299792458.0, 500.0, 0.01
DYNAMICS = polynomial(1, DRIVE)


def run(epochs, height=SH, order=1, satellites=SAT):
    k = np.arange(epochs)
    rows = [measured("tdoa", a=0, b=np.tile([1, 2], epochs), epoch=np.repeat(k, 2), sigma=SR)]
    rows += [measured("height", epoch=k, sigma=height)] if height is not None else []
    made = assemble(station_array(satellites), *rows, frame=ECEF, motions=[Motion(order)])
    return made if height is not None else replace(made, constraints=known_height(exactly=0.0))


def truth(epochs):
    return np.concatenate([P0 + np.arange(epochs)[:, None] * V0, np.broadcast_to(V0, (epochs, 3))], axis=1)


def draw(epochs, trials, seed, **options):
    return simulate(run(epochs, **options), truth(1)[0], seed, trials)


def fixes(problem):
    # Filters begin with places and covariances: a proof of each fix would be most of the time.
    return [solve(replace(cut(problem, k, k + 1), motions=(Motion(0),)), "searched") for k in (0, 1)]


def from_fixes(problem):
    return two_point(*fixes(problem), (0.0, 1.0))


# --- a second, plain implementation, from the equations alone ---


def geodetic(x):
    """Return exact height and normal, by the fixed point of the latitude."""
    a, f = 6378137.0, 1 / 298.257223563
    e2, p = f * (2 - f), np.hypot(x[0], x[1])
    phi = np.arctan2(x[2], p * (1 - e2))
    for _ in range(20):
        N = a / np.sqrt(1 - e2 * np.sin(phi) ** 2)
        phi = np.arctan2(x[2] + e2 * N * np.sin(phi), p)
    lam = np.arctan2(x[1], x[0])
    h = p * np.cos(phi) + x[2] * np.sin(phi) - a * np.sqrt(1 - e2 * np.sin(phi) ** 2)
    return h, np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])


def plain_h(x):
    r = np.linalg.norm(x[:3] - SAT, axis=1)
    return np.array([r[0] - r[1], r[0] - r[2], geodetic(x[:3])[0]])


def plain_rows(x):
    u = (x[:3] - SAT) / np.linalg.norm(x[:3] - SAT, axis=1)[:, None]
    return np.hstack([np.array([u[0] - u[1], u[0] - u[2], geodetic(x[:3])[1]]), np.zeros((3, 3))])


def plain_g(x, y):
    """Return an exact g of ranges and height: h(x) - h(y) = g (x - y)."""
    r = np.linalg.norm(x[:3] - SAT, axis=1) + np.linalg.norm(y[:3] - SAT, axis=1)
    ranges = (x[:3] + y[:3] - 2 * SAT) / r[:, None]
    (hx, nx), (hy, ny) = geodetic(x[:3]), geodetic(y[:3])
    d, n = x[:3] - y[:3], 0.5 * (nx + ny)
    n = n + (hx - hy - n @ d) * d / (d @ d)
    return np.hstack([np.array([ranges[0] - ranges[1], ranges[0] - ranges[2], n]), np.zeros((3, 3))])


F = np.block([[np.eye(3), np.eye(3)], [np.zeros((3, 3)), np.eye(3)]])
W = DRIVE**2 * np.block([[np.eye(3) / 4, np.eye(3) / 2], [np.eye(3) / 2, np.eye(3)]])
R = np.diag([SR**2, SR**2, SH**2])


def plain_filter(name, x, P, zs):
    """Return states (k, 6) and covariances (k, 6, 6) of one run; the state is predicted before each scan."""
    out = []
    for z in zs:
        x, P = F @ x, F @ P @ F.T + W
        H = plain_rows(x)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        new, A, gain = x + K @ (z - plain_h(x)), H, K
        if name == "iekf":
            for _ in range(30):
                A = plain_rows(new)
                gain = P @ A.T @ np.linalg.inv(A @ P @ A.T + R)
                new = x + gain @ (z - plain_h(new) - A @ (x - new))
        if name == "mgekf":
            A = plain_g(new, x)
        if name == "mvekf":
            A = plain_rows(new)
            gain = P @ A.T @ np.linalg.inv(A @ P @ A.T + R)
        left = np.eye(6) - gain @ A
        x, P = new, left @ P @ left.T + gain @ R @ gain.T
        out.append((x, P))
    return [np.array(part) for part in zip(*out, strict=True)]


def scans_of(problem, trial, epochs):
    z = problem.z[trial]
    return np.column_stack([z[: 2 * epochs].reshape(-1, 2), z[2 * epochs :]])


def far_start(width, trials, seed):
    sigma = np.repeat([width, 50.0], 3)
    mean = truth(1)[0] - np.concatenate([V0, np.zeros(3)])
    mean = mean + sigma * np.random.default_rng(seed).standard_normal((trials, 6))
    return State(-1.0, mean, np.broadcast_to(np.diag(sigma**2), (trials, 6, 6)))


@pytest.mark.parametrize("width", few([30e3, 1e3], 1))
@pytest.mark.parametrize("name", ["ekf", "iekf", "mgekf", "mvekf"])
def test_one_run_is_that_of_a_plain_implementation(name, width):
    problem, start = draw(40, 2, 1), far_start(width, 2, 2)
    found = followed(problem, start, DYNAMICS, name)
    for i in range(2):
        x, P = plain_filter(name, start.mean[i], start.cov[i], scans_of(problem, i, 40))
        error = np.linalg.norm(x[:, :3] - truth(40)[:, :3], axis=1)
        apart = np.linalg.norm(found.position[i] - x[:, :3], axis=1)
        sigma, wanted = (np.sqrt(np.diagonal(c, 0, -2, -1)) for c in (found.cov[i], P))
        if name == "mgekf":  # its g is not unique
            assert (apart <= 0.01 * np.maximum(error, wanted[:, :3].max(1))).all()
            assert sigma == pytest.approx(wanted, rel=0.01)
        else:
            assert apart.max() < 1e-3
            assert sigma == pytest.approx(wanted, rel=1e-6)


def test_the_mean_derivative_is_a_g():
    x, y = P0 + np.array([3e4, -2e4, 1e4]), P0
    nodes, weights = np.polynomial.legendre.leggauss(5)
    g = sum(0.5 * w * plain_rows(y + 0.5 * (1 + n) * (x - y)) for n, w in zip(nodes, weights, strict=True))
    for each in (g, plain_g(x, y)):
        assert each[:, :3] @ (x - y) == pytest.approx(plain_h(x) - plain_h(y), abs=1e-5)


def test_two_fixes_have_a_cross_term():
    problem = draw(2, 50, 3)
    one, two = fixes(problem)
    state = two_point(one, two, (0.0, 1.0))
    joint = state_of(problem, first_fix(problem, polynomial(1), 2), 2)
    assert np.abs(state.mean - joint.mean).max() < 1e-4
    assert state.cov == pytest.approx(joint.cov, rel=1e-6, abs=1e-3)
    phi = two.covariance()[0]
    assert state.cov[0, :3, 3:] == pytest.approx(phi)
    assert state.cov[0, 3:, 3:] == pytest.approx(2 * phi, rel=1e-2)
    slower = two_point(one, two, (0.0, 10.0))
    assert slower.cov[0, :3, 3:] == pytest.approx(phi / 10.0)
    assert slower.mean[:, 3:] == pytest.approx(state.mean[:, 3:] / 10.0)
    with pytest.raises(InvalidProblem, match="earlier fix first"):
        two_point(two, one, (1.0, 0.0))


def test_two_point_errors_are_as_large_as_they_say():
    state = from_fixes(draw(2, 200, 4))
    error = state.mean - truth(2)[1]
    nees = (error * np.linalg.solve(state.cov, error[..., None])[..., 0]).sum(-1)
    assert nees.mean() == pytest.approx(6.0, abs=4 * np.sqrt(12 / 200))


def plain_bound(P, epochs):
    """Return the posterior bound (k, 6, 6) in covariance form, by the plain derivatives at the truth."""
    out = []
    for x in truth(epochs + 2)[2:]:
        P = F @ P @ F.T + W
        H = plain_rows(x)
        P = P - P @ H.T @ np.linalg.inv(H @ P @ H.T + R) @ H @ P
        out.append(P)
    return np.array(out)


def test_the_posterior_bound_in_covariance_form():
    phi = np.linalg.inv(plain_rows(truth(2)[1])[:, :3].T @ np.linalg.inv(R) @ plain_rows(truth(2)[1])[:, :3])
    start = State(1.0, truth(2)[1], np.block([[phi, phi], [phi, 2 * phi]]))
    found = posterior_bound(run(202), truth(202), start, DYNAMICS)
    assert found == pytest.approx(plain_bound(start.cov, 200), rel=1e-6, abs=1e-6)
    sizes = np.sqrt(np.trace(found[:, :3, :3], axis1=-2, axis2=-1))
    assert sizes[[0, 9, 49, 99, 199]] == pytest.approx([522.1, 310.5, 156.3, 112.4, 80.2], abs=0.05)
    assert np.linalg.matrix_rank(DYNAMICS.step(1.0, start.mean, 3)[1]) == 3


def errors(track, exact):
    return np.linalg.norm(track.position - exact[len(exact) - len(track.times) :, :3], axis=-1)


def rms(values):
    return float(np.sqrt((values**2).mean()))


FILTERS = ("ekf", "iekf", "mgekf", "mvekf")


def test_from_fixes_the_four_filters_are_one_and_consistent():
    problem = draw(82, 60, 5)
    start = from_fixes(problem)
    tracks = {name: followed(problem, start, DYNAMICS, name) for name in FILTERS}
    for track in tracks.values():
        assert np.linalg.norm(track.position - tracks["ekf"].position, axis=-1)[:, 10:].max() < 1.0
        assert (track.code == Status.OK).all()
    last = tracks["iekf"]
    error = last.mean[:, -1] - truth(82)[-1]
    nees = (error * np.linalg.solve(last.cov[:, -1], error[..., None])[..., 0]).sum(-1)
    assert nees.mean() == pytest.approx(6.0, abs=4 * np.sqrt(12 / 60))
    assert last.nis.mean() == pytest.approx(3.0, abs=4 * np.sqrt(6 / last.nis.size))


def ideal(problem, start, epochs):
    """Return the position errors of the filter that knows where to linearise: its mean square is the bound."""
    z = np.stack([scans_of(problem, i, epochs) for i in range(len(start.mean))])
    x, P = start.mean, start.cov[0]
    exact = truth(epochs)
    for k in range(epochs):
        x, P = x @ F.T, F @ P @ F.T + W
        H = plain_rows(exact[k])
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        P = P - K @ H @ P
        x = x + (z[:, k] - plain_h(exact[k]) - (x - exact[k]) @ H.T) @ K.T
    return np.linalg.norm(x[:, :3] - exact[-1, :3], axis=-1)


def far_numbers(trials, seed, width=100e3, epochs=100):
    """Return rms errors at the end, of the filters and of the one that knows where to linearise, and the bound."""
    problem, start = draw(epochs, trials, seed), far_start(width, trials, seed + 1)
    found = {name: rms(errors(followed(problem, start, DYNAMICS, name), truth(epochs))[:, -1]) for name in FILTERS}
    begun = from_fixes(problem)
    for name in FILTERS:
        found[f"fixes {name}"] = rms(errors(followed(problem, begun, DYNAMICS, name), truth(epochs))[:, -1])
    bound = posterior_bound(run(epochs), truth(epochs), State(-1.0, truth(1)[0], start.cov[0]), DYNAMICS)
    return found, rms(ideal(problem, start, epochs)), float(np.sqrt(np.trace(bound[-1, :3, :3])))


def check_far(found, limit):
    for name in ("iekf", "mgekf", *(f"fixes {name}" for name in FILTERS)):
        assert found[name] == pytest.approx(limit, rel=0.05), name
    for name in ("ekf", "mvekf"):
        assert found[name] > 2.0 * limit


@pytest.mark.full  # tests/lab/papers/test_satellites.py orders the filters in every run
def test_far_starts_need_iteration_or_none_at_all():
    # The noise of few trials is the same for all filters, the one that sits on the bound among them.
    found, best, bound = far_numbers(60, 6)
    assert bound == pytest.approx(113.4, abs=0.1)
    check_far(found, best)


@pytest.mark.full
def test_far_starts_of_many_trials_against_the_bound():
    found, best, bound = far_numbers(2000, 1)
    assert best == pytest.approx(bound, rel=0.05)
    check_far(found, bound)


def test_a_known_height_is_held():
    up = ECEF.enu_axes(P0)[2]
    course = V0 - (V0 @ up) * up
    problem = simulate(run(102, height=None), np.concatenate([P0, course]), 7, 60)
    held = with_height_rows(problem)
    assert not held.constraints
    track = followed(held, from_fixes(problem), DYNAMICS)
    assert np.abs(ecef_to_geodetic(track.position)[2]).max() < 0.02
    exact = P0 + np.arange(2, 102)[:, None] * course
    claimed = np.sqrt(np.trace(track.cov[..., :3, :3], axis1=-2, axis2=-1)).mean(0)
    found = np.sqrt((np.linalg.norm(track.position - exact, axis=-1) ** 2).mean(0))
    assert claimed[-1] == pytest.approx(45.2, abs=0.5)
    assert found[[20, 50, 99]] == pytest.approx(claimed[[20, 50, 99]], rel=0.3)


def assumed(epochs, trials, seed):
    """Return runs whose height is wrong by a constant, and that constant."""
    made = with_bias(run(epochs, height=1.0), "height", per="kind", kind="height", sigma=500.0)
    wrong = 500.0 * np.random.default_rng(seed).standard_normal((trials, 1))
    vectors = np.concatenate([np.broadcast_to(truth(1)[0], (trials, 6)), wrong], axis=1)
    return simulate(made, vectors, seed), wrong


def test_a_constant_height_error_stays_in_the_covariance():
    problem, wrong = assumed(82, 60, 8)
    track = followed_with_constants(problem, begun_with_constants(problem, DYNAMICS, 2), DYNAMICS)
    assert track.mean.shape == (60, 80, 7)
    error = np.concatenate([track.mean[:, -1, :6] - truth(82)[-1], track.mean[:, -1, 6:] - wrong], axis=1)
    nees = (error * np.linalg.solve(track.cov[:, -1], error[..., None])[..., 0]).sum(-1)
    assert nees.mean() == pytest.approx(7.0, abs=4 * np.sqrt(14 / 60))
    assert np.sqrt(np.trace(track.cov[0, -1, :3, :3])) == pytest.approx(525.0, abs=10.0)
    white = run(82).with_rows(z=problem.z)
    careless = followed(white, from_fixes(white), DYNAMICS)
    claimed = np.sqrt(np.trace(careless.cov[0, -1, :3, :3]))
    assert rms(errors(careless, truth(82))[:, -1]) > 3.0 * claimed


def test_constants_without_process_noise_are_the_batch_fit():
    problem, _ = assumed(30, 3, 9)
    still = polynomial(1)
    track = followed_with_constants(problem, begun_with_constants(problem, still, 2), still)
    fix = solve(replace(problem, motions=(Motion(1, reference=29.0),)), "searched")
    sigma = np.sqrt(np.diagonal(fix.gaussian()[1], axis1=-2, axis2=-1))
    assert (np.abs(track.mean[:, -1] - fix.gaussian()[0]) < 0.02 * sigma).all()
    assert np.sqrt(np.diagonal(track.cov[:, -1], axis1=-2, axis2=-1)) == pytest.approx(sigma, rel=1e-3)


def test_constants_of_no_bias_are_the_plain_filter():
    problem = draw(20, 3, 10)
    start = from_fixes(problem)
    one, two = followed_with_constants(problem, start, DYNAMICS), followed(problem, start, DYNAMICS)
    assert (one.mean == two.mean).all()
    assert (one.cov == two.cov).all()


def test_constants_without_a_row_are_predicted():
    problem, _ = assumed(10, 2, 11)
    weight = np.ones(problem.z.shape)
    weight[:, problem.epoch == 6] = 0.0
    begun = begun_with_constants(problem, DYNAMICS, 2)
    track = followed_with_constants(problem.with_rows(weight=weight), begun, DYNAMICS)
    assert (track.code[:, 4] == Status.TOO_FEW_ROWS).all()
    assert (track.mean[:, 4, 6] == track.mean[:, 3, 6]).all()
    assert track.position[:, 4] == pytest.approx(track.position[:, 3] + track.velocity[:, 3])


def test_constants_that_cannot_be_are_refused():
    problem, _ = assumed(5, 2, 12)
    start = begun_with_constants(problem, DYNAMICS, 2)
    with pytest.raises(InvalidProblem, match="6 numbers"):
        followed_with_constants(problem, State(1.0, start.mean[:, :6], start.cov[:, :6, :6]), DYNAMICS)
    drifting = with_bias(run(5), "height", per="kind", kind="height", form="drift", sigma=1.0)
    with pytest.raises(InvalidProblem, match="changes with time"):
        begun_with_constants(drifting, DYNAMICS, 2)
    with pytest.raises(InvalidProblem, match="several targets"):
        begun_with_constants(replace(problem, motions=(Motion(), Motion())), DYNAMICS, 2)


def test_satellites_that_move_are_stations_that_move():
    epochs, centre = 62, SAT.mean(0)
    axis = np.cross(centre, ECEF.enu_axes(centre)[1])
    axis /= np.linalg.norm(axis)
    angle = 7.4e3 * np.arange(epochs)[:, None, None] / np.linalg.norm(centre)
    along = (SAT @ axis)[:, None] * axis
    orbit = along + (SAT - along) * np.cos(angle) + np.cross(axis, SAT) * np.sin(angle)
    problem = draw(epochs, 60, 13, satellites=orbit)
    start = from_fixes(problem)
    track = followed(problem, start, DYNAMICS)
    bound = posterior_bound(run(epochs, satellites=orbit), truth(epochs), replace(start, cov=start.cov[0]), DYNAMICS)
    limit = np.sqrt(np.trace(bound[..., :3, :3], axis1=-2, axis2=-1))
    found = np.sqrt((errors(track, truth(epochs)) ** 2).mean(0))
    assert found[[10, 30, 59]] == pytest.approx(limit[[10, 30, 59]], rel=0.3)
    nees_error = track.mean[:, -1] - truth(epochs)[-1]
    nees = (nees_error * np.linalg.solve(track.cov[:, -1], nees_error[..., None])[..., 0]).sum(-1)
    assert nees.mean() == pytest.approx(6.0, abs=4 * np.sqrt(12 / 60))
