"""Stations are ordered by the cost without their rows."""

from advice.cases import at, range_case

from optloc.advice.suspects import Suspects


def test_the_wrong_station_is_the_first_suspect():
    suspects = Suspects(range_case(at(4, 80.0), epochs=2)[0])
    assert suspects.first(1) == [(4, "range")]
    assert suspects.count == 7
    assert suspects.start(4, "range").shape == (2, 2)
