"""The command `optloc fix` for data sets: an account, exit codes, and options without a use."""

import json

import pandas as pd
import pytest
from partitions.scenes import SIGMA, arrivals, write
from typer.testing import CliRunner

from optloc.cli import app


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "readings", 15, 4)
    common = ["--stations", "sites.csv", "--sigma", SIGMA, "--method", "gtrs+lsr"]
    return lambda *args: CliRunner().invoke(app, ["fix", "readings", *common, *args])


def test_the_account_has_all_statuses_and_the_second_run_keeps_all(run, tmp_path):
    first = run("--out", "fixes", "--allow", "unproven,ambiguous,curved")
    assert first.exit_code == 0, first.output
    assert "3 more partitions are in the total" in first.output
    assert "15 partitions are fixed. The fixes are in fixes." in first.output
    again = json.loads(run("--out", "fixes", "--json").stdout)
    assert (again["kept"], again["fixes"], len(again["partitions"])) == (15, 60, 15)
    assert sum(again["statuses"].values()) == len(pd.read_parquet(tmp_path / "fixes")) == 60


def test_exit_codes_follow_the_statuses_and_the_failures(run, tmp_path):
    arrivals(900, 1)[0].iloc[:2].to_parquet(tmp_path / "readings" / "few.parquet", index=False)
    assert run("--out", "fixes").exit_code == 1
    (tmp_path / "readings" / "part-3.parquet").write_bytes(b"")
    failed = run("--out", "fixes")
    assert failed.exit_code == 2
    assert "part-3.parquet" in failed.stderr
    assert "14 partitions are fixed" not in failed.stderr


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ([], "a folder is a data set, whose fixes need another folder; add --out DIR"),
        (["--out", "s3://bucket/fixes"], "address of an object store"),
        (["--out", "fixes", "--plot", "a.png"], "--plot: this option has no use here"),
        (["--out", "fixes", "--noise-from-data", "auto"], "--noise-from-data: this option has no use here"),
        (["--out", "fixes", "--window", "1 s"], "--window: each partition would begin with a new window"),
        (["--out", "fixes", "--jobs", "2"], "--jobs: the fixes are computed in this process"),
    ],
)
def test_options_without_a_use_are_refused(run, tmp_path, options, text):
    done = run(*options)
    assert done.exit_code == 2
    assert text in done.output
    assert not (tmp_path / "fixes").exists()


def test_addresses_and_files_are_told_apart_from_data_sets(run):
    done = CliRunner().invoke(app, ["fix", "s3://bucket/readings", "--out", "fixes"])
    assert (done.exit_code, "address of an object store" in done.output) == (2, True)
    done = CliRunner().invoke(app, ["fix", "demo", "--executor", "dask"])
    assert (done.exit_code, "--executor: this option has no use here" in done.output) == (2, True)
