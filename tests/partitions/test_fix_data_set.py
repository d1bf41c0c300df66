"""Data sets: partitions in and out, a stopped run continues, and an event in two partitions is found."""

import importlib.util
import json
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from partitions.scenes import SIGMA, STATIONS, arrivals, wide, write

from optloc import InvalidProblem, fix_table
from optloc.files.table_import import ColumnHints
from optloc.partitions import fix_data_set as module
from optloc.partitions.executors import Died, TaskExecutor
from optloc.partitions.fix_data_set import fix_data_set, fix_partition
from optloc.partitions.fix_options import FixOptions
from optloc.partitions.journal import JOURNAL

HERE = TaskExecutor()


def options_of(sites, **hints):
    return FixOptions(ColumnHints(stations=sites, **{"sigma": SIGMA} | hints), "gtrs+lsr")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write(tmp_path_factory.mktemp("data") / "readings")


def tables(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.parquet")}


def test_partitions_keep_their_names_and_have_the_fixes_of_fix_table(data, tmp_path):
    folder, sites = data
    told = []
    account = fix_data_set(folder, tmp_path / "out", options_of(sites), HERE, lambda *numbers: told.append(numbers))
    assert [one.name for one in account.finished] == ["part-0.parquet", "part-1.parquet", "part-2.parquet"]
    assert (sum(account.counts.values()), account.kept, account.failed) == (60, 0, {})
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]
    found = pd.read_parquet(tmp_path / "out" / "part-1.parquet", dtype_backend="numpy_nullable")
    known = fix_table(arrivals(20, 20)[0], STATIONS, sigma=SIGMA, method="gtrs+lsr")
    assert found["epoch"].tolist() == known["epoch"].tolist()
    assert found["x"].to_numpy(float).tobytes() == known["x"].to_numpy().tobytes()


def test_a_stopped_run_continues_and_the_tables_are_the_same(data, tmp_path, monkeypatch):
    folder, sites = data
    fix_data_set(folder, tmp_path / "whole", options_of(sites), HERE)
    work, done = module.fix_partition, []

    def stop(task):
        if done:
            raise KeyboardInterrupt
        done.append(task.name)
        return work(task)

    monkeypatch.setattr(module, "fix_partition", stop)
    with pytest.raises(KeyboardInterrupt):
        fix_data_set(folder, tmp_path / "out", options_of(sites), HERE)
    monkeypatch.setattr(module, "fix_partition", lambda task: done.append(task.name) or work(task))
    account = fix_data_set(folder, tmp_path / "out", options_of(sites), HERE)
    assert (account.kept, done) == (1, ["part-0.parquet", "part-1.parquet", "part-2.parquet"])
    assert tables(tmp_path / "out") == tables(tmp_path / "whole")
    # A damaged partition is computed again, and nothing else.
    path = tmp_path / "out" / "part-1.parquet"
    path.write_bytes(path.read_bytes()[:-1])
    done.clear()
    assert fix_data_set(folder, tmp_path / "out", options_of(sites), HERE).kept == 2
    assert done == ["part-1.parquet"]
    assert tables(tmp_path / "out") == tables(tmp_path / "whole")


def test_other_options_and_other_stations_need_another_folder(data, tmp_path):
    folder, sites = data
    out, own = tmp_path / "out", tmp_path / "sites.csv"
    shutil.copy(sites, own)
    fix_data_set(folder, out, options_of(own), HERE)
    with pytest.raises(InvalidProblem, match="fixes with another method"):
        fix_data_set(folder, out, replace(options_of(own), method="auto"), HERE)
    with pytest.raises(InvalidProblem, match="fixes with another sigma"):
        fix_data_set(folder, out, options_of(own, sigma="31 ns"), HERE)
    own.write_text(own.read_text().replace("5000", "5001"))
    with pytest.raises(InvalidProblem, match="fixes with another stations"):
        fix_data_set(folder, out, options_of(own), HERE)


@pytest.mark.parametrize("stopped", [False, True])
def test_an_event_in_two_partitions_is_named_with_both_files(tmp_path, stopped):
    folder, sites = write(tmp_path / "readings")
    table = arrivals(0, 60)[0]
    shared = table[table["message"] == 7]
    later = pd.read_parquet(folder / "part-2.parquet")
    if stopped:
        fix_data_set(folder, tmp_path / "out", options_of(sites), HERE)
    pd.concat([later, shared.iloc[:4]]).to_parquet(folder / "part-2.parquet", index=False)
    text = r"part-0\.parquet and part-2\.parquet: the event '7' is in both partitions; write all readings"
    with pytest.raises(InvalidProblem, match=text):
        fix_data_set(folder, tmp_path / "out", options_of(sites), HERE)


def test_events_of_a_table_without_labels_are_its_rows(tmp_path):
    (tmp_path / "readings").mkdir()
    for i in range(2):
        wide(10 * i, 5)[0].drop(columns="event").to_parquet(tmp_path / "readings" / f"{i}.parquet", index=False)
    sites = write(tmp_path / "other")[1]
    account = fix_data_set(tmp_path / "readings", tmp_path / "out", options_of(sites, sigma="5 m"), HERE)
    assert sum(account.counts.values()) == 10


