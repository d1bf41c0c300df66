"""What sites add to the command line: two commands, and kernels that exist."""

from importlib import import_module

import typer

from optloc.sites.extension import EXTENSION


def test_the_commands_are_place_and_calibrate():
    app = typer.Typer()
    EXTENSION.commands(app)
    assert [command.callback.__name__ for command in app.registered_commands] == ["place", "calibrate"]
    assert all(f"optloc {c.callback.__name__}" in c.epilog for c in app.registered_commands)


def test_every_kernel_that_is_to_be_compiled_is_there():
    (part,) = EXTENSION.kernels().values()
    for entry in part.entries:
        module, _, name = entry.rpartition(".")
        assert module.startswith(part.package)
        assert callable(getattr(import_module(module), name))
