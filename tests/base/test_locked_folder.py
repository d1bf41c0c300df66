"""A folder of results has one writer; folders with other files stay as they are."""

import pytest

from optloc.base.errors import InvalidProblem
from optloc.base.locked_folder import locked_folder

WORDS = ("other files", "try again")


def test_a_second_run_waits_until_the_first_has_ended(tmp_path):
    folder = tmp_path / "new" / "results"
    with locked_folder(folder, ".lock", "list.json", *WORDS):
        with pytest.raises(InvalidProblem, match="another run writes to this folder; wait until it ends"):
            with locked_folder(folder, ".lock", "list.json", *WORDS):
                pass
    with locked_folder(folder, ".lock", "list.json", *WORDS):
        assert folder.is_dir()


@pytest.mark.parametrize(("name", "refused"), [("letter.txt", True), ("list.json", False), (".lock", False)])
def test_a_folder_of_others_stays_as_it_is(tmp_path, name, refused):
    (tmp_path / name).touch()
    if refused:
        with pytest.raises(InvalidProblem, match="other files; choose another with --out"):
            with locked_folder(tmp_path, ".lock", "list.json", *WORDS):
                pass
        assert [path.name for path in tmp_path.iterdir()] == [name]
    else:
        with locked_folder(tmp_path, ".lock", "list.json", *WORDS):
            pass


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InvalidProblem, match=r"the folder cannot be written .*; try again"):
        with locked_folder(tmp_path / "file" / "inner", ".lock", "list.json", *WORDS):
            pass
