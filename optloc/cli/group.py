"""Commands that end in one line and a stable exit code, whatever goes wrong."""

from __future__ import annotations

import logging
import sys
from typing import Any

import typer
from typer.core import TyperGroup

from optloc.errors import InvalidProblem, nearest

BAD_INPUT, STOPPED = 2, 130
"""Exit codes: bad input, Ctrl-C."""

EXIT_CODES = "Exit codes: 0 everything is ok, 1 some status is not ok, 2 bad input, 130 stopped by Ctrl-C."


class Group(TyperGroup):
    """Commands whose bad input is a sentence, not a traceback."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run the command that the arguments name; what is wrong with them is one line."""
        standalone = kwargs.pop("standalone_mode", True)
        try:
            code = super().main(*args, **{**kwargs, "standalone_mode": False})
        except Exception as error:
            # Usage errors. Their classes have another home in each release of typer, but all can be spelled.
            if not standalone or not hasattr(error, "format_message"):
                raise
            code = _said(_usage(error))
        if not standalone:
            return code
        sys.exit(code if isinstance(code, int) else 0)

    def invoke(self, ctx: Any) -> Any:
        """Run a command; malformed input and what the system refuses end in exit code 2, Ctrl-C in 130."""
        try:
            return super().invoke(ctx)
        except InvalidProblem as error:
            raise typer.Exit(_said(str(error))) from None
        except BrokenPipeError:
            raise
        except OSError as error:
            raise typer.Exit(_said(f"{error.filename or 'optloc'}: {error.strerror or error}.")) from None
        except KeyboardInterrupt:
            typer.echo("Stopped.", err=True)
            raise typer.Exit(STOPPED) from None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that is named; raise InvalidProblem where there is none, naming the nearest."""
        names = self.list_commands(ctx)
        if args and args[0] not in names:
            raise InvalidProblem(f"there is no command {args[0]!r}", ctx.command_path, nearest(args[0], names))
        return super().resolve_command(ctx, args)


def _said(sentence: str) -> int:
    """Print one line on standard error, and return the exit code of bad input."""
    typer.echo(" ".join(sentence.split()), err=True)
    return BAD_INPUT


def _usage(error: Any) -> str:
    """Return what is wrong with the arguments, and where help is."""
    path = error.ctx.command_path if getattr(error, "ctx", None) is not None else "optloc"
    close = ", ".join(getattr(error, "possibilities", None) or ())
    if close:
        return f"{path}: {error.message.rstrip('.')}; did you mean {close}?"
    return f"{path}: {error.format_message().strip().rstrip('.')}; see {path} --help."


def example(*lines: str) -> str:
    """Return an epilogue of examples for a help text."""
    return "[bold]Examples[/bold]\n\n" + "\n\n".join(f"[cyan]{line}[/cyan]" for line in lines)


def told(wanted: bool) -> bool:
    """Let optloc's log go to standard error, with all its steps where that is wanted."""
    log = logging.getLogger("optloc")
    for old in [handler for handler in log.handlers if handler.name == "command line"]:
        log.removeHandler(old)
    handler = logging.StreamHandler(sys.stderr)
    handler.name = "command line"
    handler.setFormatter(logging.Formatter("%(relativeCreated)6.0f ms  %(message)s"))
    log.addHandler(handler)
    log.setLevel(logging.INFO if wanted else logging.WARNING)
    return wanted
