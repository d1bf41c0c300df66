"""Generated tables: rows are collected while cases run and written when a full run has all of them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from hashlib import blake2b
from pathlib import Path

import optloc
from optloc import __version__

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "measured"
# The page includes what follows this line; the lines above keep Sphinx from missing the file in a table of contents.
START = "<!-- table -->"


@cache
def code_digest(*more: Path) -> str:
    """Return what tells this state of the package, and of more files, from others."""
    files = sorted([*Path(optloc.__file__).parent.rglob("*.py"), *more])
    return blake2b(b"".join(path.read_bytes() for path in files), digest_size=12).hexdigest()


@dataclass
class Ledger:
    """Rows of one table by the name of their case, kept on disk as they are made where it has a file."""

    header: Sequence[str]
    rows: dict[str, Sequence[str]] = field(default_factory=dict)
    file: Path | None = None

    def add(self, name: str, *cells: object) -> None:
        self.rows[name] = [str(cell) for cell in cells]
        if self.file is not None:
            # others may make other rows of the table meanwhile
            rows = (json.loads(self.file.read_text()) if self.file.exists() else {}) | {name: self.rows[name]}
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self.file.write_text(json.dumps(rows))
            self.rows |= rows


@contextmanager
def ledger(
    file: str, header: Sequence[str], names: Sequence[str], facts: str, *, kept: Path | None = None
) -> Iterator[Ledger]:
    """Yield a ledger; write it to docs/measured/`file`.md if every name has a row in the end.

    With a folder where rows are kept, a run that was stopped goes on: the ledger has those of the same code.
    """
    place = None if kept is None else kept / f"{file}-{code_digest()}.json"
    rows = json.loads(place.read_text()) if place is not None and place.exists() else {}
    book = Ledger(header, rows, place)
    yield book
    if all(name in book.rows for name in names):
        write(file, header, [[name, *book.rows[name]] for name in names], facts)


def write(file: str, header: Sequence[str], rows: Sequence[Sequence[str]], facts: str) -> Path:
    """Write a markdown table with what is needed to make it again."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    made = f"optloc {__version__}, {datetime.now(UTC):%Y-%m-%d}, {facts}."
    FOLDER.mkdir(exist_ok=True)
    path = FOLDER / f"{file}.md"
    path.write_text(f"---\norphan: true\n---\n\n{START}\n\n{made}\n\n{table}\n", encoding="utf-8")
    return path


def repeat(file: Path, page: Path) -> None:
    """Put the table of a file in the place of the one with the same header in a page."""
    rows = [line for line in file.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    before, _, rest = page.read_text(encoding="utf-8").partition(rows[0])
    _, blank, after = rest.partition("\n\n")
    assert blank, f"{page} has no table that begins with {rows[0]}"
    page.write_text(before + "\n".join(rows) + blank + after, encoding="utf-8")
