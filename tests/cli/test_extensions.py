"""What neighbours add: every neighbour of this checkout is found, and names of its entries are new."""

from importlib.util import find_spec

import typer

from optloc.cli.extensions import NEIGHBOURS, KernelPart, extensions
from optloc.cli.listing import lists


def test_every_installed_neighbour_adds_its_commands():
    assert len(extensions()) == sum(find_spec(name) is not None for name in NEIGHBOURS)
    for one in extensions():
        application = typer.Typer()
        one.commands(application)
        assert application.registered_commands or application.registered_groups


def test_neighbours_do_not_replace_each_other():
    for kind in ("lists", "pictures", "facts"):
        names = [name for one in extensions() for name in getattr(one, kind)]
        assert len(names) == len(set(names)), kind
    assert {name for one in extensions() for name in one.lists} <= lists().keys()


def test_a_part_misses_the_kernels_that_are_not_on_disk(monkeypatch):
    monkeypatch.setattr("optloc.kernels.jit.named", lambda name: name)
    monkeypatch.setattr("optloc.kernels.code_cache.is_cached", lambda kernel: kernel == "here")
    assert KernelPart("a part", "optloc", (), ("here", "gone")).missing() == ["gone"]
