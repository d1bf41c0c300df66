"""The command line: ``optloc fix``, ``check``, ``track`` and so on; ``optloc --help`` lists them."""

from optloc.cli import app as begin
from optloc.cli import app as lookup
from optloc.cli.app import ANSWERS, EXAMPLES, MORE, app, main, plot
from optloc.cli.study import study

app.command(rich_help_panel=ANSWERS, epilog=EXAMPLES)(plot)
app.add_typer(study, name="study", rich_help_panel=MORE)

__all__ = ["app", "begin", "lookup", "main"]
