"""The leaderboard: shares, duels and times of rows that were made by hand, and names that cannot break a table."""

from lab.study.rows import hand_made

from optloc.lab.study.leaderboard import _by_case, _cell, _ranks


def test_ranks_say_shares_times_and_duels():
    _, _, first, second = _ranks(hand_made())
    cells = [cell.strip() for cell in first.split("|")[1:-1]]
    # Equally often right: the faster one is first, and has no duel with itself.
    assert (cells[1], cells[2], cells[4], cells[5], cells[6]) == ("a", "50.00", "25.00", "1", "")
    cells = [cell.strip() for cell in second.split("|")[1:-1]]
    assert (cells[1], cells[2], cells[5], cells[6]) == ("b", "50.00", "2", "1 : 1")


def test_each_scene_has_a_line_with_the_shares_of_all_methods():
    header, _, *lines = _by_case(hand_made())
    assert header == "| scene | a | b |"
    assert [line.endswith("| 50.0 | 50.0 |") for line in lines] == [True]


def test_a_name_cannot_break_a_table():
    assert _cell("a|b <i>`x`</i>") == r"a\|b \<i\>\`x\`\</i\>"
