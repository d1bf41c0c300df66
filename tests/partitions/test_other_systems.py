"""The recipes of the page for Dask, Ray Data and Spark; for a system that is not installed, its rules alone."""

import importlib.util
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from partitions.scenes import STATIONS, arrivals, write

from optloc import fix_table
from optloc.partitions import fix_schema

PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "scale.md"
SIGMA = "30 ns"  # of the page
EVENTS, PARTS = 30, 2
SPARK_DTYPES = {"string": "string", "double": "float64", "bigint": "int64", "boolean": "bool"}


def recipe(word):
    """Return the block of the page that names a module, for a data set in this folder."""
    blocks = re.findall(r"^```\S*(?: python)?\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    (found,) = (block for block in blocks if word in block)
    return found.replace("s3://bucket/arrivals", "arrivals")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Enter a folder with the data set of the page, and return the fixes of all its readings."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
    write(tmp_path / "arrivals", PARTS, EVENTS)
    return fix_table(pd.read_parquet("arrivals"), "sites.csv", sigma=SIGMA)


def check(fixes, known):
    """Check that a table has one row for each event, with the fix of this event."""
    found = fixes.assign(number=fixes["epoch"].astype(int)).sort_values("number")
    assert list(fixes.columns) == list(fix_schema().columns)
    assert found["epoch"].tolist() == known["epoch"].tolist()
    assert found["status"].tolist() == known["status"].tolist()
    names = ["x", "y", "cov_xx", "cost"]
    assert np.allclose(found[names].to_numpy(float), known[names].to_numpy(float), rtol=1e-6)


def test_functions_of_groups_keep_the_rules_of_spark(here):
    """`applyInPandas` calls the function with the readings of a group, and declares the columns and their types."""
    readings = pd.read_parquet("arrivals")
    groups = [fix_table(group, "sites.csv", sigma=SIGMA) for _, group in readings.groupby(readings["message"] % 7)]
    declared = dict(part.split() for part in fix_schema("spark").split(", "))
    for fixes in groups:
        assert {name: str(kind) for name, kind in fixes.dtypes.items()} == {
            name: str(pd.Series(dtype=SPARK_DTYPES[kind]).dtype) for name, kind in declared.items()
        }
    check(pd.concat(groups), here)


def test_a_column_of_groups_is_ignored():
    table, _ = arrivals(0, 3)
    known = fix_table(table, STATIONS, sigma=SIGMA)
    found = fix_table(table.assign(part=table["message"] % 2), STATIONS, sigma=SIGMA, ignore=["part"])
    pd.testing.assert_frame_equal(found, known)


def test_dask_keeps_large_files_whole(tmp_path):
    """Dask divides files above its block size at row groups, also between two readings of an event."""
    dataframe = pytest.importorskip("dask.dataframe")
    assert "split_row_groups=False" in recipe("dask.dataframe")
    arrivals(0, 500)[0].to_parquet(tmp_path / "a.parquet", index=False, row_group_size=100)
    options = {"blocksize": "4kB"}
    assert dataframe.read_parquet(tmp_path, **options).npartitions > 1
    assert dataframe.read_parquet(tmp_path, split_row_groups=False, **options).npartitions == 1


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
def test_the_recipe_of_ray_data_gives_the_fixes_and_the_schema(here):
    import ray

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    try:
        # Small blocks divide the readings of an event, unless they are grouped.
        ray.data.DataContext.get_current().target_max_block_size = 1000
        names: dict = {}
        exec(recipe("import optloc, ray"), names)
        fixes = names["fixes"].materialize()
        assert dict(zip(fixes.schema().names, map(str, fixes.schema().types), strict=True)) == {
            entry.name: str(entry.type) for entry in fix_schema("arrow")
        }
        check(fixes.to_pandas(), here)
    finally:
        ray.shutdown()


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("pyspark") is None, reason="Spark is not installed")
@pytest.mark.skipif(shutil.which("java") is None, reason="Java is not installed")
def test_the_recipe_of_spark_gives_the_fixes(here, monkeypatch):
    from pyspark.sql import SparkSession

    monkeypatch.setenv("PYSPARK_PYTHON", sys.executable)
    settings = {"spark.ui.enabled": "false", "spark.sql.shuffle.partitions": "2"}
    spark = SparkSession.builder.master("local[2]").config(map=settings).getOrCreate()
    try:
        names = {"readings": spark.read.parquet("arrivals")}
        exec(recipe("applyInPandas("), names)
        check(names["fixes"].toPandas(), here)
    finally:
        spark.stop()
