"""Certificates in columns: what is written is told, whatever is done to the batch in between."""

import copy

import numpy as np
import pytest
from cases import CASES

from optloc import simulate, solve
from optloc.base.records import join, overwrite, take
from optloc.base.types import Status
from optloc.problem import Certificate
from optloc.problem.claims import claim, empty_claims, merged_claims, repeated_claims, sentences_of

GIVEN = [
    Certificate("global", "proven best", "branch and bound", 1.0, 1e-9, True, 9.0, 57),
    Certificate("region", "none of these", "branch and bound", 2.0, 1e-9, boxes=3, region=((0.0, 1.0), (2.0, 3.0))),
    Certificate("local", "a minimum", "refinement"),
    Certificate("unknown", "no answer", "none"),
]


def written():
    """Return claims (5,): those given, and one that nobody has tried to prove."""
    out = empty_claims(5)
    for i, certificate in enumerate(GIVEN):
        out.write(i, claim(certificate))
    return out


def same(told, wanted):
    """Return whether certificates are the same; NaN is NaN."""
    return [repr(one) for one in told] == [repr(one) for one in wanted]


@pytest.mark.parametrize("certificate", GIVEN)
def test_one_is_told_as_it_was_written(certificate):
    assert repr(claim(certificate).tell()[()]) == repr(certificate)


def test_a_batch_tells_each_and_none_where_nobody_tried():
    assert same(written().tell(), [*GIVEN, None])
    assert list(written().tried) == [True] * 4 + [False]


def test_it_is_taken_joined_and_overwritten_like_every_record():
    some = take(written(), np.array([1, 4]))
    assert same(some.tell(), [GIVEN[1], None])
    assert same(join([some, written()], 7).tell(), [GIVEN[1], None, *GIVEN, None])
    assert same(overwrite(written(), np.array([0, 2]), some).tell(), [GIVEN[1], GIVEN[1], None, GIVEN[3], None])


def test_many_are_one_and_one_is_chosen_for_many():
    assert same(repeated_claims(claim(GIVEN[1]), 3).tell(), [GIVEN[1]] * 3)
    chosen = merged_claims(np.array([True, False, False, False, True]), claim(GIVEN[0]), written())
    assert same(chosen.tell(), [GIVEN[0], *GIVEN[1:], GIVEN[0]])


def test_rows_of_one_certificate_stay_one_row():
    one = repeated_claims(claim(GIVEN[2]), 4)
    assert join([one, one], 8).bound.strides == (0,)


def test_certificates_are_told_once():
    """A program that asks for one after the other does not wait for all of them each time."""
    fix = solve(simulate(CASES["tdoa-3d"].problem, CASES["tdoa-3d"].truth, 1, trials=6))
    assert fix.certificate[3] is fix.certificate[3]
    assert not fix.certificate.flags.writeable
    assert fix[2:5].certificate[1] == fix.certificate[3]
    assert copy.deepcopy(fix).certificate.tolist() == fix.certificate.tolist()


@pytest.mark.parametrize(
    ("certificate", "advice", "absent"),
    [
        (Certificate("local", "the best of all candidates", "refinement"), "method 'auto'", "measurements"),
        (Certificate("unknown", "the rays bend", "branch and bound"), "no proof covers", "method 'auto'"),
        (Certificate("unknown", "not finished", "branch and bound", boxes=9), "add measurements", "method 'auto'"),
        (Certificate("global", "proven best", "branch and bound", boxes=9), "add measurements", "method 'auto'"),
    ],
)
def test_the_advice_for_an_unproven_fix_is_a_step_that_was_not_taken(certificate, advice, absent):
    sentence = sentences_of(np.asarray(Status.UNPROVEN), claim(certificate))[()]
    assert advice in sentence
    assert absent not in sentence
    assert sentences_of(np.asarray(Status.CURVED), claim(certificate))[()] == Status.CURVED.sentence


def test_a_batch_has_the_sentences_of_its_fixes():
    problem = simulate(CASES["tdoa-3d"].problem, CASES["tdoa-3d"].truth, 1, trials=4)
    for method in ("gtrs+lsr", "auto"):
        fix = solve(problem, method)
        assert fix.sentence.tolist() == [fix[i].sentence for i in range(4)]
        assert isinstance(fix[0].sentence, str)
