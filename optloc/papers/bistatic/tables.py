"""The tables: what is claimed, what the recursion does, what the cures do, and the bounds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from optloc.papers.bistatic.trials import Errors
from optloc.papers.report import Table
from optloc.types import Array

CLAIMS = (("range", 0, 1e3, "< 1 km"), ("azimuth", 1, 0.005, "< 0.005 rad"), ("elevation", 2, 0.008, "< 0.008 rad"))
"""What the text claims of the errors after 10 epochs."""

STATIC = {
    ("simplified", 10): 370.0, ("simplified", 50): 181.0, ("simplified", 200): 92.4,
    ("maximum likelihood", 10): 293.0, ("maximum likelihood", 50): 134.0, ("maximum likelihood", 200): 65.9,
}  # fmt: skip
"""Errors of the range of a target that stays, metres, of an independent program with 2000 runs."""


def kilometres(value: float) -> str:
    """Return metres as kilometres with three digits."""
    return f"{value / 1e3:.3f}"


def _cells(errors: Array) -> tuple[str, str, str]:
    return kilometres(errors[0]), f"{errors[1]:.5f}", f"{errors[2]:.5f}"


def still(found: Mapping[str, Errors], bounds: Mapping[int, Array]) -> Table:
    """Return root mean square errors of a target that stays.

    Parameters
    ----------
    found : mapping of str to Errors
        By estimator.
    bounds : mapping of int to array (3,)
        Bound by number of epochs.
    """
    lines = []
    for count, bound in bounds.items():
        lines += [(str(count), name, *_cells(errors.rms(count))) for name, errors in found.items()]
        lines.append((str(count), "bound", *_cells(bound)))
    header = ("epochs", "estimator", "range, km", "azimuth, rad", "elevation, rad")
    note = "The recursion loses the square root of 2 in range, and nothing in angle."
    return Table("still", "Target that stays", header, tuple(lines), note)


def claims(found: Mapping[str, Errors]) -> Table:
    """Return the share of runs in which the paper's claims for 10 epochs hold."""
    lines = []
    for name, column, limit, label in CLAIMS:
        held = [np.abs(errors.error[:, errors.epochs == 10, column]) < limit for errors in found.values()]
        spread = [errors.rms(10)[column] for errors in found.values()]
        unit = "{:.0f} m" if column == 0 else "{:.4f} rad"
        lines.append((name, label, *(f"{100 * each.mean():.1f} %" for each in held), *map(unit.format, spread)))
    header = ("error", "printed", *(f"{name}, share" for name in found), *(f"{name}, rms" for name in found))
    note = "The printed limits are those of one run; 1 degree over the root of 10 is 0.0055 rad."
    return Table("claims", "Claims for 10 epochs", header, tuple(lines), note)


def slow(
    tracks: Mapping[str, Errors], batches: Mapping[int, Mapping[str, Errors]], bounds: Mapping[int, Array]
) -> Table:
    """Return root mean square errors of the slow target.

    Parameters
    ----------
    tracks : mapping of str to Errors
        By tracker.
    batches : mapping of int to mapping of str to Errors
        Fits of whole records, by number of epochs.
    bounds : mapping of int to array (3,)
        Bound by number of epochs; those of `batches`.
    """
    early, late = sorted(batches)
    lines = [
        (name, kilometres(e.rms(early)[0]), *_cells(e.rms(late)), kilometres(e.mean(late)[0]), kilometres(e.over(11)))
        for name, e in tracks.items()
    ]
    for name, last in batches[late].items():
        first = kilometres(batches[early][name].rms(early)[0])
        lines.append((name, first, *_cells(last.rms(late)), kilometres(last.mean(late)[0]), "–"))
    lines.append(("bound, constant velocity", kilometres(bounds[early][0]), *_cells(bounds[late]), "–", "–"))
    header = (
        "estimator", f"range at {early}, km", f"range at {late}, km", "azimuth, rad", "elevation, rad",
        "mean error, km", f"range from 11 to {late}, km",
    )  # fmt: skip
    return Table("slow", "Slow target", header, tuple(lines))


def short(rows: Mapping[str, tuple[Errors, Array]]) -> Table:
    """Return what the bound is worth in short records: batch fits of 10 epochs, and their bound, by noise."""
    lines = tuple(
        (name, kilometres(errors.rms(10)[0]), kilometres(errors.mean(10)[0]), kilometres(bound[0]))
        for name, (errors, bound) in rows.items()
    )
    note = (
        "The first derivative of the path with the speed across vanishes at rest; its second bounds that speed all "
        "the same where the path is good. The bound of Cramér and Rao sees the first only: it is no floor here."
    )
    header = ("noise of the path", "batch maximum likelihood, km", "mean error, km", "bound, km")
    return Table("short", "Ten epochs of the slow target", header, lines, note)


def directions(values: Mapping[float, float]) -> Table:
    """Return the bound of the range of one epoch against azimuth."""
    lines = tuple((f"{azimuth:.3f}", kilometres(value)) for azimuth, value in values.items())
    note = "Towards the illuminator the path says nothing of the range; behind the receiver it is an ordinary radar."
    return Table("directions", "One epoch, by azimuth", ("azimuth, rad", "bound of the range, km"), lines, note)


def printed(azimuth: Array, corrected: float) -> Table:
    """Return the error of the angle step as printed; azimuth errors are (trials, epochs), radians."""
    spread = np.sqrt((azimuth**2).mean(0))
    last = azimuth.shape[1]
    lines = tuple(
        (str(i), f"{spread[i - 1]:.3f}", f"{corrected / np.sqrt(i):.4f}") for i in (1, 2, 5, 10, 50, last) if i <= last
    )
    header = ("epochs", "as printed, rad", "with the sign corrected, rad")
    return Table("printed", "Azimuth step with the printed sign", header, lines)
