"""The command line: ``optloc fix``, ``check``, ``track`` and so on; ``optloc --help`` lists them."""

from optloc.cli import begin, lookup
from optloc.cli.app import ANSWERS, MORE, app, main
from optloc.cli.plot import EXAMPLES, plot
from optloc.cli.study import study

app.command(rich_help_panel=ANSWERS, epilog=EXAMPLES)(plot)
app.add_typer(study, name="study", rich_help_panel=MORE)

__all__ = ["app", "begin", "lookup", "main"]
