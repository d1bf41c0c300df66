"""Starter problems: commented files that can be fixed as they are, one for each kind and for common mixtures."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from optloc.errors import InvalidProblem, nearest
from optloc.models import MODELS, Model
from optloc.units import SI_UNIT, UNITS


@dataclass(frozen=True, slots=True)
class Starter:
    """One line on what it is, and the text of its file."""

    summary: str
    text: str


def starters() -> dict[str, Starter]:
    """Return the starters by name: the shipped ones, then those of kinds that have none."""
    folder = files("optloc") / "starters"
    found = {}
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if entry.name.endswith(".toml"):
            text = entry.read_text(encoding="utf-8")
            found[entry.name.removesuffix(".toml")] = Starter(text.partition("\n")[0].removeprefix("# "), text)
    for kind, model in MODELS.items():
        if kind not in found and not model.ecef:
            found[kind] = Starter(f"{kind}: {model.summary}.", _drawn(kind, model))
    return found


def run_new(kind: str, out: Path | None, *, force: bool, quiet: bool) -> int:
    """Write a starter, to standard output where no file is named, and return the exit code."""
    from optloc.cli.output import write_text

    known = starters()
    if kind not in known:
        raise InvalidProblem(f"there is no starter {kind!r}", "new", nearest(kind, known))
    if out is None or str(out) == "-":
        write_text(Path("-"), known[kind].text.rstrip("\n"))
        return 0
    if out.suffix.lower() != ".toml":
        raise InvalidProblem("a problem file ends in .toml", str(out), f"write --out {out.with_suffix('.toml')}")
    if out.exists() and not force:
        raise InvalidProblem("there is such a file already", str(out), "choose another name, or add --force")
    write_text(out, known[kind].text.rstrip("\n"))
    if not quiet:
        from rich.console import Console

        line = f"{out} can be changed and fixed: optloc check {out}, then optloc fix {out}."
        Console().print(line, highlight=False, markup=False, soft_wrap=True)
    return 0


_PLACES = {
    "North": (200.0, 4100.0, 35.0),
    "East": (4300.0, 300.0, 80.0),
    "South": (-150.0, -3900.0, 20.0),
    "West": (-4000.0, -250.0, 310.0),
    "Hill": (1800.0, 2200.0, 640.0),
    "Tower": (-1900.0, 1500.0, 120.0),
}
_TRUTH = (1500.0, 900.0, 400.0)
_SIGMA = {"length": 3.0, "angle": 0.005, "ratio": 0.01, "speed": 0.5}


def _drawn(kind: str, model: Model) -> str:
    """Return a starter of a kind that has none of its own: rows of it beside ranges, drawn at a known place."""
    from optloc.build import assemble, measured, station_array
    from optloc.simulate import simulate
    from optloc.types import Motion

    names, d = list(_PLACES), max(model.dimensions)
    one = np.arange(len(names)) if model.stations == 1 else np.arange(1, len(names))
    a, b = (one if model.stations else None), (np.zeros_like(one) if model.stations == 2 else None)
    sigma = _SIGMA.get(model.quantity, 0.1)
    place = np.array(list(_PLACES.values()))[:, :d]
    rows = [measured(kind, a=a, b=b, sigma=sigma), measured("range", a=np.arange(len(names)), sigma=3.0)]
    motion = Motion(order=1) if model.velocity else Motion()
    problem = assemble(station_array(place, names), *rows, motions=(motion,))
    truth = np.concatenate([_TRUTH[:d], (60.0, -35.0, 5.0)[:d]])[: problem.layout.size]
    drawn = simulate(problem, truth, 1)
    lines = [
        f"# {kind}: {model.summary}.",
        f"# truth: {', '.join(f'{v:g}' for v in _TRUTH[:d])}",
        "format = 1",
        f'title = "Rows of {kind} beside ranges"',
        "",
        "[stations]",
        'unit = "m"',
        "rows = [",
        *(
            f'  {{ name = "{name}", ' + ", ".join(f"{c} = {v}" for c, v in zip("xyz", p, strict=False)) + " },"
            for name, p in zip(names, place.tolist(), strict=True)
        ),
        "]",
    ]
    lines += ["", "[target]", 'motion = "constant_velocity"'] if model.velocity else []
    for block, noise in zip(drawn.rows, (sigma, 3.0), strict=True):
        quantity = MODELS[block.kind].quantity
        known = f"                           # one of {', '.join(UNITS[quantity])}"  # type: ignore[index]  # models hold known quantities only
        lines += ["", "[[measurements]]", f'kind = "{block.kind}"', f'unit = "{SI_UNIT[quantity]}"{known}']  # type: ignore[index]  # as above
        lines += [f"sigma = {noise}", "rows = ["]
        for i, z in enumerate(np.ravel(block.z).tolist()):
            ends = [f'a = "{names[block.a[i]]}"'] if MODELS[block.kind].stations else []
            ends += [f'b = "{names[block.b[i]]}"'] if MODELS[block.kind].stations == 2 else []
            lines.append("  { " + ", ".join([*ends, f"z = {z:.6g}"]) + " },")
        lines.append("]")
    return "\n".join(lines) + "\n"
