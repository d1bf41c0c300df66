"""Outliers, noise levels and late signals are told apart."""

from dataclasses import replace

import numpy as np
from advice.cases import TRUTHS, at, range_case

from optloc.advice.causes import causes_of
from optloc.advice.change import Change
from optloc.advice.fits import fit
from optloc.advice.rows_and_noise import _worst_rows, late_fit
from optloc.advice.wording import no_words


def test_one_wrong_row_of_several_epochs_is_an_outlier():
    error = np.zeros((4, 7))
    error[2, 5] = 80.0
    first = causes_of(range_case(error, epochs=4)[0])[0]
    assert (first.change.cause, first.change.members) == ("outlier", (19,))


def test_two_wrong_rows_are_outliers():
    error = np.zeros((4, 7))
    error[2, 5], error[0, 1] = 80.0, -120.0
    first = causes_of(range_case(error, epochs=4)[0])[0]
    assert (first.change.cause, set(first.change.members)) == ("outliers", {19, 1})


def test_a_station_with_large_noise_is_named():
    noise = 40.0 * np.random.default_rng(3).normal(size=(4, 7)) * at(2, 1.0)
    found = causes_of(range_case(noise, epochs=4)[0])
    assert ("S2",) in {one.change.station for one in found}


def test_late_rows_have_a_positive_delay():
    rng = np.random.default_rng(7)
    late = (rng.random((4, 7)) < 0.3) * rng.exponential(150.0, (4, 7))
    case, _ = range_case(late, epochs=4)
    found = late_fit(replace(case, x=TRUTHS))
    assert 0.1 < found.share < 0.6
    assert 20.0 < found.delay < 120.0


def test_epochs_that_fit_have_no_wrong_rows():
    error = np.zeros((4, 7))
    error[2, [1, 5]] = 80.0, -60.0
    case, _ = range_case(error, epochs=4)
    case = replace(case, x=fit(case, [Change("none", no_words)]).x[0])
    rows = _worst_rows(case)
    assert {epoch for epoch, _ in rows} == {2}
    assert {row for _, row in rows} == set(range(7))
