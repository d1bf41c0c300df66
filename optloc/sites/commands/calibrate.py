"""The command ``optloc calibrate``: stations, clocks and pulses from measurements alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from optloc.cli import Budget, Force, Json, Outside, ProblemPath, Quiet, TurnAround, TwoWay, Verbose, WaveSpeed

if TYPE_CHECKING:
    from optloc.sites.calibration import Calibration

NETWORKS = (
    "optloc calibrate hall.toml",
    "optloc calibrate hall.toml --gauge A1,A2,A3 --out surveyed.toml --plot network.png",
)
# Largest number of stations in the table, so that it fits on a screen.
_LINES = 40

Gauge = Annotated[str | None, typer.Option(metavar="A1,A2,A3", help="Stations that define the frame.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the random starts.")]
Robust = Annotated[bool, typer.Option("--robust", help="Leave out and list rows that contradict most others.")]
Out = Annotated[Path | None, typer.Option(metavar="OUT.toml", help="Write a problem file with the estimated stations.")]
Picture = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw plan, elevation and residuals.")]


def calibrate(
    file: ProblemPath,
    gauge: Gauge = None,
    seed: Seed = 0,
    robust: Robust = False,
    out: Out = None,
    plot: Picture = None,
    wave_speed: WaveSpeed = None,
    two_way: TwoWay = False,
    turn_around: TurnAround = None,
    as_json: Json = False,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Find positions and clocks of stations from pulses at unknown positions, without a first guess, and check them.

    FILE lists the stations, with coordinates only where these are known, and the measurements of each pulse.
    """
    outputs = (out, plot)
    raise typer.Exit(
        _run(
            file, gauge, seed, outputs, (wave_speed, two_way, turn_around), robust=robust, as_json=as_json, quiet=quiet
        )
    )


def _run(
    file: Path,
    gauge: str | None,
    seed: int,
    outputs: tuple[Path | None, Path | None],
    wave: tuple[str | None, bool, str | None],
    *,
    robust: bool,
    as_json: bool,
    quiet: bool,
) -> int:
    """Calibrate, write the outputs and return the exit code: 0 for status ok, otherwise 1.

    `gauge` are names of stations, separated by commas. `outputs` are the problem file and the picture to write.
    `wave` has the wave speed, whether ranges are two-way times, and their turn-around time; they replace the keys of
    the file.
    """
    from optloc.cli import Screen, claim_outputs, dumps, line, say, write_picture, write_text
    from optloc.problem import Status
    from optloc.sites.calibration import calibrate as find
    from optloc.sites.calibration.network_file import check_name, load_network, write_calibrated

    out, plot = outputs
    claim_outputs(out, picture=plot, inputs=[file])
    if out is not None:
        check_name(out)
    network, warnings, speed = load_network(file, wave[0], two_way=wave[1], turn_around=wave[2])
    if not quiet and not as_json:
        if speed:
            say(Screen(), f"Wave speed: {speed}.")
        for sentence in warnings:
            say(Screen(), f"Warning: {sentence}.")
    named = tuple(name.strip() for name in gauge.split(",")) if gauge else ()
    with line(quiet or as_json) as tell:
        tell("searching")
        found = find(network, gauge=named, seed=seed, robust=robust, tell=tell)
    if out is not None:
        write_calibrated(found, file.stem, out, file)
    if plot is not None:
        write_picture(_picture(found, file.stem), plot)
    if as_json:
        write_text(Path("-"), dumps(_record(found, file) | {"warnings": warnings, "wave_speed": speed or None}))
    elif not quiet:
        _show(found)
        if out is not None:
            say(Screen(), f"The stations are in {out}. Next step: optloc fix {out}.")
    return 0 if found.status is Status.OK else 1


def _show(found: Calibration) -> None:
    """Print status, findings, the table of stations and the alternatives."""
    from rich.table import Table

    from optloc.cli import Screen, say
    from optloc.sites.calibration.network_findings import gap_words

    console, net = Screen(), found.network
    say(console, f"status {found.status.label}, proof {found.proof}; frame of {found.gauge}")
    for words in found.findings:
        say(console, words)
    if found.starts:
        fit = f"cost {found.cost:.4g}, {found.dof} degrees of freedom, p = {found.p_value:.3g}"
        say(console, f"{fit}; {found.agreeing} of {found.starts} starts agree")
    table = Table(title="Stations, m", title_justify="left")
    axes = "xyz"[: net.dimension]
    clocks = [] if net.synchronised else ["clock"]
    for heading in ("station", *(f"{c} ±" for c in axes), *clocks, "rms residual, sigma"):
        table.add_column(heading, justify="left" if heading == "station" else "right")
    with np.errstate(invalid="ignore"):
        sigma = found.sigma
    for i, name in enumerate(net.names[:_LINES]):
        values = found.residuals[:, [i in (slot.a, slot.b) for slot in net.slots]]
        values = values[np.isfinite(values)]
        cells = [f"{v:.3f} {s:.3f}" for v, s in zip(found.stations[i], sigma[i], strict=True)]
        clock = [] if net.synchronised else [f"{found.clocks[i]:.3f}"]
        table.add_row(name, *cells, *clock, f"{np.sqrt(np.mean(values**2)):.2f}" if values.size else "-")
    console.print(table)
    for other in found.alternatives[:5]:
        say(console, f"{other.what} {gap_words(other.gap)}.")
    if not np.isfinite(net.place_sigma).any():
        needed = f"known positions of {net.dimension} stations and one coordinate of another station"
        say(console, f"The mirror image of a network without known positions fits, too; to exclude it, add {needed}.")


def _record(found: Calibration, file: Path) -> dict[str, Any]:
    """Return the result as a dictionary for JSON output."""
    net = found.network
    return {
        "file": str(file),
        "status": found.status.label,
        "findings": found.findings,
        "proof": found.proof,
        "frame": found.gauge,
        "cost": found.cost,
        "dof": found.dof,
        "p_value": found.p_value,
        "agreeing": found.agreeing,
        "starts": found.starts,
        "stations": [
            {"name": name, "position": place, "sigma": sigma, "clock": clock}
            for name, place, sigma, clock in zip(net.names, found.stations, found.sigma, found.clocks, strict=True)
        ],
        "left_out": [{"pulse": net.labels[j], "station": net.names[net.slots[r].a]} for j, r in found.left_out],
        "covariance": found.covariance,
        "pulses": [
            {"name": name, "position": place, "emission": emission}
            for name, place, emission in zip(net.labels, found.pulses, found.emission, strict=True)
        ],
        "alternatives": [{"what": o.what, "gap": o.gap, "stations": o.stations} for o in found.alternatives],
    }


def _picture(found: Calibration, title: str) -> Any:
    """Return the figure of the network; at most three alternatives are drawn."""
    from optloc.sites.calibration.network_map import plot_network

    net = found.network
    known = np.where(np.isfinite(net.place_sigma), net.place, np.nan)
    size = net.stations * net.dimension
    return plot_network(
        net.names,
        found.stations,
        found.covariance[:size, :size],
        found.pulses,
        known,
        [other.stations for other in found.alternatives[:3]],
        found.residuals,
        found.dof,
        f"{title}: {found.status.label}",
    )
