"""Alarms: parts of a stream that do not work, and the delays after which they are tried again or given up."""

from __future__ import annotations

from typing import NamedTuple

from optloc.problem import InvalidProblem

FIRST_DELAY, LONGEST_DELAY = 1.0, 60.0
"""Seconds before the first new attempt, and the limit to which they double: a part works again within a minute."""

PATIENCE = 5.0
"""Seconds for which the end of a stream waits for a thread that cannot be interrupted, as in a write to a full pipe."""


class Alarm(NamedTuple):
    """A part of a stream that does not work: its error, and the time since which it fails, by the stream's clock, s."""

    error: str
    since: float


class SourceLost(Exception):  # noqa: N818  # an event of the network, not a mistake
    """The connection of a source is lost, so the source must be opened again."""


def sentence(error: BaseException) -> str:
    """Return the text of an error in one line, with the type of errors that are not of the input or the network."""
    text = " ".join(str(error).split()) or "no reason is given"
    return text if isinstance(error, InvalidProblem | SourceLost) else f"{type(error).__name__}: {text}"
