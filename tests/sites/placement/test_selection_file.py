"""Selection files: candidates, places, groups, sight and areas as numbers, and the problem file of chosen sites."""

import json

import numpy as np
import pytest

from optloc.base.errors import InvalidProblem
from optloc.files import read
from optloc.sites.placement.selection_file import criterion_name, is_selection, read_selection, write_chosen
from optloc.sites.placement.sites import candidates_of

TEXT = """
format = 1
title = "Yard"
[choice]
choose = 3
kept = ["C2"]
[stations]
rows = [{ name = "Old", x = 12.0, y = -9.0, z = 7.0 }]
[candidates]
rows = [
  { name = "C1", x = -30.0, y = -30.0, z = 0.0, cost = 4.0, group = "a" },
  { name = "C2", x = 30.0, y = -28.0, z = 1.0, cost = 5.0, group = "b" },
  { name = "C3", x = 30.0, y = 31.0, z = 2.0, cost = 6.0, group = "a" },
  { name = "C4", x = -29.0, y = 27.0, z = 3.0, cost = 7.0, group = "b" },
  { name = "C5", x = 4.0, y = 3.0, z = 9.0, cost = 8.0, group = "b" },
]
[targets]
rows = [
  { name = "hall", x = 3.0, y = 6.0, z = 2.0, weight = 3.0 },
  { name = "gate", x = -20.0, y = -9.0, z = 1.0, weight = 1.0 },
]
[[measurements]]
kind = "toa"
sigma = "30 cm"
"""


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "selection.toml"
    found.write_text(TEXT)
    return found


def more(path, text):
    path.write_text(TEXT + text)
    return read_selection(path).selection


def test_a_selection_has_the_candidates_places_and_rules_of_its_file(path):
    assert is_selection(path)
    loaded = read_selection(path)
    selection = loaded.selection
    assert loaded.title == "Yard"
    assert {*selection.problem.stations.names} == {"Old", "C1", "C2", "C3", "C4", "C5"}
    assert selection.kept == ("Old", "C2")
    assert selection.names == ("hall", "gate")
    assert selection.places.tolist() == [[3.0, 6.0, 2.0], [-20.0, -9.0, 1.0]]
    assert selection.weights.tolist() == [3.0, 1.0]
    assert candidates_of(selection).names[0] in selection.problem.stations.names


def test_groups_are_words_of_the_column_or_names(path):
    text = '[[groups]]\ngroup = "a"\nmost = 1\n[[groups]]\nmembers = ["C4", "C5"]\nleast = 1\n'
    first, second = more(path, text).groups
    assert (first.members, first.most, first.least) == (("C1", "C3"), 1, None)
    assert (second.members, second.most, second.least) == (("C4", "C5"), None, 1)
    with pytest.raises(InvalidProblem, match="no candidate is in group 'c'"):
        more(path, '[[groups]]\ngroup = "c"\nmost = 1\n')
    with pytest.raises(InvalidProblem, match="the group has no rule"):
        more(path, '[[groups]]\ngroup = "a"\n')


def test_pairs_out_of_sight_are_zero_and_all_others_in_sight(path):
    selection = more(path, '[sight]\nrows = [{ candidate = "C3", place = "gate", sight = 0.0 }]\n')
    out = np.ones((2, 6))
    out[1, selection.problem.stations.names.index("C3")] = 0.0
    np.testing.assert_array_equal(selection.sight, out)
    with pytest.raises(InvalidProblem, match="there is no place 'gait'"):
        more(path, '[sight]\nrows = [{ candidate = "C3", place = "gait", sight = 0.0 }]\n')


def test_an_area_is_filled_with_places_at_its_spacing(path, tmp_path):
    ring = [[0, 0], [40, 0], [40, 20], [0, 20], [0, 0]]
    (tmp_path / "area.json").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    begin, end = TEXT.index("[targets]"), TEXT.index("[[measurements]]")
    area = '[targets]\npolygon = "area.json"\nspacing = "10 m"\nheight = "2 m"\n'
    path.write_text(TEXT[:begin] + area + TEXT[end:])
    places = read_selection(path).selection.places
    assert sorted(map(tuple, places)) == [(x, y, 2.0) for x in (5.0, 15.0, 25.0, 35.0) for y in (5.0, 15.0)]


def test_a_range_beyond_which_nothing_is_measured_is_one_of_each_row(path):
    path.write_text(TEXT + 'range_max = "50 m"\n')
    assert read_selection(path).selection.reach.tolist() == [50.0] * 6


def test_chosen_stations_are_written_with_their_rows(path, tmp_path):
    write_chosen(read_selection(path), ("Old", "C2", "C4"), tmp_path / "chosen.toml", path)
    problem = read(tmp_path / "chosen.toml", values=False).problem
    assert {*problem.stations.names} == {"Old", "C2", "C4"}
    assert problem.count == 3
    with pytest.raises(InvalidProblem, match=r"its name must end in \.toml"):
        write_chosen(read_selection(path), ("Old",), tmp_path / "chosen.csv", path)


def test_criteria_have_three_names():
    assert criterion_name("axis") == "axis"
    with pytest.raises(InvalidProblem, match="--criterion: there is no criterion 'volum'; did you mean 'volume'"):
        criterion_name("volum")
