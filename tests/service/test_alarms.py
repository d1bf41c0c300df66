"""Errors of parts of a stream as sentences."""

from optloc.problem import InvalidProblem
from optloc.service.alarms import SourceLost, sentence


def test_a_sentence_names_the_type_of_an_unexpected_error():
    assert sentence(SourceLost("the broker\n is lost")) == "the broker is lost"
    assert sentence(InvalidProblem("it is bad", "x", "change it")) == "x: it is bad; change it."
    assert sentence(KeyError("a")) == "KeyError: 'a'"
    assert sentence(ValueError()) == "ValueError: no reason is given"