def test_keys_of_hive_folders_are_columns_if_an_option_names_them(tmp_path):
    folder, sites = write(tmp_path / "readings", 2)
    for i, day in enumerate(("2026-06-01", "2026-06-02")):
        (folder / f"day={day}").mkdir()
        arrivals(0, 20, seed=i)[0].to_parquet(folder / f"day={day}" / "a.parquet", index=False)
        (folder / f"part-{i}.parquet").unlink()
    with pytest.raises(InvalidProblem, match="--column message=day\\+id"):
        fix_data_set(folder, tmp_path / "out", options_of(sites), HERE)
    joined = options_of(sites, columns={"message": "day+message"})
    account = fix_data_set(folder, tmp_path / "joined", joined, HERE)
    assert [one.name for one in account.finished] == ["day=2026-06-01/a.parquet", "day=2026-06-02/a.parquet"]
    found = pd.read_parquet(tmp_path / "joined")
    assert min(found["epoch"]) == "2026-06-01-0"
    assert sorted(set(found["day"].astype(str))) == ["2026-06-01", "2026-06-02"]


def test_a_partition_that_cannot_be_read_is_named_and_the_others_are_fixed(tmp_path):
    folder, sites = write(tmp_path / "readings")
    (folder / "part-1.parquet").write_bytes(b"PAR1")
    account = fix_data_set(folder, tmp_path / "out", options_of(sites), HERE)
    assert len(account.finished) == 2
    assert "the file is not Parquet" in account.failed["part-1.parquet"]
    assert not (tmp_path / "out" / "part-1.parquet").exists()


def test_a_worker_that_ends_at_a_partition_is_a_sentence(data, tmp_path, monkeypatch):
    folder, sites = data

    class Mortal(TaskExecutor):
        def run(self, work, tasks):
            for task in tasks:
                yield task, Died("the workers ended") if task.name == "part-0.parquet" else work(task)

    account = fix_data_set(folder, tmp_path / "out", options_of(sites), Mortal())
    assert account.failed == {"part-0.parquet": "part-0.parquet: the workers ended"}
    assert len((tmp_path / "out" / JOURNAL).read_text().splitlines()) == 3


def test_empty_partitions_have_the_schema(tmp_path):
    folder, sites = write(tmp_path / "readings", 1)
    arrivals(0, 2)[0].iloc[:0].to_parquet(folder / "empty.parquet", index=False)
    fix_data_set(folder, tmp_path / "out", options_of(sites), HERE)
    whole = pd.read_parquet(tmp_path / "out")
    assert len(whole) == 20
    assert np.isfinite(whole["x"]).all()


def test_the_journal_names_all_that_the_fixes_depend_on(data, tmp_path):
    folder, sites = data
    fix_data_set(folder, tmp_path / "out", options_of(sites), HERE)
    header = json.loads((tmp_path / "out" / JOURNAL).read_text().splitlines()[0])
    assert header["stations"].startswith("checksum ")
    assert (header["method"], header["sigma"]) == ("gtrs+lsr", SIGMA)


@pytest.mark.full
def test_a_worker_that_is_killed_in_the_middle_changes_nothing(tmp_path):
    """Two workers of Dask write the bytes of one process, although one of them is killed."""
    pytest.importorskip("distributed")
    psutil = pytest.importorskip("psutil")
    folder, sites = write(tmp_path / "readings", 12, 3000)
    options = options_of(sites)
    fix_data_set(folder, tmp_path / "one", options, HERE)
    killed = []

    def kill_once(done, total):
        workers = [one for one in psutil.Process().children(recursive=True) if "spawn_main" in " ".join(one.cmdline())]
        if done >= 2 and workers and not killed:
            killed.append(workers[-1].pid)
            workers[-1].kill()

    account = fix_data_set(folder, tmp_path / "two", options, TaskExecutor("dask", 2), kill_once)
    assert killed
    assert (len(account.finished), account.failed) == (12, {})
    assert tables(tmp_path / "two") == tables(tmp_path / "one")


def fix_or_die(task):
    """Fix a partition; the first worker that fixes partition 1 ends without a reply after its file is complete."""
    result, mark = fix_partition(task), task.folder.parent / "died"
    if task.name == "part-1.parquet" and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return result


@pytest.mark.parametrize(
    ("name", "package"), [("dask", "distributed"), pytest.param("ray", "ray", marks=pytest.mark.slow)]
)
def test_a_cluster_that_loses_a_worker_writes_the_same_bytes(tmp_path, monkeypatch, importable, name, package):
    """`test_a_worker_that_is_killed_in_the_middle_changes_nothing` and the benchmark have larger data sets."""
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    folder, sites = write(tmp_path / "readings", 6)
    fix_data_set(folder, tmp_path / "one", options_of(sites), HERE)
    monkeypatch.setattr(module, "fix_partition", fix_or_die)
    account = fix_data_set(folder, tmp_path / "two", options_of(sites), TaskExecutor(name, 2))
    assert (tmp_path / "died").exists()
    assert (len(account.finished), account.failed) == (6, {})
    assert tables(tmp_path / "two") == tables(tmp_path / "one")
