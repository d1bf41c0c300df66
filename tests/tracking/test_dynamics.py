"""Models of motion: transition, noise and drive against the matrix exponential, closed forms and published numbers."""

import numpy as np
import pytest
from scipy.linalg import expm

from optloc import InvalidProblem
from optloc.lab.papers.angles import printed_transition, printed_variance
from optloc.tracking import current_statistical, polynomial, singer
from optloc.tracking.dynamics import correlated

SHARES = [1e-4, 1e-3, 0.01, 0.05, 0.1, 0.2, 0.5, 0.999999, 1.000001, 2.0, 10.0]


def integrated(alpha, dt):
    """Return F, Q and U of one axis from exponentials of block matrices (Van Loan 1978)."""
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -alpha]])
    F = expm(A * dt)
    noise = np.diag([0.0, 0.0, 2.0 * alpha])
    block = expm(np.block([[-A, noise], [np.zeros((3, 3)), A.T]]) * dt)
    drive = expm(np.block([[A, np.array([[0.0], [0.0], [alpha]])], [np.zeros((1, 4))]]) * dt)[:3, 3]
    return F, block[3:, 3:].T @ block[:3, 3:], drive


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("dt", [0.25, 1.0, 7.0])
def test_correlated_acceleration_equals_the_matrix_exponential(share, dt):
    F, Q, U = correlated(share / dt, dt)
    wanted = integrated(share / dt, dt)
    assert np.abs(F - wanted[0]).max() < 8e-15 * dt**2 + 8e-15
    # Over many time constants it is the block matrix that loses digits: exp(x) and exp(-x) meet in it.
    assert wanted[1] == pytest.approx(Q, rel=2e-13 if share < 5.0 else 1e-6)
    assert np.abs(U - wanted[2]).max() < 1e-14 * (1.0 + dt**2)


def closed(x):
    """Return Q for a step of 1 s and unit variance as the literature prints it."""
    a, e, e2 = x, np.exp(-x), np.exp(-2.0 * x)
    q11 = (1 - e2 + 2 * x + 2 * x**3 / 3 - 2 * x**2 - 4 * x * e) / (2 * a**5)
    q12 = (e2 + 1 - 2 * e + 2 * x * e - 2 * x + x**2) / (2 * a**4)
    q13, q22 = (1 - e2 - 2 * x * e) / (2 * a**3), (4 * e - 3 - e2 + 2 * x) / (2 * a**3)
    q23, q33 = (e2 + 1 - 2 * e) / (2 * a**2), (1 - e2) / (2 * a)
    return 2 * a * np.array([[q11, q12, q13], [q12, q22, q23], [q13, q23, q33]])


@pytest.mark.parametrize(("share", "within"), [(0.5, 1e-12), (1.0, 1e-13), (2.0, 1e-13), (0.1, 1e-9), (0.05, 2e-8)])
def test_noise_equals_the_closed_form_where_that_has_digits(share, within):
    assert correlated(share, 1.0)[1] == pytest.approx(closed(share), rel=within)


def test_the_closed_form_is_useless_for_small_steps_and_ours_is_not():
    off = abs(closed(1e-4)[0, 0] / correlated(1e-4, 1.0)[1][0, 0] - 1.0)
    assert off > 10.0
    for x in (1e-9, 1e-6, 1e-4, 1e-3):
        limit = 2.0 * x * np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
        Q = correlated(x, 1.0)[1]
        assert Q == pytest.approx(limit, rel=3.0 * x)
        assert np.linalg.eigvalsh(Q)[0] > 0.0


def test_long_steps_forget_the_acceleration():
    F, Q, U = correlated(10.0, 100.0)
    assert F[:, 2] == pytest.approx([9.99, 0.1, 0.0])
    assert np.isfinite(Q).all()
    assert Q[2, 2] == pytest.approx(1.0)
    assert U[2] == pytest.approx(1.0)


def test_the_published_table_of_singer():
    F, Q, _ = correlated(1.0 / 20.0, 1.0)
    assert F[:, 2].round(4).tolist() == [0.4918, 0.9754, 0.9512]
    assert Q[0].round(4).tolist() == [0.0049, 0.0121, 0.0159]


