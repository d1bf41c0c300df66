"""The data of a draw as two tables of a user, and the command that fixes them."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from advice.scene import LENGTHS, LIGHT, SECONDS, Data, names
from typer.testing import CliRunner

from optloc.cli.application import app

_ANGLES = ("azimuth",)


def fits_a_table(data: Data) -> bool:
    """Return whether the data have one kind of rows that a table has in one column."""
    return len(set(data.kind)) == 1 and data.kind[0] in (*LENGTHS[:3], *_ANGLES) and data.velocity is None


def arguments(data: Data, folder: Path) -> list[str]:
    """Write the tables of the stations and of the rows, and return the arguments of the command after its name."""
    kind = data.kind[0]
    size = np.pi / 180.0 if kind in _ANGLES else data.size(data.unit)
    geodetic = data.geodetic is not None
    heads = ["lat", "lon", "height"] if geodetic else list("xyz"[: data.place.shape[1]])
    place = data.geodetic if geodetic else data.place / data.size(data.place_unit)
    if not geodetic and data.place_unit != "m":
        heads = [f"{axis}_{data.place_unit}" for axis in heads]
    _write(folder / "stations.csv", ["name", *heads], zip(names(data), *place.T.tolist(), strict=True))
    rows = []
    for e, when in enumerate(data.time):
        for j, (a, b) in enumerate(zip(data.a, data.b, strict=True)):
            value = data.z[e, j] % (2.0 * np.pi) if kind in _ANGLES else data.z[e, j]
            rows.append([float(when), f"S{a}", *([f"S{b}"] if b >= 0 else []), float(value / size)])
    columns = ["time_s", "station", *(["reference"] if data.b[0] >= 0 else []), kind]
    _write(folder / "rows.csv", columns, rows)
    unit = "deg" if kind in _ANGLES else data.unit
    sigma = float(data.sigma[0])
    noise = f"{sigma!r} m" if data.own_sigma and kind in LENGTHS else f"{sigma / size!r} {unit}"
    out = [str(folder / "rows.csv"), "--stations", str(folder / "stations.csv"), "--sigma", noise, "--unit", unit]
    out += ["--as", "arrivals" if kind == "toa" else kind]
    if kind in _ANGLES:
        out += ["--azimuth", data.azimuth]
    if data.speed != LIGHT and data.unit in SECONDS:
        out += ["--wave-speed", f"{data.speed!r} m/s"]
    if not geodetic and np.sqrt((data.place**2).sum(1)).max() > 6e6:
        out += ["--frame", "ecef"]
    if data.level is not None:
        out += ["--height", f"{data.level!r} m"]
    return out


def _write(file: Path, head: list[str], rows: Any) -> None:
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out)
        writer.writerow(head)
        writer.writerows(rows)


def fixed(arguments: list[str]) -> dict[str, Any]:
    """Return the JSON that `optloc fix` prints for arguments."""
    out = CliRunner().invoke(app, ["fix", *arguments, "--json", "--quiet"])
    if out.exit_code not in (0, 1):
        raise AssertionError(f"{arguments}: {out.output}")
    return json.loads(out.stdout)
