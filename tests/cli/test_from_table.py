"""Options of tables: which files take them, what --column names, and commands that are given them."""

from inspect import signature
from pathlib import Path

import pytest

from optloc import InvalidProblem
from optloc.cli.from_table import columns_of, read_problem, table_hints, takes_table
from optloc.cli.options import shipped_problems
from optloc.files import read


def test_columns_are_named_by_role():
    assert columns_of(["station=receiver", "toa=t=1"]) == {"station": "receiver", "toa": "t=1"}
    assert columns_of(None) == {}
    with pytest.raises(InvalidProblem, match="'station=' does not name a column"):
        columns_of(["station="])


@pytest.mark.parametrize("name", ["a.csv", "a.JSON", "a.parquet", "brdc.21o", "a.rnx"])
def test_tables_are_known_by_their_ending(name):
    assert table_hints(Path(name), {"sigma": "3 m"}).sigma == "3 m"


def test_a_problem_file_takes_no_option_of_tables():
    assert table_hints(Path("a.toml"), {"sigma": None, "what": None}) is None
    for given, flag in (({"what": "arrivals"}, "--as"), ({"time_unit": "s"}, "--time-unit")):
        with pytest.raises(InvalidProblem, match="is a problem file") as refused:
            table_hints(Path("a.toml"), given)
        assert refused.value.where == flag


def test_a_command_is_given_the_options_as_one_mapping():
    seen = []

    @takes_table
    def command(file: Path, *, given) -> None:
        seen.append((file, given))

    options = {name: None for name in signature(command).parameters if name != "file"}
    command(file=Path("a.csv"), **options | {"columns": ["x=y"], "sigma": "3 m"})
    file, given = seen[0]
    assert (file, given["columns"], given["sigma"], given["ignore"]) == (Path("a.csv"), {"x": "y"}, "3 m", ())


def test_a_problem_file_is_read_as_it_is():
    path = shipped_problems()["demo"]
    assert read_problem(path, None).problem.z.tolist() == read(path).problem.z.tolist()
