"""Extension of the command line by the commands ``optloc live`` and ``optloc serve``."""

from __future__ import annotations

import typer

from optloc.cli import ANSWERS, Extension
from optloc.service.command import EXAMPLES, SERVED, live, serve


def _commands(app: typer.Typer) -> None:
    """Add the commands `live` and `serve` to the command line."""
    app.command(rich_help_panel=ANSWERS, epilog=EXAMPLES)(live)
    app.command(rich_help_panel=ANSWERS, epilog=SERVED)(serve)


EXTENSION = Extension(_commands)
