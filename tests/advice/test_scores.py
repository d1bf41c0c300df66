"""Scores are costs plus prices that grow with parameters, choices and noise."""

import numpy as np
from advice.cases import range_case

from optloc.advice.change import Change
from optloc.advice.fits import fit
from optloc.advice.scores import price_of_parameters, score_of_level, scored
from optloc.advice.wording import no_words


def test_a_parameter_costs_twice_the_logarithm_of_its_range():
    one, ten = (price_of_parameters(np.array([size]), np.ones(1)) for size in (10.0, 100.0))
    assert np.isclose(ten - one, 2.0 * np.log(10.0))
    assert price_of_parameters(np.zeros(1), np.ones(1)) == price_of_parameters(np.array([3.0]), np.ones(1))


def test_larger_noise_explains_a_cost_at_the_price_of_its_factor():
    assert score_of_level(8.0, 10) == 8.0
    assert 10.0 * (1.0 + np.log(10.0)) < score_of_level(100.0, 10) < 100.0


def test_choices_and_larger_noise_are_part_of_the_score():
    case, _ = range_case()
    changes = [
        Change("none", no_words),
        Change("unit", no_words, alternatives=5.0),
        Change("unit", no_words, spread=2.0),
    ]
    plain, choice, spread = scored(case, changes, fit(case, changes), [0.0, 0.0, 0.0])
    assert np.isclose(choice.score - plain.score, 2.0 * np.log(5.0))
    assert np.isclose(spread.score, plain.cost / 4.0 + 14.0 * np.log(2.0))