def test_singer_is_blocked_by_derivative():
    F, Q, drive = singer(20.0, 3.0).step(1.0, np.zeros((4, 9)), 3)
    f, q, _ = correlated(1.0 / 20.0, 1.0)
    assert F == pytest.approx(np.kron(f, np.eye(3)))
    assert Q == pytest.approx(9.0 * np.kron(q, np.eye(3)))
    assert drive.shape == (4, 9)
    assert not drive.any()


def test_the_current_statistical_prediction_is_constant_acceleration():
    rng = np.random.default_rng(1)
    mean, dt = rng.standard_normal((5, 6)), 2.0
    model = current_statistical(10.0, 30.0)
    F, Q, drive = model.step(dt, mean, 2)
    ahead = (F @ mean[..., None])[..., 0] + drive
    exact = polynomial(2).step(dt, mean, 2)[0]
    assert ahead == pytest.approx((exact @ mean[..., None])[..., 0], abs=1e-13)
    assert Q.shape == (5, 6, 6)
    assert np.abs(F - exact).max() > 0.1  # the covariance still decays as Singer's


@pytest.mark.parametrize(
    ("acceleration", "gap"), [(0.0, 30.0), (12.0, 18.0), (-12.0, 18.0), (29.5, 1.5), (45.0, 1.5), (-1e3, 1.5)]
)
def test_the_variance_adapts_and_keeps_its_distance_from_the_limit(acceleration, gap):
    mean = np.array([0.0, 0.0, 0.0, 0.0, acceleration, 0.0])
    Q = current_statistical(10.0, 30.0).step(1.0, mean, 2)[1].reshape(3, 2, 3, 2)
    q = correlated(0.1, 1.0)[1]
    assert Q[:, 0, :, 0] == pytest.approx((4.0 - np.pi) / np.pi * gap**2 * q)
    assert Q[:, 1, :, 1] == pytest.approx((4.0 - np.pi) / np.pi * 30.0**2 * q)
    assert not Q[:, 0, :, 1].any()


def test_a_floor_holds_the_variance_up():
    mean = np.array([0.0, 0.0, 29.9])
    Q = current_statistical(10.0, 30.0, floor=4.0).step(1.0, mean, 1)[1]
    assert Q == pytest.approx(16.0 * correlated(0.1, 1.0)[1])


def test_the_variants_differ_only_where_they_say():
    mean = np.array([1.0, 2.0, 3.0, 4.0, 0.5, -0.5])
    right = current_statistical(10.0, 2.0).step(1.0, mean, 2)
    F, Q, drive = printed_transition(10.0, 2.0).step(1.0, mean, 2)
    assert F[4:, 4:] == pytest.approx((1.0 - np.exp(-0.1)) * np.eye(2))
    F[4:, 4:] = right[0][4:, 4:]
    for mine, wanted in zip((F, Q, drive), right, strict=True):
        assert mine == pytest.approx(wanted)
    assert printed_variance(10.0, 2.0).step(1.0, mean, 2)[1] == pytest.approx(right[1])
    wild = printed_variance(10.0, 2.0).step(1.0, 100.0 * mean, 2)[1]
    assert wild.max() > 1e2 * current_statistical(10.0, 2.0).step(1.0, 100.0 * mean, 2)[1].max()


@pytest.mark.parametrize("order", [0, 1, 2])
def test_polynomials_equal_their_textbook_forms(order):
    F, Q, drive = polynomial(order, 2.0).step(0.5, np.zeros(order + 1), 1)
    g = np.array([0.5**3 / 6, 0.125, 0.5])[2 - order :]
    assert F == pytest.approx(expm(0.5 * np.eye(order + 1, k=1)))
    assert Q == pytest.approx(4.0 * np.outer(g, g))
    assert not drive.any()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: polynomial(3), "order 3"),
        (lambda: polynomial(1, -1.0), "process noise"),
        (lambda: singer(0.0, 1.0), "time_constant"),
        (lambda: singer(1.0, -1.0), "deviation"),
        (lambda: current_statistical(10.0, np.nan), "limit"),
        (lambda: current_statistical(10.0, 1.0, floor=-1.0), "floor"),
    ],
)
def test_impossible_models_are_refused(make, words):
    with pytest.raises(InvalidProblem, match=words):
        make()
