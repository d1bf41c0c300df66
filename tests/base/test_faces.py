"""Packages whose exports load on first use."""

import sys
from types import ModuleType

import pytest

from optloc.base.faces import exported

FACE = """
from typing import TYPE_CHECKING
import os
if TYPE_CHECKING:
    from json import dumps as written, loads
    from xml import dom
if other:
    from json import JSONEncoder
"""


@pytest.fixture
def face(tmp_path, monkeypatch):
    """Return what `exported` returns for a package with those imports, and the package."""
    (tmp_path / "face.py").write_text(FACE)
    package = ModuleType("face")
    monkeypatch.setitem(sys.modules, "face", package)
    return *exported("face", str(tmp_path / "face.py")), package


def test_the_imports_for_type_checkers_are_the_exports(face):
    _, listed, names, _ = face
    assert names == ["dom", "loads", "written"] == listed()


def test_a_name_loads_under_its_alias_or_as_a_module_and_is_kept_in_the_package(face):
    find, *_, package = face
    assert find("written")([1, 2]) == "[1, 2]"
    assert find("dom").__name__ == "xml.dom"
    assert sorted(set(vars(package)) & {"written", "dom", "loads"}) == ["dom", "written"]


def test_a_name_that_is_not_exported_is_an_attribute_error(face):
    with pytest.raises(AttributeError, match="module 'face' has no attribute 'JSONEncoder'"):
        face[0]("JSONEncoder")
