"""A folder of results has one writer; folders with other files stay as they are."""

import pytest

from optloc.base.errors import InvalidProblem
from optloc.base.locked_folder import locked_folder


def write_once(folder):
    """Lock a folder as a run does, and end."""
    with locked_folder(folder, ".lock", "list.json", "other files", "try again"):
        assert folder.is_dir()


def assert_refused(folder, words):
    with pytest.raises(InvalidProblem, match=words):
        write_once(folder)


def test_a_second_run_waits_until_the_first_has_ended(tmp_path):
    folder = tmp_path / "new" / "results"
    with locked_folder(folder, ".lock", "list.json", "other files", "try again"):
        assert_refused(folder, "another run writes to this folder; wait until it ends")
    write_once(folder)


def test_a_folder_of_others_stays_as_it_is(tmp_path):
    (tmp_path / "letter.txt").touch()
    with pytest.raises(InvalidProblem, match="other files; choose another with --out"):
        write_once(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


@pytest.mark.parametrize("name", ["list.json", ".lock"])
def test_a_folder_of_an_earlier_run_is_taken(tmp_path, name):
    (tmp_path / name).touch()
    write_once(tmp_path)


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InvalidProblem, match="the folder cannot be written"):
        write_once(tmp_path / "file" / "inner")
