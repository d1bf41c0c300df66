"""Tables that packages extend: what cannot be used is left out, by name, and optloc goes on."""

import subprocess
import sys
import warnings

import pytest
from recipes import installed, write_package

from optloc import InvalidProblem
from optloc.base.registry import Registry
from optloc.models import MODELS, Model
from optloc.tracking import UPDATES

BAD = {
    "does not import": ("raise OSError('no driver')", {"bad": "module"}, ["does not load", "OSError: no driver"]),
    "names nothing": ("", {"bad": "module:kind"}, ["does not load", "AttributeError"]),
    "is missing": ("", {"bad": "elsewhere:kind"}, ["does not load", "elsewhere"]),
    "is something else": ("kind = 3", {"bad": "module:kind"}, ["int", "not valid there"]),
    "is no kind": (
        "import optloc\nkind = optloc.models.Model(abs, 'luminosity', 1, 'x')",
        {"bad": "module:kind"},
        ["unknown quantity 'luminosity'"],
    ),
    "takes a name": (
        "import optloc\nkind = optloc.models.MODELS['groa']",
        {"tdoa": "module:kind"},
        ["'tdoa' is taken"],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_package_that_cannot_be_used_is_named_and_left_out(case, tmp_path, monkeypatch):
    text, entries, words = BAD[case]
    monkeypatch.delitem(sys.modules, "module", raising=False)
    before = list(MODELS)
    write_package(tmp_path, {"module.py": text}, "lame-kinds", {"optloc.models": entries})
    with installed(tmp_path):
        with pytest.warns(RuntimeWarning, match="the package 'lame-kinds' adds nothing to optloc.models") as seen:
            assert list(MODELS) == before
        assert len(seen) == 1
        assert all(word in str(seen[0].message) for word in words), seen[0].message
        assert MODELS["tdoa"].ranges == (1, -1)
        with warnings.catch_warnings(action="error"):  # once is enough
            assert "bad" not in MODELS
    monkeypatch.delitem(sys.modules, "module", raising=False)


def test_of_two_packages_with_one_name_the_second_is_refused(tmp_path, monkeypatch):
    for name in ("one", "two"):
        write_package(
            tmp_path,
            {f"{name}_update.py": f"def update(scan, mean, cov):\n    return {name!r}\n"},
            name,
            {"optloc.trackers": {"same": f"{name}_update:update"}},
        )
    with installed(tmp_path):
        with pytest.warns(RuntimeWarning, match="'same' is taken") as seen:
            kept = UPDATES["same"](None, None, None)
        assert len(seen) == 1
        assert f"the package {({'one', 'two'} - {kept}).pop()!r}" in str(seen[0].message)


def test_a_package_may_look_at_the_table_while_it_is_loaded(tmp_path, monkeypatch):
    text = "import optloc\nseen = sorted(optloc.models.MODELS)\nkind = optloc.models.MODELS['range']\n"
    write_package(tmp_path, {"curious_module.py": text}, "curious", {"optloc.models": {"again": "curious_module:kind"}})
    with installed(tmp_path):
        assert MODELS["again"] is MODELS["range"]


def test_a_table_is_a_dictionary_that_grows():
    table = Registry("optloc.none", callable, {"abs": abs})
    table["max"] = max
    assert list(table) == ["abs", "max"]
    assert len(table) == 2
    assert table.get("min") is None
    del table["max"]
    assert dict(table) == {"abs": abs}
    with pytest.raises(KeyError):
        table["max"]
    assert repr(table) == "Registry('optloc.none': abs)"


def test_the_names_of_optloc_need_no_look_at_packages():
    code = (
        "import optloc; optloc.models.MODELS['tdoa'], optloc.solvers.SOLVERS['lsr']; print(optloc.models.MODELS._found)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "None"


@pytest.mark.parametrize(("change", "words"), [({"quantity": "lenght"}, "'length'"), ({"stations": 3}, "0, 1 or 2")])
def test_a_kind_that_no_row_can_have_is_refused(change, words):
    given = {"h": lambda t, a, b: 0.0, "quantity": "length", "stations": 1, "summary": "x"} | change
    with pytest.raises(InvalidProblem, match=words):
        Model(**given)
