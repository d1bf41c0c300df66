"""All explanations compete: one is given if it leads by the gap, several are listed if the data do not decide."""

from dataclasses import replace

import numpy as np
from advice.cases import PLACES, TRUTHS, at, range_case

from optloc.advice.causes import advice_on, causes_of
from optloc.advice.scores import GAP
from optloc.problem.written import Written


def test_clean_data_have_no_cause():
    assert causes_of(range_case(epochs=3)[0]) == ()


def test_an_offset_is_first_with_its_station_and_size():
    one = next(advice_on(causes_of(range_case(at(3, 90.0), epochs=3)[0])))
    assert (one.cause, one.station) == ("offset", ("S3",))
    assert abs(one.value[0] - 90.0) < 15.0


def test_noise_that_is_understated_is_no_wrong_station():
    noise = 20.0 * np.random.default_rng(5).normal(size=(4, 7))
    (one,) = advice_on(causes_of(range_case(noise, epochs=4)[0]))
    assert (one.cause, one.station, one.gap) == ("noise", (), GAP)


def test_causes_that_the_data_do_not_separate_are_listed_with_their_gaps():
    right = np.linalg.norm(TRUTHS[:1, None] - PLACES, axis=-1)
    found = list(advice_on(causes_of(range_case(-0.999 * right, sigma=0.003)[0])))
    assert [one.cause for one in found] == ["unit", "coordinate-unit"]
    assert found[0].gap >= 0.0 >= found[1].gap


def test_an_epoch_that_nothing_determines_does_not_hide_the_cause_of_the_others():
    case, _ = range_case(at(3, 90.0), epochs=4)
    weight = np.broadcast_to(case.base.weight, (4, 7)).copy()
    weight[1, 1:] = 0.0
    base = case.base.with_rows(weight=weight)
    found = causes_of(replace(case, base=base))
    assert {one.change.cause for one in found} == {"offset"}
    assert len(found[0].case.times) == 3


def test_noise_that_is_larger_than_the_array_is_no_better_than_a_unit():
    case, _ = range_case(epochs=4, sigma=0.01)
    written = Written(units={"range": 1e3}, noise_has_unit=True)
    base = replace(case.base.with_rows(z=1e5 * case.base.z), written=written)
    assert [one.change.cause for one in causes_of(replace(case, base=base))][:1] == ["unit"]
