"""The commands ``optloc demo`` and ``optloc new``: shipped example problems and starter problem files."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markdown import Markdown

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.types import Rows, Status
from optloc.base.units import SI_UNIT, UNITS
from optloc.cli.file_fixes import FileFixes, fix_file, fixes_json
from optloc.cli.fix import draw, show
from optloc.cli.options import shipped_problems
from optloc.cli.output import Screen, claim_outputs, dumps, say, write_text
from optloc.files.reader import read
from optloc.models import MODELS, Model

_FIX = """
# 1. A fix

Six receivers receive one pulse. The time of emission is unknown, so the data are five differences of arrival times,
each with an error of about 28 ns. optloc needs no first guess. The table contains the most likely position with its
standard deviation (±). The status is `ok`: you can use this position.

`chi-square` compares the residuals with the stated noise. A p near 0 means that the data do not fit the model.
"""
_AMBIGUOUS = """
# 2. Two possible places

Three receivers in the plane give two differences, and two positions fit them exactly. An iteration from a first guess
finds one of the two and does not report the other. The line `certificate` is the result of a proof. optloc divides the
whole plane into boxes and drops a box only if no position in it fits better. The proof finds both positions and
excludes a third. The status is `ambiguous`: the data cannot decide between the two. The second position is under
"Alternatives".
"""
_REGISTRATION = """
# 3. A registration

Four ships time an emitter on the coast, six times in ten minutes, each by its own clock. Three of the clocks have
unknown errors. A fix that ignores these errors is wrong by more than four kilometres. optloc estimates the errors
together with the position. The column `from data` is the share of an estimate that comes from the measurements, not
from assumptions.

The status is `ok`. The proof covers every position in the plane with every value of the clock errors.
"""
_END = """
# Next

- `optloc new tdoa --out site.toml` writes a problem file with comments. Replace its numbers by yours.
  `optloc list starters` lists the other files of this sort.
- `optloc check site.toml`, then `optloc fix site.toml --plot fix.png`.
- `optloc convert` reads tables of readings, pseudoranges and GeoJSON stations, long or wide.
- `optloc compile` compiles the machine code, once and in minutes. Batches and long runs need it, such as
  `optloc demo registration`: 800 differences of five aircraft.
