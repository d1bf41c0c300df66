"""The command line: ``optloc fix``, ``simulate``, ``crlb``, ``check``, ``study``, ``list``, ``schema``, ``demo``."""

from optloc.cli.app import app, main
from optloc.cli.study import study

app.add_typer(study, name="study")

__all__ = ["app", "main"]
