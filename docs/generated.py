"""Parts of pages that come from the code or from measured tables: filled in while the documentation is built."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

DOCS = Path(__file__).parent
PLACE = re.compile(r"^<!-- generated: (\w+)(?: (.+?))? -->$", re.MULTILINE)


def filled(text: str) -> str:
    """Return a page with the generated text after each ``<!-- generated: NAME ARGUMENTS -->``."""
    return PLACE.sub(lambda found: GENERATED[found[1]](*(found[2] or "").split(maxsplit=1)), text)


def rows(file: str, pattern: str = "") -> str:
    """Return the lines of a measured table whose first cell matches a pattern, with the date and the conditions."""
    lines = (DOCS / "measured" / f"{file}.md").read_text(encoding="utf-8").splitlines()
    about = next(line for line in lines if line.startswith("optloc "))
    table = [line for line in lines if line.startswith("|")]
    chosen = [line for line in table[2:] if re.search(pattern, line)]
    if not chosen:
        raise ValueError(f"no row of measured/{file}.md matches {pattern!r}")
    return "\n".join([*table[:2], *chosen, "", f"*{about}*"])


def formulation(name: str) -> str:
    """Return the entry of a formulation in the catalogue."""
    from optloc.solvers import FORMULATIONS

    parts = [key for key in FORMULATIONS if key.split(":")[0] == name]
    lines = []
    for key in parts:
        line, head = FORMULATIONS[key], f"`{key.partition(': ')[2]}` " if len(parts) > 1 else ""
        lines += [f"- {head}rows: {line.kinds}.", f"- {head}solution: {line.tight}.", f"- {head}time: {line.cost}."]
    return "\n".join(lines)


def costs() -> str:
    """Return the formulations as a table: rows, quality of the solution, time and words."""
    from optloc.solvers import FORMULATIONS

    head = ["| formulation | rows | solution | time | words of a method |", "|---|---|---|---|---|"]
    lines = []
    for name, line in FORMULATIONS.items():
        words = " ".join(f"`{word}`" for word in (*line.starts, *line.words)) or "for studies only"
        lines.append(f"| [{name}]({name.split(':')[0]}.md) | {line.kinds} | {line.tight} | {line.cost} | {words} |")
    return "\n".join([*head, *lines])


def posed() -> str:
    """Return the formulations as a table: the library of their posed problem, or the twin of a closed form."""
    from optloc.solvers import FORMULATIONS

    libraries = {"ConicStatement": "cvxpy", "ScaledProblem": "CasADi"}
    head = ["| formulation | rows | posed in | solution | time |", "|---|---|---|---|---|"]
    lines = []
    for name, line in FORMULATIONS.items():
        twin = f"closed form: pose `{line.twin}`" if line.twin else "not posed"
        library = twin if line.pose is None else libraries[line.pose.__annotations__["return"]]
        page = f"theory/{name.split(':')[0]}.md"
        lines.append(f"| [{name}]({page}) | {line.kinds} | {library} | {line.tight} | {line.cost} |")
    return "\n".join([*head, *lines])


def conic_solvers() -> str:
    """Return the solvers of convex problems as a table: problems, method, and whether they use a start."""
    from formulations.conic_solvers import SOLVERS

    head = ["| solver | solves | method | uses a start |", "|---|---|---|---|"]
    lines = [
        f"| `{name}` | {one.solves()} | {one.summary.removesuffix(', takes a start')} | "
        f"{'yes' if one.takes_start else 'no'} |"
        for name, one in SOLVERS.items()
    ]
    return "\n".join([*head, *lines])


def budgets() -> str:
    """Return the limits of a file as a table."""
    from dataclasses import asdict

    from optloc.files import Budget

    what = {
        "bytes": "bytes of a table: as stored, and the unpacked size that Parquet declares",
        "text": "bytes of a document: TOML, JSON, GeoJSON",
        "rows": "rows of a table",
        "columns": "columns of a table",
        "cells": "cells of a table; positions of moving stations, one for each epoch",
        "nesting": "nested tables and lists in a document",
        "unknowns": "shared unknowns of all epochs of a problem",
    }
    lines = [f"| `{name}` | {what[name]} | {most} |" for name, most in asdict(Budget()).items()]
    return "\n".join(["| name | what | at most |", "|---|---|---|", *lines])


def words() -> str:
    """Return the words of methods as a table."""
    from optloc.solvers import SOLVERS

    lines = [f"| `{name}` | {entry.role} | {entry.summary} |" for name, entry in SOLVERS.items()]
    return "\n".join(["| word | role | what the stage does |", "|---|---|---|", *lines])


def formats() -> str:
    """Return the formats as a table: the uncertainty in each, and its content for a fix that is not ok."""
    from optloc.show.formats import FORMATS

    head = [
        "| ending | for | uncertainty of a fix that is ok | a fix that is not ok | stream |",
        "|---|---|---|---|---|",
    ]
    lines = []
    for name, one in FORMATS.items():
        endings, stream = " ".join(f"`{each}`" for each in one.endings), f"`--format {name}`" if one.each else ""
        lines.append(f"| {endings} | {one.summary} | {one.uncertainty} | {one.doubt} | {stream} |")
    return "\n".join([*head, *lines])


def kinds() -> str:
    """Return the measurement kinds as a table."""
    from optloc.base.units import UNITS
    from optloc.models import MODELS

    head = ["| kind | stations | dimensions | what is measured | units of a file |", "|---|---|---|---|---|"]
    lines = []
    for name, model in MODELS.items():
        where = " ".join(str(d) for d in model.dimensions)
        units = " ".join(f"`{unit}`" for unit in UNITS[model.quantity])  # type: ignore[index]  # known quantities only
        lines.append(f"| `{name}` | {model.stations} | {where} | {model.summary} | {units} |")
    return "\n".join([*head, *lines])


def constraints() -> str:
    """Return the kinds of constraints of problem files as a table: meaning, keys, and an example of the option."""
    from optloc.files.constraint_kinds import CONSTRAINT_KINDS

    head = ["| `kind` | the target is | keys | more keys | as `--constraint` |", "|---|---|---|---|---|"]
    lines = []
    for name, kind in CONSTRAINT_KINDS.items():
        needed = "; ".join(re.sub(r"\w+", r"`\g<0>`", choice).replace("/", "or") for choice in kind.needs)
        more = " ".join(f"`{key}`" for key in kind.optional if key != "unit")
        lines.append(f"| `{name}` | {kind.summary} | {needed} | {more} | `{kind.example}` |")
    return "\n".join([*head, *lines])


def columns() -> str:
    """Return the roles of columns in tables of other programs: names, allowed units and content."""
    from optloc.files.columns import roles

    lines = []
    for name, role in roles().items():
        names = " ".join(f"`{word}`" for word in role.names)
        if role.with_unit:
            names += f"{'; ' if names else ''}with a unit: " + " ".join(f"`{word}`" for word in role.with_unit)
        units = " ".join(f"`{unit}`" for unit in role.units) if name != "sigma" else "units of the measurements"
        lines.append(f"| `{name}` | {names} | {units or '-'} | {role.text} |")
    return "\n".join(["| role | names | units | content |", "|---|---|---|---|", *lines])


def layers() -> str:
    """Return the layers as a drawing: every folder in its layer, with the first line of its docstring."""
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
    floors[0].append("formulations")  # next to the lowest layer
    for floor, rooms in enumerate(floors):
        y, wide = total - (floor + 1) * (height + gap), (width - gap * (len(rooms) + 1)) / len(rooms)
        for i, room in enumerate(rooms):
            x, about = gap + i * (wide + gap), _about(room)
            parts.append(
                f'<g><title>{escape(about)}</title><rect x="{x:.1f}" y="{y}" width="{wide:.1f}" height="{height}" '
                f'rx="4" fill="none" stroke="currentColor"/><text x="{x + 8:.1f}" y="{y + 19}" font-weight="bold" '
                f'fill="currentColor">{room}</text><text x="{x + 8:.1f}" y="{y + 37}" font-size="11" '
                f'fill="currentColor">{escape(_short(about, int(wide / 6.2)))}</text></g>'
            )
    return "\n".join([*parts, "</svg>"])


def _about(room: str) -> str:
    """Return the first line of a package's docstring."""
    place = DOCS.parent / ("formulations" if room == "formulations" else f"optloc/{room}") / "__init__.py"
    text = ast.get_docstring(ast.parse(place.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0].replace("`", "")


def _short(text: str, most: int) -> str:
    """Return the first words of a text, at most a number of letters."""
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


# Effects on the Doppler rows of a pass, and their models in optloc: sizes from a typical pass.

# m/s; rad/s; m3/s2 (WGS 84); Hz, the L band of Iridium; TECU and metres at the zenith: a day at middle latitudes.
_C, _TURN, _GM, _CARRIER, _TECU, _AIR = 299792458.0, 7.2921151467e-5, 3.986004418e14, 1.6e9, 30.0, 2.4


class Pass:
    """Four minutes of a satellite 780 km high that rises to 45 degrees above an emitter, as a two-body orbit."""

    def __init__(self) -> None:
        from optloc.base.frames import ECEF

        self.times = np.arange(-120.0, 121.0, 5.0)
        self.emitter = ECEF.from_geodetic(np.radians(47.8), np.radians(11.2), 600.0)
        below = ECEF.from_geodetic(np.radians(47.8), np.radians(20.0), 0.0)
        self.axes = ECEF.enu_axes(self.emitter)
        self.radius = 6378e3 + 780e3
        self.up, self.ahead = below / np.linalg.norm(below), ECEF.enu_axes(below)[1]
        self.speed = float(np.sqrt(_GM / self.radius))

    def satellite(self, times: Any) -> Any:
        """Return the position of the satellite in inertial axes, equal to the axes of the Earth at time zero."""
        angle = np.asarray(times)[..., None] * self.speed / self.radius
        return self.radius * (np.cos(angle) * self.up + np.sin(angle) * self.ahead)

    def ground(self, times: Any) -> Any:
        """Return the position of the emitter in the inertial axes."""
        return turned(np.broadcast_to(self.emitter, (*np.shape(times), 3)), _TURN * np.asarray(times))

    def range(self, times: Any, shift: float = 0.0) -> Any:
        """Return the range as optloc computes it: at one instant, with the satellite `shift` seconds ahead."""
        place = turned(self.satellite(times + shift), -_TURN * (times + shift))
        return np.linalg.norm(place - self.emitter, axis=-1)

    def light(self, times: Any, *, up: bool) -> Any:
        """Return the path length of light that arrives at the given times, up to the satellite or down."""
        way = np.zeros_like(times)
        for _ in range(5):  # each step is 1e5 times closer
            then = times - way / _C
            ends = (self.satellite(times), self.ground(then)) if up else (self.satellite(then), self.ground(times))
            way = np.linalg.norm(ends[0] - ends[1], axis=-1)
        return way

    def sine(self, times: Any) -> Any:
        """Return the sine of the satellite's elevation."""
        line = self.satellite(times) - self.ground(times)
        return np.einsum("ni,ni->n", line, turned(np.broadcast_to(self.axes[2], line.shape), _TURN * times)) / (
            np.linalg.norm(line, axis=-1)
        )

    def rate(self, excess: Callable[[Any], Any]) -> Any:
        """Return the rate of an excess path."""
        return (excess(self.times + 0.5) - excess(self.times - 0.5)) / 1.0

    def moves(self, rate: Any, *, known: bool) -> float:
        """Return the shift of a fix at known height by an error of the rates, metres; frequency known or not."""

        def model(place: Any) -> Any:
            away = turned(self.satellite(self.times), -_TURN * self.times)
            step = turned(self.satellite(self.times + 0.5), -_TURN * (self.times + 0.5))
            back = turned(self.satellite(self.times - 0.5), -_TURN * (self.times - 0.5))
            line = away - place
            return np.einsum("ni,ni->n", line, step - back) / np.linalg.norm(line, axis=-1)

        slopes = [(model(self.emitter + 50.0 * axis) - model(self.emitter - 50.0 * axis)) / 100.0 for axis in self.axes]
        design = np.column_stack([*slopes[:2], *([] if known else [np.ones(len(self.times))])])
        return float(np.linalg.norm(np.linalg.lstsq(design, rate)[0][:2]))


def turned(place: Any, angle: Any) -> Any:
    """Return places (n, 3) turned about the third axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * place[..., 0] - s * place[..., 1], s * place[..., 0] + c * place[..., 1], place[..., 2]], -1)


def effects() -> dict[str, tuple[str, Any, Any]]:
    """Return the effects on the rows of a pass: treatment in optloc, error of the range and of its rate (n,)."""
    scene = Pass()
    t, speed = scene.times, scene.speed
    late = float(scene.range(np.zeros(1))[0] / _C)
    thin = 40.3e16 * _TECU / _CARRIER**2

    def rotated(angle: float, axis: int) -> Callable[[Any], Any]:
        def excess(times: Any) -> Any:
            place = turned(scene.satellite(times), -_TURN * times)
            around = np.roll(turned(np.roll(place, 2 - axis, axis=-1), angle), axis - 2, axis=-1)
            return np.linalg.norm(around - scene.emitter, axis=-1) - np.linalg.norm(place - scene.emitter, axis=-1)

        return excess

    def layer(times: Any) -> Any:
        across = np.sqrt(1.0 - scene.sine(times) ** 2)
        return -thin / np.sqrt(1.0 - (6371.0 / (6371.0 + 350.0) * across) ** 2)

    table: dict[str, tuple[str, Callable[[Any], Any]]] = {
        "light time, from the ground up (Sagnac)": ("not modelled", lambda t: scene.light(t, up=True) - scene.range(t)),
        "light time, from the satellite down": ("not modelled", lambda t: scene.light(t, up=False) - scene.range(t)),
        "the same, with times earlier by the light time at mid-pass": (
            "remaining error",
            lambda t: scene.light(t, up=False) - scene.range(t, -late),
        ),
        "UT1 - UTC of 0.1 s": ("modelled (skyfield)", rotated(0.1 * _TURN, 2)),
        "polar motion of 0.3 seconds of arc": ("not modelled", rotated(float(np.radians(0.3 / 3600.0)), 0)),
        "position of the satellite along its track, 1 km": (
            "a bias of the form `time`, or not modelled",
            lambda t: scene.range(t, 1e3 / speed) - scene.range(t),
        ),
        "ionosphere, 30 TECU": ("not modelled", layer),
        "troposphere, 2.4 m at the zenith": ("not modelled", lambda t: _AIR / scene.sine(t)),
    }
    found = {name: (what, excess(t), scene.rate(excess)) for name, (what, excess) in table.items()}
    place = turned(scene.satellite(t), -_TURN * t)
    line = place - scene.emitter
    carried = _TURN * np.einsum("ni,ni->n", line, np.stack([-place[:, 1], place[:, 0], 0.0 * t], -1))
    turn = (
        "modelled: velocities in ECEF contain it",
        np.full(len(t), np.nan),
        carried / np.linalg.norm(line, axis=-1),
    )
    # Speed slows the clock of the satellite, and height speeds it up.
    clock = (speed**2 / 2.0 + _GM / scene.radius - _GM / np.linalg.norm(scene.emitter)) / _C
    constant = ("absorbed by the unknown frequency", np.full(len(t), np.nan), np.full(len(t), clock))
    return {"Earth's rotation in the velocities": turn} | found | {"v²/2c² and gravity (clocks)": constant}


def doppler() -> str:
    """Return the effects as a table: their sizes, and the shift of a fix."""
    scene, head = (
        Pass(),
        "| effect | range, m | rate, m/s | at 1.6 GHz, Hz | shift of the fix, m | frequency known, m | in optloc |",
    )
    lines = [head, "|---|---|---|---|---|---|---|"]
    for name, (what, length, rate) in effects().items():
        most = float(np.abs(rate).max())
        reach = "" if np.isnan(length).all() else _brief(float(np.abs(length).max()))
        found = (most, _CARRIER / _C * most, scene.moves(rate, known=False), scene.moves(rate, known=True))
        lines.append(f"| {name} | {reach} | {' | '.join(map(_brief, found))} | {what} |")
    return "\n".join(lines)


def _brief(size: float) -> str:
    """Return two digits of a size; less than a tenth of a millimetre is zero."""
    return "0" if size < 1e-4 else f"{float(f'{size:.2g}'):g}"


GENERATED: dict[str, Callable[..., str]] = {
    "rows": rows,
    "formulation": formulation,
    "costs": costs,
    "posed": posed,
    "conic_solvers": conic_solvers,
    "formats": formats,
    "kinds": kinds,
    "constraints": constraints,
    "columns": columns,
    "words": words,
    "commands": commands,
    "layers": layers,
    "budgets": budgets,
    "doppler": doppler,
}
