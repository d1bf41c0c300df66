"""Completion of option values by the Tab key: names of tables, choices of an option, and lists of either."""

from __future__ import annotations

from collections.abc import Callable, Iterable

Completion = Callable[[str], list[str]]
"""Function from the typed text to values; the shell offers those that begin with this text."""


def complete(what: str) -> Completion:
    """Return a completion with the names in the table `what` of `optloc list`."""

    def found(incomplete: str) -> list[str]:
        """Return all names of the table."""
        return _names_in(what)

    return found


def choices(metavar: str) -> Completion:
    """Return a completion with the choices that a metavar such as "rms|volume|axis" names."""
    values = metavar.split("|")

    def found(incomplete: str) -> list[str]:
        """Return all choices."""
        return values

    return found


def stages(incomplete: str) -> list[str]:
    """Return the methods, and the stages after those typed, such as "gtrs+lsr" for "gtrs+l"."""
    from optloc.solvers.methods import SOLVERS

    return [*([] if "+" in incomplete else _names_in("methods")), *_continued(incomplete, "+", SOLVERS)]


def statuses(incomplete: str) -> list[str]:
    """Return the statuses after those typed, such as "curved,unproven" for "curved,un"."""
    from optloc.base.types import Status

    # A hyphen replaces each space: a shell would end the value at the space.
    return _continued(incomplete, ",", [status.label.replace(" ", "-") for status in Status])


def _names_in(what: str) -> list[str]:
    """Return the names in the table `what` of `optloc list`."""
    # Each Tab starts a process, so imports wait until a list is needed.
    from optloc.cli.listing import lists

    return [next(iter(row.values())) for row in lists()[what]()]


def _continued(incomplete: str, separator: str, names: Iterable[str]) -> list[str]:
    """Return the typed list with each name as its last part; names in the list are not offered again."""
    before, joint, _ = incomplete.rpartition(separator)
    return [before + joint + name for name in names if name not in before.split(separator)]
