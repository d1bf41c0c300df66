"""Trials are a function of study seed, case and number alone, and have the geometry and noise that a file asks for."""

import numpy as np
import pytest
from lab.study.texts import design
from scipy.spatial import Delaunay

from optloc.engine import predict
from optloc.lab.study.simulation import block_size, draw
from optloc.models import MODELS

HEAD = 'format = 1\nname = "x"\nseed = 3\ntrials = 2000\n[[method]]\nmethod = "gtrs+lsr"\n[[scenario]]\nname = "s"\n'


def case(text, number=0):
    return design(HEAD + text).cells[number].case


SHELL = 'layout = { stations = 6 }\ntruth = { kind = "shell", distance = ["5 km", "20 km"] }\nnoise = ["10 m"]\n'


def test_a_trial_does_not_depend_on_what_else_is_drawn():
    one = case(SHELL)
    whole = draw(one, 0, 1200)
    assert block_size(one) == 500
    for first, count in ((0, 1), (499, 2), (730, 300)):
        part = draw(one, first, count)
        for name in ("truth", "wild"):
            assert np.array_equal(getattr(part, name), getattr(whole, name)[first : first + count])
        assert np.array_equal(part.problem.z, whole.problem.z[first : first + count])
        assert part.seed == whole.seed[first : first + count]
        assert part.digest == whole.digest[first : first + count]
    assert len(set(whole.digest)) == len(set(whole.seed)) == 3


def test_other_scenarios_methods_and_numbers_of_trials_leave_the_data_alone():
    alone = case(SHELL)
    before = 'noise = ["1 m"]\nlayout = { stations = 5 }\ntruth = { kind = "hull" }\n[[scenario]]\nname = "t"\n'
    behind = design(HEAD + before + SHELL + '[[method]]\nmethod = "roots+lsr"\n', trials=77).cells[-1].case
    renamed = design(HEAD.replace('"s"', '"t"') + SHELL).cells[0].case
    assert behind.key == renamed.key
    assert np.array_equal(draw(behind, 5, 9).problem.z, draw(renamed, 5, 9).problem.z)
    assert draw(behind, 5, 9).digest == draw(renamed, 5, 9).digest
    assert case(SHELL.replace("10 m", "11 m")).key != alone.key
    assert design(HEAD + SHELL, seed=4).cells[0].case.key != alone.key


def test_truths_are_where_the_file_says():
    shell = draw(case(SHELL), 0, 2000)
    stations = shell.problem.stations.position[:, 0]
    away = np.linalg.norm(shell.truth - stations.mean(1), axis=-1)
    assert away.min() > 5e3
    assert away.max() < 20e3
    assert abs(away.mean() - 12.5e3) < 4.0 * 15e3 / np.sqrt(12 * 2000)
    hull = draw(case(SHELL.replace('kind = "shell", distance = ["5 km", "20 km"]', 'kind = "hull"')), 0, 200)
    for place, corners in zip(hull.truth, hull.problem.stations.position[:, 0], strict=True):
        assert Delaunay(corners).find_simplex(place) >= 0


@pytest.mark.parametrize("placement", ["frozen", "ring", "star"])
def test_stations_that_stay_are_the_same_in_every_trial(placement):
    place = draw(case(SHELL.replace("stations = 6", f'stations = 6, placement = "{placement}"')), 0, 9)
    stations = place.problem.stations.position[:, 0]
    assert np.array_equal(stations, np.broadcast_to(stations[:1], stations.shape))
    assert len(np.unique(stations[0], axis=0)) == 6


def test_noise_has_the_level_and_the_correlation_that_were_asked_for():
    drawn = draw(case(SHELL), 0, 2000)
    error = drawn.problem.z - predict(drawn.problem, drawn.truth)
    covariance = error.T @ error / len(error)
    expected = 100.0 * 0.5 * (np.eye(5) + 1.0)  # differences to one station share half their variance
    assert np.abs(covariance - expected).max() < 5.0 * 100.0 * np.sqrt(2.0 / 2000)


