"""Wheels of machine code: what stands in their way is said before anything is packed."""

import pytest

from optloc import InvalidProblem
from optloc.cli import wheel


def test_without_machine_code_there_is_nothing_to_pack(monkeypatch, tmp_path):
    monkeypatch.setattr(wheel, "enabled", lambda: False)
    with pytest.raises(InvalidProblem, match="numba is not installed"):
        wheel.run_wheel(tmp_path)


def test_the_library_that_packs_is_named_where_it_is_missing(monkeypatch, tmp_path):
    monkeypatch.setattr(wheel, "find_spec", lambda name: None)
    with pytest.raises(InvalidProblem, match="library wheel") as refused:
        wheel.pack(tmp_path, tmp_path)
    assert "optloc[wheel]" in refused.value.advice


def test_a_folder_that_cannot_be_made_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(wheel, "find_spec", lambda name: True)
    monkeypatch.setattr(wheel, "names_in", lambda package: [])
    (tmp_path / "file").touch()
    with pytest.raises(InvalidProblem, match="cannot be created") as refused:
        wheel.pack(tmp_path, tmp_path / "file" / "out")
    assert refused.value.where == str(tmp_path / "file" / "out")


def test_code_is_packed_for_common_processors():
    for name, features in wheel._COMMON.values():
        words = features.split()
        assert name
        assert len(words) == len(set(words)) > 5
