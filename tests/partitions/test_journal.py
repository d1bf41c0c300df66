"""Data sets and journals: only complete lines and files with the right checksum count."""

import json

import pytest
from partitions.scenes import write

from optloc import InvalidProblem
from optloc.partitions.journal import (
    JOURNAL,
    FinishedPartition,
    Journal,
    digest_of,
    folder_keys,
    locked_output,
    partition_names,
)

OPTIONS = {"method": "auto", "sigma": "3 m"}


def test_partitions_of_folders_are_found_and_hidden_files_are_not(tmp_path):
    for name in ("b.parquet", "day=1/a.parquet", "day=2/a.pq", "_x/a.parquet", ".b.parquet", "_c.parquet", "d.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert partition_names(tmp_path) == ["b.parquet", "day=1/a.parquet", "day=2/a.pq"]
    assert folder_keys("day=1/site=x y/a.parquet") == {"day": "1", "site": "x y"}
    assert folder_keys("b=1.parquet") == {}


def test_folders_that_are_no_data_set_are_refused(tmp_path):
    with pytest.raises(InvalidProblem, match="there is no such folder"):
        partition_names(tmp_path / "none")
    with pytest.raises(InvalidProblem, match="has no Parquet file"):
        partition_names(tmp_path)


@pytest.mark.parametrize("place", [".", "..", "inner"])
def test_fixes_are_never_inside_the_data_set(tmp_path, place):
    data_set = tmp_path / "data"
    data_set.mkdir()
    with pytest.raises(InvalidProblem, match="inside the data set"), locked_output(data_set / place, data_set):
        pass


def test_one_run_writes_and_other_files_are_left_alone(tmp_path):
    out = tmp_path / "out"
    again = locked_output(out, tmp_path / "data")
    with locked_output(out, tmp_path / "data"), pytest.raises(InvalidProblem, match="another run writes"), again:
        pass
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").touch()
    with pytest.raises(InvalidProblem, match="has other files"), locked_output(tmp_path / "full", tmp_path / "data"):
        pass


def test_a_part_of_a_line_and_of_a_file_does_not_count(tmp_path):
    data_set, _ = write(tmp_path / "data", 2, 2)
    out = tmp_path / "out"
    out.mkdir()
    journal = Journal(out, OPTIONS)
    for name in ("part-0.parquet", "part-1.parquet"):
        (out / name).write_bytes(b"fixes")
        journal.add(FinishedPartition(name, digest_of(data_set / name), digest_of(out / name), True, {"ok": 2}))
    text = (out / JOURNAL).read_text()
    (out / JOURNAL).write_text(text[:-5])
    (out / ".optloc-1.parquet").touch()
    journal = Journal(out, OPTIONS)
    assert list(journal.finished) == ["part-0.parquet"]
    assert not list(out.glob(".optloc-*"))
    assert journal.is_done("part-0.parquet", data_set)
    journal.add(FinishedPartition("part-1.parquet", "0", "0", True, {}))  # on a new line, after the part of a line
    assert len(Journal(out, OPTIONS).finished) == 2
    for path in (out / "part-0.parquet", data_set / "part-0.parquet"):
        content = path.read_bytes()
        path.write_bytes(content + b" ")
        assert not journal.is_done("part-0.parquet", data_set)
        path.write_bytes(content)
    (out / "part-0.parquet").unlink()
    assert not journal.is_done("part-0.parquet", data_set)


def test_other_options_and_a_damaged_journal_are_one_sentence(tmp_path):
    Journal(tmp_path, OPTIONS)
    with pytest.raises(InvalidProblem, match="fixes with another sigma"):
        Journal(tmp_path, OPTIONS | {"sigma": "4 m"})
    for line in ("[1]", "{", json.dumps({"name": 1})):
        (tmp_path / JOURNAL).write_text(f"{json.dumps(OPTIONS)}\n{line}\n")
        with pytest.raises(InvalidProblem, match="the journal is damaged"):
            Journal(tmp_path, OPTIONS)
