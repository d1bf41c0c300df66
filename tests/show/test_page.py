"""Pages: one file that needs nothing else, limits of maps on the shorter way, and names that are no HTML."""

import re

import numpy as np
import pandas as pd
import pytest
from show.ranging import ranged

from optloc import InvalidProblem
from optloc.show.page import PagePart, _map_limits, _shift_near, fix_page, write_page
from optloc.show.sheet import Sheet, TextTable


def test_a_page_loads_nothing_and_escapes_what_it_shows():
    shown = TextTable("t", "", ("name", "value"), (("<script>alert(1)</script>", "2"),))
    page = write_page("a <title>", [PagePart("one", "PagePart & more", tables=[Sheet(pd.DataFrame(), shown)])])
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "<script>alert(1)" not in page
    assert "PagePart &amp; more" in page
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', page)


def test_the_page_of_a_fix_names_its_stations():
    problem, fix = ranged()
    page = fix_page(problem, fix, "Four ranges")
    assert all(f"station {name}" in page for name in problem.stations.names)
    assert "<title>Four ranges</title>" in page


def test_a_map_goes_the_shorter_way_around_the_earth():
    west, east, south, north = _map_limits([np.array([[179.0, 10.0], [-179.0, 12.0]])])
    assert west < 179.0
    assert 181.0 < east < 190.0
    assert south < 10.0
    assert north > 12.0
    with pytest.raises(InvalidProblem, match="nothing has a position"):
        _map_limits([np.full((1, 2), np.nan)])


def test_longitudes_are_within_half_a_turn_of_the_middle():
    place = np.array([[-170.0, 1.0], [170.0, 2.0], [539.0, 3.0]])
    found = _shift_near(place, 175.0)
    assert found[:, 0] == pytest.approx([190.0, 170.0, 179.0])
    assert found[:, 1].tolist() == [1.0, 2.0, 3.0]
