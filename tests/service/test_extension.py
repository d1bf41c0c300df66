"""What the service adds to the command line."""

import typer

from optloc.service.command import live, serve
from optloc.service.extension import EXTENSION


def test_the_service_adds_live_and_serve_and_nothing_else():
    app = typer.Typer()
    EXTENSION.commands(app)
    assert [command.callback for command in app.registered_commands] == [live, serve]
    assert all("optloc" in command.epilog for command in app.registered_commands)
    assert [*EXTENSION.lists, *EXTENSION.pictures, *EXTENSION.facts] == []
