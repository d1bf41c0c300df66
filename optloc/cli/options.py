"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ProblemPath = Annotated[Path, typer.Argument(metavar="FILE", help="Problem file (TOML, format = 1).")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON on standard output and nothing else.")]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw stations, fix and 95 % ellipse.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Method = Annotated[str, typer.Option("--method", "-m", help="How to solve; see [bold]optloc list solvers[/bold].")]
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
