"""Options of optloc live and serve: parts, times, words, tracks, and what --check tells of a site."""

import pytest
from service.lines import site_in

from optloc import InvalidProblem
from optloc.service.command import (
    _settings,
    _tracking,
    input_description,
    one_of,
    part_of,
    run_check,
    seconds_of,
)
from optloc.service.messages import parse
from optloc.service.site import FAST


def test_a_part_is_counted_from_zero():
    assert [part_of(text) for text in ("1/1", "2/4", "4/4")] == [(0, 1), (1, 4), (3, 4)]
    for text in ("0/4", "5/4", "1", "a/b", "1/0", "-1/2"):
        with pytest.raises(InvalidProblem, match="--partition"):
            part_of(text)


def test_times_have_units_and_are_not_negative():
    assert [seconds_of(text, "--wait") for text in ("50 ms", "2 min", "0 s")] == pytest.approx([0.05, 120.0, 0.0])
    with pytest.raises(InvalidProblem, match="--wait: '2' has no unit"):
        seconds_of("2", "--wait")
    with pytest.raises(InvalidProblem, match="--wait: '-1 s' is negative"):
        seconds_of("-1 s", "--wait")
    with pytest.raises(InvalidProblem, match="--late: 'revice' is unknown; did you mean 'revise'"):
        one_of("revice", ("drop", "revise"), "--late")


def test_options_become_the_settings_of_a_stream():
    found = _settings("50 ms", "revise", "one", None, "2/3", "geojson")
    assert found == {
        "wait": 0.05, "revise": True, "phases": "one", "deadline": None, "part": (1, 3), "format": "geojson"
    }  # fmt: skip
    assert _tracking("cv", "iekf", None, None, track=True) == {"track": True}
    track_settings = _tracking("ca", "iekf", None, 7.0, track=True)["track_settings"]
    assert (track_settings.rules.gap, track_settings.dynamics.order) == (7.0, 2)


def test_each_line_that_check_shows_is_one_that_the_site_takes(tmp_path, capsys):
    site = site_in(tmp_path, method=FAST)
    shown = [line.partition(": {")[2] for line in input_description(site) if ": {" in line]
    assert len(shown) == 3
    for text in shown:
        assert parse(b"{" + text.encode(), site).event == "1"
    assert run_check(tmp_path / "site.toml", FAST) == 0
    assert "Six receivers: 5 rows of 6 stations" in capsys.readouterr().out
