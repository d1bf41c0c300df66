"""The command line: ``optloc fix``, ``check``, ``track`` and so on; ``optloc --help`` lists them."""

from optloc.cli.app import app, main

__all__ = ["app", "main"]
