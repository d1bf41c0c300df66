"""The structure of problems as tables of whole numbers."""

from itertools import pairwise

import numpy as np

from optloc import Motion, assemble, measured, with_bias
from optloc.kernels.tables import GROUP_COLUMN, Entries, RowGroups, Sources, starts, tables

PLACES = np.array([[0.0, 0.0], [9.0, 1.0], [10.0, 9.0], [1.0, 10.0]])


def run(**more):
    """Return a run of two epochs of three range differences each, the later one first."""
    rows = measured("tdoa", a=[1, 2, 3, 1, 2, 3], b=0, epoch=[1, 1, 1, 0, 0, 0], sigma=1.0)
    return assemble(PLACES, rows, **more)


def test_parts_begin_where_those_before_them_end():
    assert starts([3, 0, 2]).tolist() == [0, 3, 3, 5]
    assert starts([]).tolist() == [0]


def test_groups_are_in_the_order_of_their_epochs():
    found = RowGroups.sorted(run(), (np.array([[0, 2, 1]]), np.array([[3], [4], [5]])))
    assert found.epoch.tolist() == [0, 0, 0, 1]
    assert found.size.tolist() == [1, 1, 1, 3]
    assert found.number.tolist() == [1, 2, 3, 0]
    assert found.of.tolist() == [3, 3, 3, 0, 1, 2]
    assert found.member.tolist() == [0, 2, 1, 0, 0, 0]


def test_entries_are_joined_in_order():
    one = Entries(np.array([1]), np.array([2]), np.array([0.5]), np.array([0]))
    assert Entries.joined([one, one]).row.tolist() == [1, 1]
    assert len(Entries.joined([]).factor) == 0


def test_numbers_of_sources_count_through_shared_ones_and_those_of_each_problem():
    known = np.arange(8.0).reshape(2, 1, 2, 2)  # two problems, positions and velocities
    problem = run(motions=(Motion(1, known=known),), biases=with_bias(run(), "clock").biases)
    sources = Sources.of(problem.flat())
    assert sources.own == (False, True)
    assert sources.start == (1, 9)
    assert sources.lookup().tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8, -1, -2, -3, -4]
    numbered = sources.numbered(problem)
    assert numbered.stations.position.ravel().tolist() == list(range(1, 9))
    assert numbered.motions[0].known.ravel().tolist() == [9, 10, 11, 12]


def test_tables_hold_each_row_once_and_the_unknowns_of_each_group():
    problem = with_bias(run(), "clock", members=["S1", "S2"])
    groups = (np.arange(6)[:, None],)
    found = tables(problem, groups).tables
    assert (found.kinds, found.groups, found.shared, found.local, found.size) == (1, 6, 4, 0, 1)
    row = found.table[found.row : found.row + 6]
    assert sorted(row[:, 0]) == list(range(6))
    at = found.table[found.group : found.group + 7, GROUP_COLUMN]
    columns = [found.table[found.column + a : found.column + b, 0].tolist() for a, b in pairwise(at)]
    # epoch 0 first: differences of stations 1, 2 and 3, of which the last has no clock
    assert columns == [[0, 1, 2], [0, 1, 3], [0, 1]] * 2


def test_noise_that_ties_epochs_with_unknowns_of_their_own_has_no_tables():
    problem = run(motions=(Motion(span="epoch"),))
    assert tables(problem, (np.array([[0, 3]]), np.array([[1], [2], [4], [5]]))) is None
    assert tables(problem, (np.arange(6)[:, None],)).tables.local == 2
