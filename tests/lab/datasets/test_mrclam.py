"""A robot among landmarks, from small tables: rows in the order of epochs, thinned, with the noise of their kinds."""

import numpy as np
import pytest

import optloc
from optloc.base.errors import InvalidProblem
from optloc.lab.datasets.mrclam import ALONE, SIGMA, dataset, load, sigmas

LANDMARKS = {6: (0.0, 0.0), 9: (4.0, 0.0), 11: (0.0, 3.0)}
TRUTH = {20: (1.0, 1.0), 21: (2.0, 1.0), 22: (2.0, 2.0)}


@pytest.fixture
def folder(tmp_path):
    lines = [f"1,{name},{x},{y}" for name, (x, y) in LANDMARKS.items()] + ["2,6,9,9"]
    (tmp_path / "stations.csv").write_text("set,station,x_m,y_m\n" + "\n".join(lines))
    lines = [f"1,{epoch},{x},{y}" for epoch, (x, y) in TRUTH.items()]
    (tmp_path / "truth.csv").write_text("set,epoch,x_m,y_m\n" + "\n".join(lines))
    lines = []
    for name, place in reversed(LANDMARKS.items()):
        for epoch, there in reversed(TRUTH.items()):
            x, y = np.subtract(there, place)
            lines.append(f"1,{epoch},{name},{np.arctan2(y, x)},{np.hypot(x, y)}")
    (tmp_path / "measurements.csv").write_text("set,epoch,station,az_rad,range_m\n" + "\n".join(lines))
    return tmp_path


def test_exact_sightings_are_those_of_the_truth(folder):
    problem, truth = dataset(folder)
    assert truth.tolist() == [list(place) for place in TRUTH.values()]
    np.testing.assert_allclose(problem.observed, optloc.engine.predict(problem, truth.ravel()), atol=1e-12)


def test_every_other_epoch_keeps_its_rows(folder):
    whole, some = load(folder, 1), load(folder, 1).every(2)
    assert some.truth.tolist() == [[1.0, 1.0], [2.0, 2.0]]
    assert some.epoch.tolist() == [0, 0, 0, 1, 1, 1]
    np.testing.assert_array_equal(some.z["range"], whole.z["range"][whole.epoch != 1])


def test_ranges_alone_have_a_larger_deviation():
    assert sigmas(("range",))["range"] == ALONE["range"] > SIGMA["range"] == sigmas(("azimuth", "range"))["range"]


def test_unknown_sets_and_kinds_are_refused(folder):
    with pytest.raises(InvalidProblem, match="number: 3 is unknown"):
        dataset(folder, number=3)
    with pytest.raises(InvalidProblem, match="kinds: 'rang' is unknown; did you mean 'range'"):
        dataset(folder, kinds=("rang",))