"""
_SECTIONS = ((_FIX, "demo"), (_AMBIGUOUS, "ambiguous"), (_REGISTRATION, "clocks"))
PICTURE = Path("optloc-demo.png")
# Expected statuses of shipped problems other than `ok` alone. Plain Python does not finish the proof of the long run.
_EXPECTED_STATUS = {"ambiguous": (Status.AMBIGUOUS,), "registration": (Status.OK, Status.UNPROVEN)}


def titles() -> dict[str, str]:
    """Return the titles of the shipped problems by name."""
    import tomllib

    found = shipped_problems()
    return {name: tomllib.loads(path.read_text(encoding="utf-8"))["title"] for name, path in found.items()}


def run_demo(name: str | None, plot: Path | None, *, as_json: bool, quiet: bool) -> int:
    """Fix the shipped problem `name`, or three examples if `name` is None, and return the exit code.

    The exit code is 1 if a fix has another status than its problem should give. `plot` is the picture to write.
    """
    known = shipped_problems()
    if name is not None and name not in known:
        raise InvalidProblem(f"there is no demo {name!r}", "demo", nearest(name, list(known)))
    claim_outputs(picture=plot)
    if name is None and not as_json:
        return _run_examples(plot, quiet)
    found = _fix(name or "demo", quiet or as_json)
    if as_json:
        write_text(Path("-"), dumps(fixes_json(found)))
    elif not quiet:
        show(found, Screen())
    if plot is not None or not as_json:
        _draw(found, plot, quiet or as_json)
    return 0 if _has_expected_status(found, name or "demo") else 1


def _run_examples(plot: Path | None, quiet: bool) -> int:
    """Fix and explain three shipped problems; return exit code 0 if each has the status in its text.

    The first fix is drawn: in the file `plot`, or in the default file if `plot` is None.
    """
    console = Screen(quiet=quiet)
    code = 0
    for i, (text, name) in enumerate(_SECTIONS):
        _explain(text, console)
        found = _fix(name, quiet)
        show(found, console)
        if i == 0:
            _draw(found, plot, quiet)
        code = code if _has_expected_status(found, name) else 1
    _explain(_END, console)
    return code


def _has_expected_status(found: FileFixes, name: str) -> bool:
    """Return whether the fixes of a shipped problem have the expected status."""
    shown = _EXPECTED_STATUS.get(name, (Status.OK,))
    return bool(np.isin(found.fix.code, shown).all())


def _fix(name: str, quiet: bool) -> FileFixes:
    """Return the fixes of a shipped problem."""
    return fix_file(read(shipped_problems()[name]), "auto", quiet)


def _explain(text: str, console: Console) -> None:
    """Print a text in Markdown."""
    shown: Any = Markdown(text, hyperlinks=False)
    console.print(shown)
    console.print()


def _draw(found: FileFixes, plot: Path | None, quiet: bool) -> None:
    """Draw a fix. Without a requested picture, print a line and go on if drawing is impossible or a file exists."""
    from importlib.util import find_spec

    console = Screen(quiet=quiet)
    # Without a requested picture, a missing library is no error: the numbers are already printed.
    if plot is None and find_spec("matplotlib") is None:
        say(console, "No picture is drawn, because matplotlib is not installed: pip install 'optloc[plot]'.")
        return
    if plot is None:
        try:
            claim_outputs(picture=PICTURE)
        except InvalidProblem as refused:
            say(console, f"No new picture is written. {refused}")
            return
    draw(found, plot or PICTURE)
    say(console, f"The picture is in {plot or PICTURE}.")


# Starter problems: commented files that can be fixed as they are, one for each kind and for common mixtures.


@dataclass(frozen=True, slots=True)
class Starter:
    """A starter problem file.

    summary: one line. text: text of the file. commands: commands that accept the file.
    """

    summary: str
    text: str
    commands: tuple[str, ...] = ("check", "fix")


# Starters for other commands than `fix`.
_OTHERS = {"calibration": ("calibrate",)}


def starters() -> dict[str, Starter]:
    """Return the starters by name: the shipped starters, and one for each further kind."""
    folder = files("optloc") / "starters"
    found = {}
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if entry.name.endswith(".toml"):
            text = entry.read_text(encoding="utf-8")
            name, summary = entry.name.removesuffix(".toml"), text.partition("\n")[0].removeprefix("# ")
            found[name] = Starter(summary, text, *([_OTHERS[name]] if name in _OTHERS else []))
    # A kind of a plugin gets a starter as well. A kind that needs ECEF does not fit stations around an origin.
    for kind, model in MODELS.items():
        if kind not in found and not model.ecef:
            found[kind] = Starter(f"{kind}: {model.summary}.", _compose(kind, model))
    return found


def run_new(kind: str, out: Path | None, *, quiet: bool) -> int:
    """Write a starter to a file or to standard output, and return the exit code."""
    known = starters()
    if kind not in known:
        raise InvalidProblem(f"there is no starter {kind!r}", "new", nearest(kind, known))
    if out is None or str(out) == "-":
        write_text(Path("-"), known[kind].text.rstrip("\n"))
        return 0
    if out.suffix.lower() != ".toml":
        raise InvalidProblem("a problem file ends in .toml", str(out), "use this ending after --out")
    write_text(out, known[kind].text.rstrip("\n"))
    commands = ", then ".join(f"optloc {command} {out}" for command in known[kind].commands)
    say(Screen(quiet=quiet), f"{out} is written. Change its numbers, then run {commands}.")
    return 0


# Six stations about 4 km from the origin, two of them high, so that the height is observable. The target is inside and
# moves like a small aircraft. Each kind has the error of an ordinary receiver.
_PLACES = {
    "North": (200.0, 4100.0, 35.0),
    "East": (4300.0, 300.0, 80.0),
    "South": (-150.0, -3900.0, 20.0),
    "West": (-4000.0, -250.0, 310.0),
    "Hill": (1800.0, 2200.0, 640.0),
    "Tower": (-1900.0, 1500.0, 120.0),
}
_TRUTH, _SPEED, _RANGE_SIGMA = (1500.0, 900.0, 400.0), (60.0, -35.0, 5.0), 3.0
_SIGMA = {"length": 3.0, "angle": 0.005, "ratio": 0.01, "speed": 0.5}


def _compose(kind: str, model: Model) -> str:
    """Return the starter of a kind without a shipped starter: its rows and ranges, simulated at a known position."""
    from optloc.base.types import Motion
    from optloc.linear.simulate import simulate
    from optloc.problem.build import assemble, measured, station_array

    names, d = list(_PLACES), max(model.dimensions)
    # `one` has the stations of the rows: all stations, or all except the first station.
    one = np.arange(len(names)) if model.stations == 1 else np.arange(1, len(names))
    # Differences refer to the first station. The additional ranges make each kind solvable.
    a, b = (one if model.stations else None), (np.zeros_like(one) if model.stations == 2 else None)
    # Quantities of plugins without a typical error here get 0.1 of their unit.
    sigma = _SIGMA.get(model.quantity, 0.1)
    place = np.array(list(_PLACES.values()))[:, :d]
    rows = [measured(kind, a=a, b=b, sigma=sigma), measured("range", a=np.arange(len(names)), sigma=_RANGE_SIGMA)]
    motion = Motion(order=1) if model.velocity else Motion()
    problem = assemble(station_array(place, names), *rows, motions=(motion,))
    # The parameters are position and velocity; a target that does not move has no velocity. The seed is 1.
    drawn = simulate(problem, np.concatenate([_TRUTH[:d], _SPEED[:d]])[: problem.layout.size], 1)
    lines = [
        f"# {kind}: {model.summary}.",
        f"# truth: {', '.join(f'{v:g}' for v in _TRUTH[:d])}",
        "format = 2",
        f'title = "Rows of {kind} and ranges"',
        "",
        "[stations]",
        'unit = "m"',
        "rows = [",
    ]
    for name, point in zip(names, place.tolist(), strict=True):
        lines.append(f'  {{ name = "{name}", {", ".join(f"{c} = {v}" for c, v in zip("xyz", point, strict=False))} }},')
    lines += ["]", *(["", "[target]", 'motion = "constant_velocity"'] if model.velocity else [])]
    for block, noise in zip(drawn.rows, (sigma, _RANGE_SIGMA), strict=True):
        lines += _measurements(block, noise, names)
    return "\n".join(lines) + "\n"


def _measurements(block: Rows, sigma: float, names: list[str]) -> list[str]:
    """Return the lines of a measurement table in a problem file; `sigma` is in the SI unit of the kind."""
    model = MODELS[block.kind]
    known = ", ".join(UNITS[model.quantity])  # type: ignore[index]  # models hold known quantities only
    unit = SI_UNIT[model.quantity]  # type: ignore[index]  # as above
    lines = ["", "[[measurements]]", f'kind = "{block.kind}"', f'unit = "{unit}"{" " * 27}# one of {known}']
    lines += [f"sigma = {sigma}", "rows = ["]
    for i, z in enumerate(np.ravel(block.z).tolist()):
        ends = [f'{end} = "{names[index[i]]}"' for end, index in (("a", block.a), ("b", block.b))][: model.stations]
        lines.append("  { " + ", ".join([*ends, f"z = {z:.6g}"]) + " },")
    return [*lines, "]"]
