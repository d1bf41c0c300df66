"""Everything that the paper shows, in a quick and in a full size."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from optloc.base.types import Array
from optloc.papers import bistatic
from optloc.papers.bistatic import (
    ANGLE,
    EPOCHS,
    PATH,
    TRACKERS,
    Errors,
    batches,
    bound_moving,
    bound_single,
    bound_still,
    moving,
    printed_angles,
    still,
)
from optloc.papers.report import Picture, Report, Size, Study, Table, Tick, canvas

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The tables: what is claimed, what the recursion does, what the cures do, and the bounds.

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


def still_table(found: Mapping[str, Errors], bounds: Mapping[int, Array]) -> Table:
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


# What the page says around its tables.

TITLE = "One receiver and one illuminator: slow targets by excess path and direction"

OPENING = """\
A receiver at the origin hears the echo of an illuminator of opportunity 150 km away on the x axis. It measures the
excess path l = r + |r u − A| − d of the echo (20 ns) and its azimuth and elevation (1° each), once a second, of a
target 81.2 km away. The paper estimates range and angles by a recursion that is cheaper than least squares. It is
made again here, corrected, beside what optloc does with the same data; nothing is started by a guess.

- **simplified** is the recursion of the paper with its signs and indices corrected: running means of both angles,
  and a scalar gain for the range. It begins from the fix of the first epoch. *restart* begins it anew every so many
  epochs, from one fix or from the mean of ten epochs; a *gain floor* never lets a gain fall below one in twenty.
- **maximum likelihood** of a target that stays is the fix of the mean measurement: three unknowns, three means.
- **line fit** is a straight line through each of the three measurements, solved at its end (`optloc.track.lines`).
- **pseudo-linear course** is linear in place and velocity, and exact without noise; **batch maximum likelihood** is
  `optloc.solve` on the whole record, which it starts.
- **Cartesian EKF and IEKF** have a state of six, velocity 0 ± 50 m/s, and begin from the first epoch.

## How the paper was read

The paper does not give the length of the record (200 epochs here: the lag then exceeds the noise, as the text on its
figures says) or the period of the restarts (10 to 100 here). The velocity (4, 10, 6) m/s is taken with the signs as
printed: the range grows by 11 m/s."""

CLOSING = """\
## What follows

1. A target that stays needs no recursion: the fix of the mean is cheaper, and has √2 less error in range. The
   recursion averages the ranges that the running means of the angles imply, whose errors are alike.
2. Of the variance of the range 99.97 % is the azimuth's: 74.3 km/rad times 1° over 1.388 are 934 m; the path adds 4
   m and the elevation 14 m. Better angles are worth the effort, a better delay is not.
3. A slow target is followed late, by v n / 2 after n epochs. A restart throws the average away; to begin anew from
   the mean of ten epochs, or never to let the gain fall below a floor, is better than any period of plain restarts.
4. In the measurements themselves the slow target moves on straight lines and nothing has to be linearised: the line
   fit is ten times better than the recursion after 200 epochs, and near the bound.
5. The Cartesian filters miss the bound by far: 6 m along against 1.4 km across are a curved ridge. One linearisation
   a scan does not follow it, and iteration helps little, for no Gaussian state has that shape.

## What is wrong in the paper

1. Section 2.2 puts the receiver at (d, 0, 0). It is the illuminator that is there.
2. Equation 9 has the angles themselves as factors of the partial derivatives: 107.4 for 74.26 km/rad in azimuth and
   0.142 for 1.152 km/rad in elevation.
3. Equation 11 sums the residuals, not their squares, and has no minimum; its weights are the variances, not their
   inverses. For a target that stays all weights cancel anyhow.
4. Equation 10 leaves open whether one measurement or all of a record are meant.
5. Steps 1 and 2 move the angles away from the measurement: the sign is wrong, and the error grows with every epoch
   (table *printed*).
6. Step 4 uses a range before it exists and the measurement before the present one, and its residual mixes
   quantities. It is y = l − l(r, az, el) − l_az Δaz − l_el Δel at the previous state.
7. Step 6 adds K (y − x Δr); it has to be K y. Step 7 writes k for K.
8. P = 1 at the start weighs the second epoch more than the first: its gain is 0.474, where equal weights need 0.360.
   It does no harm and is kept.