def test_what_no_method_is_told_is_in_the_data_and_not_in_the_problem():
    offset = draw(case(SHELL.replace("10 m", "1 mm") + 'error = { offset = "20 m" }\n'), 0, 2000)
    assert not offset.problem.biases
    error = offset.problem.z - predict(offset.problem, offset.truth)
    # Offsets of two stations: the variance of a difference is twice that of one.
    assert np.abs(error.var(0) - 2.0 * 400.0).max() < 5.0 * 800.0 * np.sqrt(2.0 / 2000)


def test_biases_of_a_file_are_known_drawn_or_zero():
    text = 'problem = "registration"\ntruth = { kind = "fixed", at = ["200 km", "300 km", 0.0] }\n'
    clock = draw(case(text + 'bias = { clock = ["30 m", "-40 m", "50 m", "-30 m"] }\n'), 0, 3).truth
    assert np.array_equal(clock[:, 3:7], np.tile([30.0, -40.0, 50.0, -30.0], (3, 1)))
    assert not draw(case(text), 0, 3).truth[:, 3:].any()
    spread = draw(case(text + 'bias = { clock = "100 ns" }\n'), 0, 400).truth[:, 3:7]
    assert spread.std() == pytest.approx(29.979, rel=0.1)


def test_every_kind_of_stations_at_rest_can_be_laid_out():
    for kind, model in MODELS.items():
        if model.stations and not model.velocity and 3 in model.dimensions:
            level = {"length": "10 m", "angle": "5 mrad", "ratio": "0.5 dB", "level": "0.5 dB"}[model.quantity]
            text = SHELL.replace("stations = 6", f'stations = 6, kinds = ["{kind}"]').replace("10 m", level)
            drawn = draw(case(text), 0, 50)
            error = drawn.problem.z - predict(drawn.problem, drawn.truth)
            assert np.isfinite(error).all(), kind


GROSS = 'error = { outliers = { share = 0.2, size = "500 m" } }\n'


def errors(text, trials=2000):
    drawn = draw(case(text), 0, trials)
    return drawn, drawn.problem.z - predict(drawn.problem, drawn.truth)


def test_a_station_with_a_gross_error_is_off_in_all_its_differences():
    exact = SHELL.replace("10 m", "1 mm").replace("stations = 6", 'stations = 6, pairs = "all"')
    drawn, error = errors(exact + GROSS)
    a, b = drawn.problem.rows[0].a, drawn.problem.rows[0].b
    # What every station must be off by for its differences, the mean left open.
    design = np.eye(6)[a] - np.eye(6)[b]
    off = error @ np.linalg.pinv(design).T
    assert np.abs(error - off @ design.T).max() < 0.1
    off -= np.median(off, axis=1, keepdims=True)
    few = drawn.bad <= 2  # the median is then that of good stations
    wrong = np.abs(off) > 1.0
    assert np.array_equal(wrong.sum(1)[few], drawn.bad[few])
    assert np.allclose(np.abs(off[few][wrong[few]]), 500.0, atol=0.1)
    assert abs(drawn.bad.mean() - 1.2) < 4.0 * np.sqrt(6 * 0.2 * 0.8 / 2000)
    assert abs(np.mean(off[few][wrong[few]] > 0.0) - 0.5) < 0.1


def test_late_arrivals_are_never_early():
    text = SHELL.replace("10 m", "1 mm").replace("stations = 6", 'stations = 6, kinds = ["toa"]')
    drawn, error = errors(text + GROSS.replace('"500 m"', '"500 m", late = true'))
    assert np.allclose(error[error > 1.0], 500.0, atol=0.1)
    assert error.min() > -0.1
    assert np.array_equal((error > 1.0).sum(1), drawn.bad)


def test_the_share_of_gross_errors_can_be_swept():
    text = 'format = 1\nname = "x"\ntrials = 50\n[[scenario]]\nname = "s"\nnoise = ["1 m"]\ntruth = { kind = "hull" }\n'
    text += 'layout = { stations = 8, kinds = ["toa"] }\nsweep = { "error.outliers.share" = [0.01, 0.5] }\n'
    text += 'error = { outliers = { share = 0.1, size = "100 m" } }\n[[method]]\nmethod = "gtrs+lsr"\n'
    few, many = (draw(cell.case, 0, 50) for cell in design(text).cells)
    assert few.bad.mean() < 0.5 < many.bad.mean()
