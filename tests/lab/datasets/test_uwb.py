"""Range differences of a quadrotor from small tables: their sign, their windows, and errors that anchors share."""

import numpy as np
import pytest

import optloc
from optloc.base.errors import InvalidProblem
from optloc.lab.datasets.uwb import ARRIVAL, INDEPENDENT, ROW, _covariance, course, dataset
from optloc.problem.noise import dense

ANCHORS = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 3.0], [5.0, 4.0, 0.0], [0.0, 4.0, 3.0]])
TAG = np.array([2.0, 1.0, 1.5])


@pytest.fixture
def folder(tmp_path):
    """Return a flight of two seconds; the tag is on the floor in the first half of a second."""
    (tmp_path / "flights.csv").write_text("flight,mode,session\nF1,TDOA2,A\nF2,TWR,A\n")
    lines = [f"A,{i},{x},{y},{z}" for i, (x, y, z) in reversed(list(enumerate(ANCHORS)))] + ["B,0,9,9,9"]
    (tmp_path / "stations.csv").write_text("session,anchor,x_m,y_m,z_m\n" + "\n".join(lines))
    lines = [f"F1,{t},{TAG[0]},{TAG[1]},{TAG[2] if t > 0.7 else 0.0}" for t in (0.0, 0.7, 0.71, 2.0)]
    (tmp_path / "truth.csv").write_text("flight,t_s,x_m,y_m,z_m\n" + "\n".join(lines))
    r = np.linalg.norm(TAG - ANCHORS, axis=1)
    lines = [
        f"F1,{t:.3f},{a},{(a + 1) % 4},{r[(a + 1) % 4] - r[a]}" for t in np.arange(0.0, 2.0, 0.01) for a in range(4)
    ]
    (tmp_path / "tdoa.csv").write_text("flight,t_s,anchor_a,anchor_b,rdiff_m\n" + "\n".join(lines))
    return tmp_path


def test_rows_that_share_an_anchor_share_its_error():
    found = _covariance(np.array([0, 1]), np.array([1, 2]), 4, shared=True)
    np.testing.assert_allclose(found, ROW**2 * np.eye(2) + ARRIVAL**2 * np.array([[2.0, -1.0], [-1.0, 2.0]]))
    assert (_covariance(np.array([0, 1]), np.array([1, 2]), 4, shared=False) == INDEPENDENT**2 * np.eye(2)).all()


def test_windows_in_the_air_have_the_differences_of_their_place(folder):
    problem, truth = dataset(folder, flight="F1")
    assert problem.times.tolist() == [1.0, 1.5, 2.0]
    assert truth.tolist() == [TAG.tolist()] * 3
    np.testing.assert_allclose(problem.observed, optloc.engine.predict(problem, truth.ravel()), atol=1e-12)


def test_the_noise_of_a_problem_is_shared_within_a_window_alone(folder):
    problem, _ = dataset(folder, flight="F1")
    noise, epoch = dense(problem.noise, np.arange(problem.count)), problem.rows[0].epoch
    assert (noise[epoch[:, None] != epoch] == 0.0).all()
    assert (np.linalg.eigvalsh(noise) > 0.0).all()
    assert noise[0, 0] == pytest.approx(ROW**2 + 2.0 * ARRIVAL**2)


def test_a_course_has_windows_next_to_each_other_while_the_tag_flies(folder):
    problem, truth = course(folder, "F1", 0.25)
    assert len(truth) == problem.epochs
    assert problem.times[0] > 0.7
    assert np.diff(problem.times[1:]) == pytest.approx(0.25)


def test_a_flight_of_ranges_is_refused(folder):
    with pytest.raises(InvalidProblem, match="has ranges, not differences; use F1"):
        dataset(folder, flight="F2")
