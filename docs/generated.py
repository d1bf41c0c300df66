"""What pages say that only the code or the measured tables know: filled in while the documentation is built."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
PLACE = re.compile(r"^<!-- generated: (\w+)(?: (.+?))? -->$", re.MULTILINE)


def filled(text: str) -> str:
    """Return a page with every ``<!-- generated: NAME ARGUMENTS -->`` followed by what it stands for."""
    return PLACE.sub(lambda found: GENERATED[found[1]](*(found[2] or "").split(maxsplit=1)), text)


def rows(file: str, pattern: str = "") -> str:
    """Return the lines of a measured table whose first cell matches a pattern, and what was measured when."""
    lines = (DOCS / "measured" / f"{file}.md").read_text(encoding="utf-8").splitlines()
    about = next(line for line in lines if line.startswith("optloc "))
    table = [line for line in lines if line.startswith("|")]
    chosen = [line for line in table[2:] if re.search(pattern, line)]
    if not chosen:
        raise ValueError(f"no row of measured/{file}.md matches {pattern!r}")
    return "\n".join([*table[:2], *chosen, "", f"*{about}*"])


def formulation(name: str) -> str:
    """Return what the catalogue says of a formulation."""
    from optloc.solvers import FORMULATIONS

    parts = [key for key in FORMULATIONS if key.split(":")[0] == name]
    lines = []
    for key in parts:
        line, head = FORMULATIONS[key], f"`{key.partition(': ')[2]}` " if len(parts) > 1 else ""
        lines += [f"- {head}serves {line.kinds}.", f"- {head}answer: {line.tight}.", f"- {head}time: {line.cost}."]
    return "\n".join(lines)


def costs() -> str:
    """Return the formulations as a table: what each serves, how good its answer is, what it takes, its words."""
    from optloc.solvers import FORMULATIONS

    head = ["| formulation | rows | its answer | time | words of a method |", "|---|---|---|---|---|"]
    lines = []
    for name, line in FORMULATIONS.items():
        words = " ".join(f"`{word}`" for word in (*line.starts, *line.words)) or "for studies only"
        lines.append(f"| [{name}]({name.split(':')[0]}.md) | {line.kinds} | {line.tight} | {line.cost} | {words} |")
    return "\n".join([*head, *lines])


def budgets() -> str:
    """Return how much a file may hold as a table."""
    from dataclasses import asdict

    from optloc import Budget

    what = {
        "bytes": "bytes of a table: as it is stored, and as Parquet declares itself unpacked",
        "text": "bytes of a document: TOML, JSON, GeoJSON",
        "rows": "rows of a table",
        "columns": "columns of a table",
        "cells": "cells of a table; places of moving stations, one for each epoch",
        "nesting": "tables and lists within each other in a document",
        "unknowns": "unknowns of a problem that its epochs share",
    }
    lines = [f"| `{name}` | {what[name]} | {most} |" for name, most in asdict(Budget()).items()]
    return "\n".join(["| name | what | at most |", "|---|---|---|", *lines])


def words() -> str:
    """Return the words that a method is made of as a table."""
    from optloc import SOLVERS

    lines = [f"| `{name}` | {entry.role} | {entry.summary} |" for name, entry in SOLVERS.items()]
    return "\n".join(["| word | role | what the stage does |", "|---|---|---|", *lines])


def kinds() -> str:
    """Return the measurement kinds as a table."""
    from optloc import MODELS
    from optloc.base.units import UNITS

    head = ["| kind | stations | dimensions | what is measured | units of a file |", "|---|---|---|---|---|"]
    lines = []
    for name, model in MODELS.items():
        where = " ".join(str(d) for d in model.dimensions)
        units = " ".join(f"`{unit}`" for unit in UNITS[model.quantity])  # type: ignore[index]  # known quantities only
        lines.append(f"| `{name}` | {model.stations} | {where} | {model.summary} | {units} |")
    return "\n".join([*head, *lines])


def layers() -> str:
    """Return the layers of the house as a drawing: every folder on its floor, with what its docstring says."""
    source = ast.parse((DOCS.parent / "tests" / "test_layers.py").read_text(encoding="utf-8"))
    assigned = {ast.unparse(node.targets[0]): node.value for node in source.body if isinstance(node, ast.Assign)}
    floors = [
        [room for room in rooms.split() if (DOCS.parent / "optloc" / room).is_dir()]
        for rooms in ast.literal_eval(assigned["LAYERS"])
    ]
    floors = [rooms for rooms in floors if rooms]
    width, height, gap = 760, 46, 6
    total = len(floors) * (height + gap) + gap
    parts = [f'<svg viewBox="0 0 {width} {total}" role="img" aria-label="The layers of optloc" class="layers">']
    floors[0].append("formulations")  # beside the lowest floor
    for floor, rooms in enumerate(floors):
        y, wide = total - (floor + 1) * (height + gap), (width - gap * (len(rooms) + 1)) / len(rooms)
        for i, room in enumerate(rooms):
            x, about = gap + i * (wide + gap), _about(room)
            parts.append(
                f'<g><title>{escape(about)}</title><rect x="{x:.1f}" y="{y}" width="{wide:.1f}" height="{height}" '
                f'rx="4" fill="none" stroke="currentColor"/><text x="{x + 8:.1f}" y="{y + 19}" font-weight="bold" '
                f'fill="currentColor">{room}</text><text x="{x + 8:.1f}" y="{y + 37}" font-size="11" '
                f'fill="currentColor">{escape(_short(about, int(wide / 5.6)))}</text></g>'
            )
    return "\n".join([*parts, "</svg>"])


def _about(room: str) -> str:
    """Return the first line of a package's docstring."""
    place = DOCS.parent / ("formulations" if room == "formulations" else f"optloc/{room}") / "__init__.py"
    text = ast.get_docstring(ast.parse(place.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0].replace("`", "")


def _short(text: str, most: int) -> str:
    """Return as many whole words as fit into so many letters."""
    if len(text) <= most:
        return text
    return text[: most - 1].rsplit(" ", 1)[0].rstrip(",;:.") + " …"


def commands() -> str:
    """Return every command with its help, arguments, options and examples."""
    from typer.main import get_command

    from optloc.cli import app

    return "\n\n".join(_help(words, command) for words, command in _walk("optloc", get_command(app)))


def _walk(words: str, command: Any) -> Iterator[tuple[str, Any]]:
    for name, inner in getattr(command, "commands", {}).items():
        if not inner.hidden:
            yield from _walk(f"{words} {name}", inner)
    if not hasattr(command, "commands"):
        yield words, command


def _help(words: str, command: Any) -> str:
    lines = [f"## `{words}`", "", _marked(_plain(command.help or ""))]
    shown = [parameter for parameter in command.params if parameter.name != "help"]
    if shown:
        lines += ["", "| argument or option | |", "|---|---|", *(_option(parameter) for parameter in shown)]
    if command.epilog:
        examples = [line.strip() for line in _plain(command.epilog).splitlines()]
        lines += ["", "```sh", *(line for line in examples if line.startswith("optloc")), "```"]
    return "\n".join(lines)


def _option(parameter: Any) -> str:
    value = "" if getattr(parameter, "is_flag", False) else (parameter.metavar or parameter.name.upper())
    if parameter.param_type_name == "argument":
        names = f"`{value}`"
    else:
        names = ", ".join(f"`{name} {value}`" if value else f"`{name}`" for name in parameter.opts)
    default = parameter.default
    known = default is not None and default is not False and not callable(default) and default != ()
    text = _marked(_plain(getattr(parameter, "help", "") or ""))
    names, text = names.replace("|", "\\|"), text.replace("|", "\\|")
    return f"| {names} | {text}{f' Default: `{default}`.' if known and not parameter.required else ''} |"


def _plain(text: str) -> str:
    """Return text without rich's marks."""
    return re.sub(r"\[/?(?:bold|cyan|dim|italic)\]", "", text).replace("\f", "").strip()


def _marked(text: str) -> str:
    """Return text with its options as code: two dashes would become one."""
    return re.sub(r"(?<![`\w-])(--[a-z][a-z-]*)", r"`\1`", text)


GENERATED: dict[str, Callable[..., str]] = {
    "rows": rows,
    "formulation": formulation,
    "costs": costs,
    "kinds": kinds,
    "words": words,
    "commands": commands,
    "layers": layers,
    "budgets": budgets,
}
