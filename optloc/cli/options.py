"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from optloc.cli.group import told
from optloc.errors import InvalidProblem, nearest


def _shipped(path: Path) -> Path:
    """Return the path, or that of the shipped problem of this name where no such file is there."""
    if path.name != str(path) or path.suffix or path.exists():
        return path
    folder = files("optloc") / "scenarios"
    known = sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))
    if str(path) in known:
        return Path(str(folder / f"{path}.toml"))
    raise InvalidProblem(
        "there is no such file, and no shipped problem of this name", str(path), nearest(str(path), known)
    )


ProblemPath = Annotated[
    Path,
    typer.Argument(
        metavar="FILE", help="Problem file (TOML, format = 1), or the name of a shipped one.", callback=_shipped
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON on standard output and nothing else.")]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw stations, fix and 95 % ellipse.")]
Html = Annotated[
    Path | None, typer.Option("--html", metavar="OUT.html", help="Write a page with a map that moves; Earth only.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", callback=told, help="Say on standard error what is done, and how long it takes."),
]


def names(what: str) -> Callable[[str], list[str]]:
    """Return a completion of the names in one of the tables of `optloc list`."""

    def found(incomplete: str) -> list[str]:
        from optloc.cli.listing import LISTS

        return [next(iter(row.values())) for row in LISTS[what]()]

    return found


Method = Annotated[
    str,
    typer.Option(
        "--method", "-m", autocompletion=names("methods"), help="How to solve; see [bold]optloc list methods[/bold]."
    ),
]
Geodetic = Annotated[
    bool, typer.Option("--geodetic", help="The coordinates are latitude, longitude (deg) and height (m).")
]
Height = Annotated[
    str | None, typer.Option("--height", metavar="H", help="Known height above the ellipsoid: 500, or '1640 ft'.")
]
AboveGround = Annotated[bool, typer.Option("--above-ground", help="The target is above the ellipsoid.")]
Box = Annotated[
    str | None,
    typer.Option("--box", metavar="LOW:HIGH", help="Region, metres in the frame: X,Y[,Z]:X,Y[,Z]; inf is no bound."),
]
NoiseFromData = Annotated[
    str | None,
    typer.Option("--noise-from-data", metavar="station|pair|kind", help="Estimate the noise of each of these."),
]
