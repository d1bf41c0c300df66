"""Sentences on the screen of a command, by their layout, and a test whether a sentence names a next step.

The layout of the output is fixed: tables have frames, the report of a table has lines "  keyword  text", and advice has
two lines for each observation, indented by two blanks, and lines to copy, indented by six.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

LONGEST = 200
"""Largest number of characters of a sentence."""

# Frames of tables, and lines on progress, which begin with a time.
_FRAMES = "┌├└┏┡╇┃┗╞╘"
_PROGRESS = re.compile(r"^ *\d+ ms +\S")
# Titles and lines of results, which report numbers.
_RESULTS = re.compile(
    r"^(?:\S+ is understood as|The position is .*|Wave speed: .*|[\w ]+: \d+ (?:fixes|scans) *|Alternatives"
    r"|Stations, m|Suspects|status .*, proof .*|cost .*, \d+ degrees of freedom, .*|Health by .*|\S+"
    r"|.* fits equally well\.|.* raises chi-square by \S+"
    r"|Noise from data.*)$"
)
# Forms of a next step: an option, a command, a key or call to write, a file, and an order at the start of a clause.
_NAMED = re.compile(r"--\w|\boptloc \w+|`[^`]+`|\b\w+ ?= ?[\"'\w\[{]|\[\[\w+\]\]|did you mean|known are")
_VERBS = (
    "add allow average change check choose compare complete convert copy correct distinguish draw empty fill find fix "
    "give increase install keep leave make measure merge model name put remove rename repeat replace run see set state "
    "subtract swap take test treat try turn use write"
).split()
_ORDER = re.compile(rf"(?:^|[;:,(.] |\bor |\band |\bthen |\buntil then, )(?:{'|'.join(_VERBS)})\b", re.IGNORECASE)


@dataclass(frozen=True)
class Message:
    """A message: its sentences, and whether it must name a next step."""

    sentences: tuple[str, ...]
    stepped: bool = True

    @property
    def steps(self) -> bool:
        """Return whether a sentence names a next step."""
        return any(names_step(text) for text in self.sentences)


def names_step(text: str) -> bool:
    """Return whether a sentence names a next step."""
    return bool(_NAMED.search(text) or _ORDER.search(text))


def _untitled(lines: list[str]) -> list[str]:
    """Return the lines without titles of tables: the lines before a frame, back to a blank line or a sentence."""
    kept: list[str] = []
    title = False
    for line in reversed(lines):
        title = title and bool(line.strip()) and not line.rstrip().endswith((".", "?")) and line[0] not in " │└"
        if not title:
            kept.append(line)
        title = title or line[:1] in ("┌", "┏")
    return kept[::-1]


def messages(output: str) -> list[Message]:
    """Return the messages of an output: errors, warnings, notes, advice, statuses, and lines of a report."""
    found, pending, advice = [], "", False
    for line in _untitled(output.splitlines()):
        text = line.strip()
        if not text or line[0] in _FRAMES or _PROGRESS.match(line):
            continue
        if line[0] == "│":
            cells = [cell.strip() for cell in line.strip("│").split("│")]
            # Only sentences: the cell below the status, and the reason. Other cells have numbers.
            if len(cells) == 2 and cells[0] in ("", "reason") and cells[1].endswith("."):
                found.append(Message((cells[1],)))
        elif text == "Advice":
            advice = True
        elif advice and line.startswith("      "):
            continue  # lines to copy
        elif advice and line.startswith("  "):
            found += [Message((pending, text))] if pending else []
            pending = "" if pending else text
        elif line.startswith("  ") or _RESULTS.match(text):
            found.append(Message((text,), stepped=False))
        else:
            found.append(Message((text,)))
    return found


def flaws(output: str) -> list[str]:
    """Return the flaws of the messages of an output: sentences that are too long, and messages without a next step."""
    found = []
    for message in messages(output):
        found += [f"{len(text)} characters: {text}" for text in message.sentences if len(text) > LONGEST]
        if message.stepped and not message.steps:
            found.append(f"no next step: {' | '.join(message.sentences)}")
    return found
