"""Tables of the paper `kinematic`: numbers in cells, and the lines of its table 1."""

import numpy as np

from optloc.lab.papers.kinematic import KinematicScore
from optloc.lab.papers.kinematic_tables import ERROR, TableLine, _three_digits, km, table_errors, table_ratios
from optloc.show.sheet import ABSENT


def test_numbers_are_short():
    assert [km(v) for v in (579.4, 10328.0, 336_900.0, 2.5e6, np.nan)] == ["0.579", "10.328", "337", "2500", "–"]


def test_large_errors_over_covariances_are_told_by_two_digits():
    assert [_three_digits(value) for value in (1.987, 99.99, 12345.0, -2.5e11)] == ["1.99", "99.99", "1.2e4", "-2.5e11"]


def uniform(error):
    return KinematicScore(np.full((4, 3, 20), error), np.full((4, 3, 20), 2.0))


def test_a_line_of_table_1_holds_printed_and_reproduced_numbers():
    lines = [TableLine("fix", uniform(982.0), 900.0, 4e-4, "static"), TableLine("CV on CA", uniform(5e3), None, 1e-3)]
    table = table_errors(lines)
    assert table.rows[0] == ("fix", "0.982", "0.982", "0.000", "0.900", "0.402", "0.400")
    assert table.rows[1] == ("CV on CA", "", "5.000", "0.000", ABSENT, "", "1.000")


def test_ratios_are_those_of_a_filter_to_the_fix():
    table = table_ratios(uniform(800.0), {"CV": uniform(400.0)}, steps=20)
    assert table.value("CV / fix", "reproduced") == 0.5
    assert table.cell("CV / fix", "printed") == f"{ERROR['CV on CV'] / ERROR['static']:.3f}"
