"""Code blocks of a page of the documentation: run in order, and their output compared with what the page shows.

A comment in front of a block says what is not obvious from it:

    <!-- file: site.toml -->       the block is the content of that file
    <!-- not run: REASON -->       the block cannot run in a test
    <!-- exit code: 1 -->          the commands of the block end so
    <!-- needs: OPTLOC_DATA -->    the block runs where the variable is set; the output shown was stored

A ``text`` block right after a ``python`` block is its output. In a ``console`` block, lines with ``$`` are commands and
the others their output. ``...`` stands for anything.
"""

import contextlib
import doctest
import io
import os
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from typer.testing import CliRunner

from optloc.cli import app

DOCS = Path(__file__).resolve().parents[1] / "docs"
FENCE = re.compile(r"^(?:<!-- (?P<mark>[^>]*) -->\n)?```(?P<kind>\w+)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)
MARKS = ("file: ", "not run: ", "exit code: ", "needs: ", "run-command", "test-command")


@dataclass(frozen=True)
class Block:
    """A block of code: its language, text and first line, the mark before it, and the output that is shown of it."""

    kind: str
    text: str
    line: int
    mark: str
    shown: str | None
    span: tuple[int, int]


def blocks(page):
    """Return the blocks of a page; the output of a python block belongs to it."""
    text = page.read_text(encoding="utf-8")
    found = list(FENCE.finditer(text))
    kept = []
    for at, match in enumerate(found):
        mark, kind = match["mark"] or "", match["kind"]
        after = found[at + 1] if at + 1 < len(found) else None
        joined = after is not None and not text[match.end() : after.start()].strip()
        output = after if kind == "python" and joined and after["kind"] == "text" and not after["mark"] else None
        line = text.count("\n", 0, match.start("text")) + 1
        shown, span = (None, match.span("text")) if output is None else (output["text"], output.span("text"))
        kept.append(Block(kind, match["text"], line, mark, shown, span))
    return kept


def commands(block):
    """Return pairs of a command and the output that is shown of it, None where there is none."""
    lines = re.split(r"(?<!\\)\n", block.text)  # a backslash continues a command on the next line
    if not any(line.startswith("$ ") for line in lines):
        return [(line.split("  #")[0].strip(), None) for line in lines if line.strip() and not line.startswith("#")]
    pairs = []
    for line in lines:
        if line.startswith("$ "):
            pairs.append((line[2:], []))
        elif pairs:
            pairs[-1][1].append(line)
    return [(command, "\n".join(shown).strip("\n") or None) for command, shown in pairs]


def run_python(block, names, page):
    """Run a block in the names of its page and return what it prints."""
    printed = io.StringIO()
    code = compile("\n" * (block.line - 1) + block.text, str(page), "exec")
    with contextlib.redirect_stdout(printed):
        exec(code, names)
    return printed.getvalue()


def run_command(command):
    """Run a command line of optloc; return what it prints and its exit code."""
    words = shlex.split(command.replace("\\\n", " "))
    assert words[0] == "optloc", f"{command}: only optloc runs here; mark the block"
    result = CliRunner().invoke(app, words[1:])
    assert result.exception is None or isinstance(result.exception, SystemExit), (command, result.exception)
    return result.output, result.exit_code


def same(shown, printed):
    """Tell whether an output is the one that is shown, whatever the spaces; ``...`` stands for anything."""
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    return doctest.OutputChecker().check_output(_plain(shown), _plain(printed), flags)


def _plain(text):
    # A busy machine shows that it loads machine code. The lines of a table are as long as the terminal is wide.
    text = re.sub(r"(?m)^ *\d+ ms +(?:loading|making) machine code.*\n", "", text)
    return re.sub(r"[─━═]+", "─", re.sub(r"[ \t]+", " ", text)).strip() + "\n"


def run_page(page):
    """Run a page in the present folder; return the differences, and the page with the outputs that were printed."""
    names, wrong, text = {"__name__": "page"}, [], page.read_text(encoding="utf-8")
    fresh = []
    for block in blocks(page):
        name, _, rest = block.mark.partition(": ")
        if name == "file":
            Path(rest).write_text(block.text, encoding="utf-8")
        if name == "not run" or (name == "needs" and not os.environ.get(rest)):
            continue
        if block.kind == "python":
            printed = run_python(block, names, page)
            if block.shown is not None and not same(block.shown, printed):
                wrong.append(f"{page.name}:{block.line}: shown\n{block.shown}printed\n{printed}")
                fresh.append((block.span, printed))
        elif block.kind in ("console", "sh"):
            parts = []
            for command, shown in commands(block):
                printed, code = run_command(command)
                if code != int(rest if name == "exit code" else 0):
                    wrong.append(f"{page.name}:{block.line}: {command} ends with {code}: {printed}")
                if shown is not None and not same(shown, printed):
                    wrong.append(f"{page.name}:{block.line}: {command}: shown\n{shown}\nprinted\n{printed}")
                parts.append(f"$ {command}\n" + _trimmed(shown, printed))
            if any(shown is not None for _, shown in commands(block)):
                fresh.append((block.span, "".join(parts)))
    for (start, end), printed in reversed(fresh):
        text = text[:start] + printed.rstrip("\n") + "\n" + text[end:]
    return wrong, text


def _trimmed(shown, printed):
    if shown is None:
        return ""
    if same(shown, printed):
        return shown + "\n"
    return "\n".join(line.rstrip() for line in printed.strip().splitlines()) + "\n"
