"""What readers of data sets share: the folder, checked files, options, and rows cut into windows."""

import hashlib

import numpy as np
import pandas as pd
import pytest

from optloc.base.errors import InvalidProblem
from optloc.lab.datasets.reading import VARIABLE, along, check_files, choose, cut_windows, places, root, table


def test_the_folder_is_the_one_that_is_named_or_that_of_the_variable(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert root() == tmp_path
    with pytest.raises(InvalidProblem, match="no such folder"):
        root(tmp_path / "other")


def test_a_file_is_checked_by_its_sum(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"x_m\n1\n")
    check_files(tmp_path, {"a.csv": hashlib.sha256(b"x_m\n1\n").hexdigest()})
    with pytest.raises(InvalidProblem, match=r"a\.csv: this is a different file"):
        check_files(tmp_path, {"a.csv": hashlib.sha256(b"x_m\n2\n").hexdigest()})


def test_a_table_without_columns_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("")
    with pytest.raises(InvalidProblem, match=r"a\.csv: the table cannot be read"):
        table(tmp_path, "a")


def test_an_option_is_one_of_the_known_ones():
    assert choose(2, (1, 2), "number") == 2
    with pytest.raises(InvalidProblem, match="form: 'afine' is unknown; did you mean 'affine'"):
        choose("afine", ("raw", "affine"), "form")


def test_places_in_the_plane_have_two_coordinates_and_are_linear_in_time():
    truth = pd.DataFrame({"t_s": [0.0, 2.0], "x_m": [0.0, 4.0], "y_m": [10.0, 0.0]})
    assert places(truth).tolist() == [[0.0, 10.0], [4.0, 0.0]]
    assert along(np.array([0.5, 1.0]), truth).tolist() == [[1.0, 7.5], [2.0, 5.0]]


def test_a_window_takes_the_rows_from_its_begin_to_before_its_end():
    rows = pd.DataFrame({"t_s": [0.4, 0.5, 1.0, 1.4, 1.5, 2.6, 3.4, 3.5]})
    found = cut_windows(rows, np.array([1.0, 3.0]), 1.0)
    assert found["t_s"].tolist() == [0.5, 1.0, 1.4, 2.6, 3.4]
    assert found["window"].tolist() == [0, 0, 0, 1, 1]
