"""Lists of everything that has a name: fields and summaries of entries, and each name once."""

import json
from dataclasses import dataclass

import pytest

from optloc import InvalidProblem
from optloc.cli.listing import describe, lists, registry, run_list
from optloc.models import MODELS


@dataclass
class Entry:
    summary: str
    count: int
    code: object


def test_an_entry_shows_its_fields_but_no_code():
    def function():
        """Return something useful."""

    found = describe("thing", {"a": Entry("an entry", 3, print), "b": "a text", "c": function})
    assert found == [
        {"thing": "a", "count": "3", "summary": "an entry"},
        {"thing": "b", "summary": "a text"},
        {"thing": "c", "summary": "something useful."},
    ]


@pytest.mark.parametrize("name", ["kinds", "methods", "losses", "motions", "formats", "pictures", "demos", "starters"])
def test_every_name_is_listed_once_with_a_summary(name):
    rows = lists()[name]()
    names = [next(iter(row.values())) for row in rows]
    assert len(set(names)) == len(names) > 1
    assert all(row["summary"] for row in rows)


def test_lists_are_printed_as_json_and_unknown_ones_are_refused(capsys):
    assert run_list("kinds", as_json=True) == 0
    assert [row["kind"] for row in json.loads(capsys.readouterr().out)] == list(MODELS)
    with pytest.raises(InvalidProblem, match="did you mean 'kinds'"):
        run_list("kind", as_json=True)


def test_a_table_is_imported_by_its_place():
    assert [row["loss"] for row in registry("loss", "optloc.problem:LOSSES")()]
    with pytest.raises(ModuleNotFoundError):
        registry("loss", "optloc.nowhere:LOSSES")()
