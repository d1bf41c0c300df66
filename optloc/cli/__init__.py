"""The command line: ``optloc fix``, ``simulate``, ``crlb``, ``check``, ``list``, ``schema``, ``demo``."""

from optloc.cli.app import app, main

__all__ = ["app", "main"]