9. As printed the recursion diverges; the figures come from another program."""


# Errors against time, and one run.

# Dashes over a full line: two estimators that agree are both seen.
_STYLE = {
    "single fix": ("#999999", "-"),
    "simplified": ("#D55E00", "-"),
    "simplified, no restart": ("#D55E00", "-"),
    "maximum likelihood": ("#0072B2", "--"),
    "restart every 50": ("#009E73", "-"),
    "gain floor 0.05": ("#CC79A7", "-"),
    "Cartesian EKF": ("#E69F00", "-"),
    "line fit": ("#0072B2", "-"),
}
_NAMES = ("range, km", "azimuth, rad", "elevation, rad")
_UNITS = (1e-3, 1.0, 1.0)


def against_time(found: Mapping[str, Errors], bound: tuple[Array, Array], points: Mapping[str, Errors]) -> Figure:
    """Return root mean square errors of range, azimuth and elevation against the number of epochs.

    Parameters
    ----------
    found : mapping of str to Errors
        Curves.
    bound : tuple of array (q,) and array (q, 3)
        Numbers of epochs and the bound.
    points : mapping of str to Errors
        Estimates after one number of epochs each.
    """
    figure = canvas(15.0, 4.6)
    axes = figure.subplots(1, 3)
    for i, ax in enumerate(axes):
        ax.plot(bound[0], _UNITS[i] * bound[1][:, i], color="#000000", lw=1.0, label="Cramér-Rao bound")
        for name, errors in found.items():
            spread = _UNITS[i] * np.sqrt((errors.error[..., i] ** 2).mean(0))
            ax.plot(errors.epochs, spread, _STYLE[name][1], color=_STYLE[name][0], lw=1.6, label=name)
        for name, errors in points.items():
            spread = _UNITS[i] * np.sqrt((errors.error[..., i] ** 2).mean(0))
            ax.plot(errors.epochs, spread, "D", color="#000000", mfc="none", ms=7, label=name)
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter(_two_or_five)
        _named(ax, f"error of {_NAMES[i]} (root mean square)")
    handles, labels = axes[0].get_legend_handles_labels()
    kept = {label: handle for handle, label in zip(handles, labels, strict=True)}
    figure.legend(kept.values(), kept.keys(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def one_run(found: Mapping[str, Errors]) -> Figure:
    """Return the errors of the first run of each estimator against the number of epochs."""
    figure = canvas(15.0, 4.6)
    axes = figure.subplots(1, 3)
    for i, ax in enumerate(axes):
        for name, errors in found.items():
            thin = 0.7 if name == "single fix" else 1.6
            ax.plot(errors.epochs, _UNITS[i] * errors.error[0, :, i], color=_STYLE[name][0], lw=thin, label=name)
        ax.axhline(0.0, color="#000000", lw=0.8)
        _named(ax, f"error of {_NAMES[i]}")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _two_or_five(value: float, place: float) -> str:
    """Return the label of a minor tick of a logarithmic axis: 2 and 5 in every decade."""
    return f"{value:g}" if f"{value:.0e}"[0] in "25" else ""


def _named(ax: Axes, label: str) -> None:
    ax.set_xlabel("epochs, one a second")
    ax.set_ylabel(label)
    ax.grid(visible=True, which="both", alpha=0.25)


_COUNTS = (1, 10, 50, 200)
_EARLY = 50
_AZIMUTHS = (0.05, 0.2, 0.5, 1.0, 1.446, 2.0, 2.6, 3.1)
_SHOWN = ("single fix", "simplified, no restart", "restart every 50", "gain floor 0.05", "Cartesian EKF", "line fit")
_RUN = ("single fix", "simplified, no restart", "restart every 50", "line fit")


@dataclass(frozen=True, slots=True)
class Sample:
    """How much is drawn.

    Parameters
    ----------
    still, slow : int
        Trials of the target that stays, and of the slow one.
    ground : int
        Trials of each case with a ground.
    epochs : int
        Length of the records, more than 50.
    """

    still: int
    slow: int
    ground: int
    epochs: int = EPOCHS


_SIZES: dict[Size, Sample] = {"quick": Sample(1000, 150, 200), "full": Sample(2000, 1000, 2000)}


def _run(sample: Sample, seed: int, tick: Tick) -> Report:
    def sequence(key: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(seed, spawn_key=(key,))

    stays = still(sample.epochs, sample.still, sequence(0))
    tick()
    tracks = moving(sample.epochs, sample.slow, sequence(1), tick)
    fits = {}
    for count in (_EARLY, sample.epochs):
        fits[count] = batches(count, sample.slow, sequence(1), whole=sample.epochs)
        tick()
    bounds = {count: bound_moving(np.array([count]))[0] for count in (_EARLY, sample.epochs)}
    made = (
        still_table(stays, {count: bound_still(np.array([count]))[0] for count in _COUNTS if count <= sample.epochs}),
        claims(stays),
        slow(tracks, fits, bounds),
        _short(sample.slow, sequence, tick),
        directions({azimuth: bound_single(azimuth) for azimuth in _AZIMUTHS}),
        bistatic.table(sample.ground, sequence(4), tick),
        printed(printed_angles(sample.epochs, sample.still, sequence(5)), ANGLE),
    )
    facts = f"seed {seed}, {sample.still} trials of the target that stays, {sample.slow} of the slow one"
    return Report(TITLE, facts, OPENING, CLOSING, made, _pictures(stays, tracks, fits))


def _short(trials: int, sequence: Callable[[int], np.random.SeedSequence], tick: Tick) -> Table:
    """Return batch fits of ten epochs, with the noise of the paper and with ten times that of the path."""
    rows = {}
    for key, (name, path) in enumerate({"20 ns": PATH, "200 ns": 10.0 * PATH}.items(), 2):
        errors = batches(10, trials, sequence(key), path=path)["batch maximum likelihood"]
        rows[name] = (errors, bound_moving(np.array([10]), path)[0])
        tick()
    return short(rows)


def _pictures(
    stays: Mapping[str, Errors], tracks: Mapping[str, Errors], fits: Mapping[int, Mapping[str, Errors]]
) -> tuple[Picture, ...]:
    counts = np.unique(np.geomspace(1, max(fits), 40).astype(int))
    # Two epochs determine a course, but so badly that its bound is off the scale.
    later = counts[counts >= 5]
    shown = {name: tracks[name] for name in _SHOWN}
    batch = "batch maximum likelihood"
    points = {
        batch: Errors(np.array(sorted(fits)), np.concatenate([fits[k][batch].error for k in sorted(fits)], axis=1))
    }
    return (
        Picture("still", "Target that stays", against_time(stays, (counts, bound_still(counts)), {})),
        Picture("slow", "Slow target", against_time(shown, (later, bound_moving(later)), points)),
        Picture("run", "One run of the slow target", one_run({name: tracks[name] for name in _RUN})),
    )


STUDY = Study(_SIZES, lambda _: len(TRACKERS) + len(bistatic.CASES) + 5, _run)
"""The reproduction of the paper."""
