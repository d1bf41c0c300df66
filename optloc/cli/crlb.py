"""The commands ``optloc crlb`` and ``optloc simulate``: Cramer-Rao bounds, status shares and simulated data.

In the functions, `at` and `velocity` are texts with the true position and velocity of the target. With `geodetic`, the
position is latitude, longitude and height. `limits` is the extent of a map as text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from optloc.base.errors import InvalidProblem
from optloc.base.inputs import check_budget
from optloc.base.linalg import error_ellipse
from optloc.base.types import Array
from optloc.bounds.cramer_rao import Course, crlb_course
from optloc.bounds.over_area import BoundMap, bound_map, extent, map_coordinates
from optloc.cli.options import coordinates
from optloc.cli.output import PICTURES, Screen, claim_outputs, dumps, say, write_picture, write_text
from optloc.files.constraint_table import ConstraintTable
from optloc.files.reader import Loaded, read
from optloc.files.settings import Units
from optloc.model_checks.evidence import Reliability, reliability
from optloc.models import MODELS
from optloc.problem.epochs import by_epoch, has_correlated_epochs, separable
from optloc.problem.explanations import Suspect
from optloc.problem.layout import Layout, Slot, state_names
from optloc.problem.problem import Problem

if TYPE_CHECKING:
    from optloc.solvers.shares import StatusShares

# Maximum lines that fit a screen: of the table against time, of the bounds, and of the members of a bias.
_LINES, _BOUNDS, _MEMBERS = 10, 30, 16
# A picture resolves at most 400 points of a curve. More than 100 unknowns give more curves than a reader can use.
_POINTS, _UNKNOWNS = 400, 100
# Points along each side of a map: isolines are smooth, and 9216 bounds take less than a second.
_MAP_POINTS = 96
# Points along each side of a status map: each point needs 50 simulated fixes.
_STATUS_POINTS = 24
# Simulated fixes at one position, and at each point of a map. The shares have errors of 3 % and 7 %.
_TRIALS, _TRIALS_OF_A_MAP = 200, 50
_UNITS = {"length": "m", "speed": "m/s"}
_RMS = {True: " (rms)", False: ""}
More = Mapping[str, ConstraintTable] | None
"""Constraints that options add to a file, by the name of the option."""


def run_crlb(
    file: Path,
    at: str | None,
    velocity: str | None,
    *,
    geodetic: bool,
    as_json: bool,
    plot: Path | None = None,
    quiet: bool = False,
    more: More = None,
) -> int:
    """Print the Cramer-Rao bound at a true position or at the fix, and draw it against time in the file `plot`.

    The exit code is 1 if no unknown has a bound, or a standard deviation is not finite. `as_json` prints JSON, and
    `quiet` prints nothing.
    """
    from optloc.bounds.cramer_rao import crlb

    loaded = read(file, values=False, more=more)
    claim_outputs(picture=plot, inputs=[file])
    problem = by_epoch(loaded.problem) if separable(loaded.problem) else loaded.problem
    if not problem.layout.n_shared:
        raise InvalidProblem("no unknown is shared by the epochs", loaded.source, "add a bias")
    # Biases of known targets alone need no target position: their bound does not depend on it.
    truth = (
        _solve(file, more) if at is None and _has_unknown_position(problem) else vector(problem, at, velocity, geodetic)
    )
    bound = np.asarray(crlb(problem, truth))
    # Identical epochs have one bound: broadcast it to all epochs.
    bound = np.broadcast_to(bound, (*problem.batch_shape, *bound.shape[-2:])).reshape(-1, *bound.shape[-2:])
    labels = loaded.epochs if problem.batch_shape else ("run" if loaded.problem.epochs > 1 else loaded.epochs[0],)
    rows = [
        _record(label, slot, cov[slot.start : slot.start + slot.size, slot.start : slot.start + slot.size])
        for label, cov in zip(labels, bound, strict=True)
        for slot in problem.layout.shared
    ]
    over_time = courses(problem, truth)
    found = reliability_of(problem, truth)
    if plot is not None:
        _draw(plot, loaded, over_time)
    if as_json:
        course = [] if over_time is None else _course_records(*over_time)
        made = {"file": loaded.source, "bounds": rows, "reliability": reliability_json(found), "course": course}
        write_text(Path("-"), dumps(made))
    elif not quiet:
        console = Screen()
        console.print(_bound_table(loaded, rows))
        show_reliability(found, console)
        if over_time is not None:
            console.print(_course_table(*over_time, loaded))
    return 0 if all(np.isfinite(row["sigma"]).all() for row in rows) and rows else 1


def _has_unknown_position(problem: Problem) -> bool:
    """Return whether a target has an unknown position, so that the bound depends on it."""
    return any(motion.known is None for motion in problem.motions)


def _solve(file: Path, more: More) -> Array:
    """Return the estimate (..., size) of a file that has measured values."""
    from optloc.solvers.solution import solve

    return solve(read(file, more=more).problem).x


def _draw(path: Path, loaded: Loaded, over_time: tuple[Course, Course | None] | None) -> None:
    """Draw the bound against time; raise InvalidProblem if the epochs share no unknowns.

    `over_time` is the result of `courses`.
    """
    from optloc.show.pictures import plot_course

    if over_time is None:
        advice = "add a motion or biases that the epochs share, but not hundreds of targets"
        raise InvalidProblem("the epochs share no unknowns, or too many to draw", "--plot", advice)
    names = _shown_unknowns(over_time[0].layout)
    write_picture(plot_course(*over_time, title=f"{loaded.title}: Cramer-Rao bound", names=names), path)


def _record(label: str, slot: Slot, covariance: Array) -> dict[str, Any]:
    """Return the bound of one unknown as a record: standard deviations, SI, and for positions the 95 % ellipse, m.

    `label` is the epoch, `slot` the unknown, and `covariance` the bound of its entries.
    """
    record = {"epoch": label, "unknown": slot.name, "entries": slot.entries, "unit": slot.unit}
    record |= {"sigma": np.sqrt(np.diagonal(covariance))}
    if not slot.name.startswith("position"):
        return record
    return record | {"ellipse95": error_ellipse(covariance)[0][::-1], "covariance": covariance}


def _bound_table(loaded: Loaded, rows: list[dict[str, Any]]) -> Table:
    """Return the table of the bounds for the screen, with at most 30 lines."""
    table = Table(title=f"{loaded.title}: Cramer-Rao bound", title_justify="left")
    for name in ("epoch", "unknown", "sigma", "95 % ellipse, m (semi-axes)"):
        table.add_column(name)
    for row in rows[:_BOUNDS]:
        ellipse = ", ".join(f"{v:.4g}" for v in row.get("ellipse95", ()))
        table.add_row(row["epoch"], row["unknown"], _sigmas(row, loaded), ellipse)
    if len(rows) > _BOUNDS:
        table.add_row("...", "", f"{len(rows) - _BOUNDS} more", "--json prints all")
    return table


def _sigmas(row: dict[str, Any], loaded: Loaded) -> str:
    """Return the standard deviations in a line; members of a bias have one line each, in the unit of the file."""
    if set(row["entries"]) <= set("xyz"):
        return f"{', '.join(f'{v:.4g}' for v in row['sigma'])} {row['unit']}"
    unit, size = loaded.bias_unit(row["unknown"], row["unit"])
    named = zip(row["entries"][:_MEMBERS], row["sigma"] / abs(size), strict=False)
    lines = [f"{entry}: {v:.4g} {unit}".strip(": ") for entry, v in named]
    n_hidden = len(row["entries"]) - _MEMBERS
    return "\n".join([*lines, *([f"... and {n_hidden} more"] if n_hidden > 0 else [])])


# Unnoticed errors.

# Largest number of epochs to evaluate; the table holds the worst values.
_MAX_EPOCHS = 100


def reliability_of(problem: Problem, x: Array, suspects: Sequence[Suspect] = ()) -> Reliability | None:
    """Return the smallest station errors that a search for suspects detects: the worst values over the epochs.

    `problem` is one problem, or a batch (...) of separate epochs. `x` (..., size) are the points of linearisation;
    points that are not finite are left out. At most 100 epochs are evaluated. `suspects` were left out by the fix. The
    result is None without a finite point.
    """
    flat = problem.flat()
    places = np.broadcast_to(x, (*problem.batch_shape, flat.layout.size)).reshape(-1, flat.layout.size)
    items = np.flatnonzero(np.isfinite(places).all(-1))
    # evenly spaced epochs suffice: the geometry of a run changes slowly
    items = items[np.unique(np.linspace(0, len(items) - 1, min(len(items), _MAX_EPOCHS)).astype(int))]
    # by station and kind, over the epochs: the largest value of `least`, SI units, and of `shift`, m
    worst: dict[str, tuple[float, float]] = {}
    for i in items:
        found = reliability(flat.take(np.array([i])), places[i], suspects)
        for name, least, shift in zip(found.names, found.least, found.shift, strict=True):
            before = worst.get(name, (0.0, 0.0))
            worst[name] = (max(before[0], float(least)), max(before[1], float(shift)))
    if not worst:
        return None
    least, shift = np.array(list(worst.values())).T
    return Reliability(tuple(worst), least, shift)


def reliability_json(found: Reliability | None) -> list[dict[str, Any]]:
    """Return the smallest noticed errors as records, in SI units and radians; infinite values are null."""
    if found is None:
        return []
    parts = zip(found.names, found.least, found.shift, strict=True)
    return [{"channel": name, "least_noticed": least, "moves_position": shift} for name, least, shift in parts]


def show_reliability(found: Reliability | None, console: Console) -> None:
    """Print the smallest noticed errors, sorted by decreasing displacement of the position."""
    if found is None:
        return
    table = Table(title="Errors that go unnoticed", title_justify="left")
    for name in ("of all rows", "up to", "moves the position, m"):
        table.add_column(name, justify="left" if name == "of all rows" else "right")
    order = np.argsort(-found.shift, kind="stable")
    for i in order[:_MEMBERS]:
        table.add_row(found.names[i], _size(found.names[i], found.least[i]), _length(found.shift[i]))
    if len(order) > _MEMBERS:
        table.add_row("...", "", f"{len(order) - _MEMBERS} more")
    console.print(table)


def _size(name: str, value: float) -> str:
    """Return an error of the rows `name`, such as "tdoa of A", as text with a unit; `value` is in SI units."""
    if not np.isfinite(value):
        return "any size"
    quantity = MODELS[name.partition(" of ")[0]].quantity
    if quantity == "angle":
        return f"{np.degrees(value):.3g} deg"
    return f"{value:.4g} {_UNITS.get(quantity, '')}".strip()


def _length(value: float) -> str:
    """Return a displacement, m, as text; an infinite displacement is "anywhere"."""
    return f"{value:.4g}" if np.isfinite(value) else "anywhere"


# Bound against time.


def courses(problem: Problem, truth: Array) -> tuple[Course, Course | None] | None:
    """Return the bound against time with unknown biases, and with known biases.

    The second is None unless the problem has biases and targets. The result is None for a single epoch, a batch, no
    shared unknowns, or too many.
    """
    n, k = problem.layout.n_shared, problem.epochs
    if k == 1 or not 0 < n <= _UNKNOWNS or has_correlated_epochs(problem) or problem.batch_shape:
        return None
    counts = np.arange(1, k + 1) if k <= _POINTS else np.unique(np.geomspace(1, k, _POINTS).round().astype(int))
    # Only biases have members; target states have none.
    names = [slot.name for slot in problem.layout.shared if slot.members]
    course = crlb_course(problem, truth, counts)
    targets = len(names) < len(problem.layout.shared)
    return course, crlb_course(problem, truth, counts, known=names) if names and targets else None


def _course_records(course: Course, known: Course | None) -> list[dict[str, Any]]:
    """Return records of the bound at about ten times: epochs, time (s), and sigma by unknown (SI).

    `course` is the bound with unknown biases, and `known` the bound with known biases, or None.
    """
    labels = course.layout.labels()
    return [
        {
            "epochs": int(course.counts[i]),
            "time": float(course.times[i]),
            "sigma": dict(zip(labels, _sigmas_at(course, i), strict=True)),
            "biases_known": None if known is None else dict(zip(labels, _sigmas_at(known, i), strict=True)),
        }
        for i in _sparse_indices(course)
    ]


def _sigmas_at(course: Course, i: int) -> Array:
    """Return the standard deviations (n,) of the n shared unknowns at the time with index `i`, SI."""
    return np.asarray(np.sqrt(np.diagonal(course.covariance[i])))


def _sparse_indices(course: Course) -> list[int]:
    """Return the indices of about ten times, denser at the start."""
    wanted = np.geomspace(1, course.counts[-1], _LINES)
    # Geometric spacing, since a bound falls with the root of the number of epochs.
    return [int(i) for i in np.unique(np.searchsorted(course.counts, np.floor(wanted)))]


def _shown_unknowns(layout: Layout) -> tuple[str, ...]:
    """Return the names of the unknowns that fit a table or a picture: the states of two targets, and four biases."""
    states = [slot.name for slot in layout.shared if not slot.members]
    biases = [slot.name for slot in layout.shared if slot.members]
    return (*states[:4], *biases[:4])


def _course_table(course: Course, known: Course | None, loaded: Loaded) -> Table:
    """Return the table of the bound at about ten times, in the units of the file.

    The table has the root sum of squares of coordinates, and the root mean square of the members of a bias. `course`
    and `known` are as in `_course_records`.
    """
    table = Table(title="Bound after the first epochs", title_justify="left")
    for name in ("epochs", "time, s"):
        table.add_column(name, justify="right")
    values: list[Array] = []
    for slot in (course.layout.find(name)[0] for name in _shown_unknowns(course.layout)):
        # `size` is the size of the unit in SI units; it is negative if the unit reverses the sign.
        unit, size = loaded.bias_unit(slot.name, slot.unit)
        table.add_column(f"{slot.name}{_RMS[bool(slot.members)]}, {unit}".rstrip(", "), justify="right")
        values.append(course.total(slot.name) / (abs(size) * np.sqrt(slot.size if slot.members else 1)))
        if known is not None and not slot.members:
            table.add_column("biases known", justify="right")
            values.append(known.total(slot.name))
    for i in _sparse_indices(course):
        numbers = [f"{value[i]:.4g}" if np.isfinite(value[i]) else "-" for value in values]
        table.add_row(str(course.counts[i]), f"{course.times[i]:g}", *numbers)
    return table


# Maps.


def run_map(
    file: Path,
    out: Path,
    at: str | None,
    height: str | None,
    limits: str | None,
    velocity: str | None,
    *,
    geodetic: bool,
    dilution: bool,
    more: More = None,
) -> int:
    """Write the map of the bound of a file. If epochs are separate, the map is of the first epoch.

    With `dilution`, the map shows the dilution of precision instead of the bound, m. `height` is the height of the map
    as text.
    """
    if out.suffix.lower() not in (*PICTURES, ".html", ".geojson"):
        advice = "use .png, .svg, .pdf, .geojson or .html"
        raise InvalidProblem(f"maps of type {out.suffix or out.name!r} are unknown", str(out), advice)
    loaded = read(file, values=False, more=more)
    claim_outputs(out, inputs=[file])
    problem = _of_one_epoch(loaded.problem)
    truth = vector(problem, at, velocity, geodetic)
    grid, level = _grid((file, more), problem, at, truth, height, limits, _MAP_POINTS)
    found = bound_map(problem, truth, *grid, level)
    what = "dilution of precision" if dilution else "bound of the position error"
    _write_map(found, out, f"{loaded.title}: {what}", dilution=dilution)
    return 0


def _of_one_epoch(problem: Problem) -> Problem:
    """Return the first epoch if epochs are separate, else the problem; maps show one epoch."""
    batch = by_epoch(problem) if separable(problem) else problem
    return batch.flat().take(np.zeros(1, dtype=int)) if batch.batch_shape else batch


def _grid(
    file: tuple[Path, More],
    problem: Problem,
    at: str | None,
    truth: Array,
    height: str | None,
    limits: str | None,
    points: int,
) -> tuple[tuple[Array, Array], float]:
    """Return the coordinates (points,) of a map along both sides, and the height of the map, m.

    The coordinates are in degrees on Earth, else in metres. Of a problem in space, the map is a horizontal plane. Its
    height is `height`, or the height of the stated position or of the fix. `file` has the constraints of options, too.
    """
    place = _place(file, problem, at, truth, needed=height is None and problem.dimension == 3)
    x0, x1, y0, y1 = extent(problem, place) if limits is None else _limits(limits, problem)
    return (np.linspace(x0, x1, points), np.linspace(y0, y1, points)), _height(problem, place, height)


def _place(file: tuple[Path, More], problem: Problem, at: str | None, truth: Array, *, needed: bool) -> Array | None:
    """Return the position (1, d) that the user states, m, or the fix; None if no position is needed.

    `truth` (size,) has the stated position. With several unknown targets, the stated position is not used. `needed` is
    whether the file is fixed without a stated position. Raise InvalidProblem if the file has no fix.
    """
    sought = [i for i, motion in enumerate(problem.motions) if motion.known is None]
    positions = [slot for slot in problem.layout.shared if slot.name.partition("[")[0] == "position"]
    if at is not None and len(sought) == 1 and positions:
        return np.asarray(truth[None, positions[0].start : positions[0].start + positions[0].size])
    if not needed:
        return None
    from optloc.solvers.solution import solve

    fix = solve(read(file[0], more=file[1]).problem)
    place = fix.position.reshape(-1, problem.dimension)
    good = place[np.isfinite(place).all(-1)]
    if not len(good):
        advice = "give the height of the map with --height, or a position with --at"
        raise InvalidProblem("the file has no fix with a height", "--map", advice)
    return np.asarray(good[:1])


def _height(problem: Problem, place: Array | None, height: str | None) -> float:
    """Return the height of a map, m: stated, else the height of `place` (1, d); 0 in the plane."""
    if problem.dimension == 2:
        return 0.0
    if height is not None:
        return float(Units("length").plain(height, "m", "--height"))
    assert place is not None
    return float(map_coordinates(problem.frame, place, problem.frame.geodetic)[0, 2])


def _limits(text: str, problem: Problem) -> tuple[float, float, float, float]:
    """Return the limits of a map: least x, greatest x, least y, greatest y, in degrees on Earth, else in metres.

    Raise InvalidProblem for invalid limits.
    """
    earth = problem.frame.geodetic and problem.dimension == 3
    advice = "write west,east,south,north in degrees" if earth else "write least x, greatest x, least y, greatest y"
    values = coordinates(text, "--extent", advice)
    if len(values) == 4:
        x0, x1, y0, y1 = values
        # East may exceed 180 degrees, for a map across the date line.
        fits = not earth or (-360.0 <= x0 and x1 <= 540.0 and x1 - x0 <= 360.0 and y0 >= -90.0 and y1 <= 90.0)
        if x0 < x1 and y0 < y1 and fits:
            return x0, x1, y0, y1
    raise InvalidProblem(f"{text!r} is not an extent of a map", "--extent", advice)


def _write_map(found: BoundMap, out: Path, title: str, *, dilution: bool) -> None:
    """Write the map as a picture, GeoJSON or page, by the ending of `out`."""
    from optloc.show.pictures.bound_map import map_geojson, plot_bound_map

    ending = out.suffix.lower()
    if ending in PICTURES:
        write_picture(plot_bound_map(found, title, dilution=dilution), out)
        return
    if dilution:
        raise InvalidProblem("the dilution of precision can only be a picture", str(out), "use .png, .svg or .pdf")
    if ending == ".geojson":
        write_text(out, dumps(map_geojson(found)))
        return
    from optloc.show.maps.bound_page import map_page

    write_text(out, map_page(found, title))


# Status of simulated fixes.


class Simulated(NamedTuple):
    """Options of a simulation of fixes.

    out: map to write; None for one position. at, velocity, geodetic: true position and velocity, as options. height,
    limits: height and extent of the map, as options. trials: number of fixes, None for the default. seed: seed of the
    random numbers.
    """

    out: Path | None
    at: str | None
    height: str | None
    limits: str | None
    velocity: str | None
    trials: int | None
    seed: int
    geodetic: bool


def run_status(file: Path, wanted: Simulated, *, as_json: bool, quiet: bool, more: More = None) -> int:
    """Print the shares of the statuses of simulated fixes, or write their map, and return the exit code."""
    loaded = read(file, values=False, more=more)
    if wanted.out is not None:
        _map_status((file, more), loaded, wanted, wanted.out)
        return 0
    from optloc.solvers.shares import status_shares

    problem = _of_one_epoch(loaded.problem)
    truth = vector(problem, wanted.at, wanted.velocity, wanted.geodetic)
    if wanted.at is None and _has_unknown_position(problem):
        truth = _solve(file, more).reshape(-1, len(truth))[0]
        if not np.isfinite(truth).all():
            raise InvalidProblem("the file has no fix as true position", loaded.source, "give a position with --at")
    found = status_shares(problem, truth, wanted.trials or _TRIALS, wanted.seed)
    if as_json:
        share = dict(zip((one.label for one in found.statuses), found.share, strict=True))
        made = {"file": loaded.source, "trials": found.trials, "seed": wanted.seed, "share": share}
        write_text(Path("-"), dumps(made | {"covered95": found.covered}))
    elif not quiet:
        _show_status(found, loaded.title)
    return 0


def _show_status(found: StatusShares, title: str) -> None:
    """Print the share of each status as a table, and how often the 95 % region of `ok` fixes has the true position."""
    table = Table(title=f"{title}: status of {found.trials} simulated fixes", title_justify="left")
    table.add_column("status")
    for name in ("share, %", "standard error, %"):
        table.add_column(name, justify="right")
    for status, share, error in zip(found.statuses, found.share, found.deviation, strict=True):
        table.add_row(status.label, f"{100.0 * share:.1f}", f"{100.0 * error:.1f}")
    console = Screen()
    console.print(table)
    if np.isfinite(found.covered):
        console.print(
            f"The 95 % region contains the true position in {100.0 * float(found.covered):.1f} % of the ok fixes."
        )


def _map_status(file: tuple[Path, More], loaded: Loaded, wanted: Simulated, out: Path) -> None:
    """Write the map of the share of fixes with the status `ok` to the file `out`; `wanted` has the options."""
    from optloc.show.pictures import plot_status_map, status_geojson
    from optloc.solvers.shares import status_map

    ending = out.suffix.lower()
    if ending not in (*PICTURES, ".geojson"):
        advice = "use .png, .svg, .pdf or .geojson"
        raise InvalidProblem(f"status maps of type {out.suffix or out.name!r} are unknown", str(out), advice)
    claim_outputs(out, inputs=[file[0]])
    problem = _of_one_epoch(loaded.problem)
    truth = vector(problem, wanted.at, wanted.velocity, wanted.geodetic)
    grid, level = _grid(file, problem, wanted.at, truth, wanted.height, wanted.limits, _STATUS_POINTS)
    trials = wanted.trials or _TRIALS_OF_A_MAP
    found = status_map(problem, truth, *grid, level, trials=trials, seed=wanted.seed)
    if ending == ".geojson":
        write_text(out, dumps(status_geojson(found)))
    else:
        write_picture(plot_status_map(found, f"{loaded.title}: share of ok fixes"), out)


# Simulation.


def run_simulate(
    file: Path, truth: str, velocity: str | None, out: Path, *, geodetic: bool, seed: int, trials: int, quiet: bool
) -> int:
    """Simulate measurements, write them as a problem file, and return the exit code.

    `truth` is the true position as text. With several `trials`, each trial becomes an epoch.
    """
    from tempfile import TemporaryDirectory

    from optloc.files.writer import write_measured
    from optloc.linear.evaluate import predict
    from optloc.linear.simulate import simulate

    claim_outputs(out, inputs=[file])
    problem = read(file, values=False).problem
    check_budget("rows", trials * problem.count, "--trials")  # the reader rejects files with more rows
    x = vector(problem, truth, velocity, geodetic)
    # The standard deviation of a level in decibels depends on its value, so the noise is computed at the exact values.
    with TemporaryDirectory() as folder:
        exact, *_ = write_measured(file, Path(folder) / out.name, np.atleast_2d(predict(problem, x)), note="")
        drawn = simulate(read(exact).problem, x, seed, trials)
    z = np.concatenate([rows.z for rows in drawn.rows], axis=-1)
    written = write_measured(file, out, z, note=f"drawn at {truth} with seed {seed}")
    say(Screen(quiet=quiet), f"{trials} trial(s) of {z.shape[-1]} rows are in {', '.join(str(p) for p in written)}.")
    return 0


def vector(problem: Problem, position: str | None, velocity: str | None, geodetic: bool) -> Array:
    """Return the true parameters (size,), SI, for a target position; biases have their prior means, the rest is zero.

    `position` and `velocity` are texts with coordinates; None means zero. With `geodetic`, the position is latitude and
    longitude in degrees, and height. All targets get the same position and velocity.
    """
    if velocity is not None and all(motion.order == 0 for motion in problem.motions):
        what = "the target of this file does not move"
        raise InvalidProblem(what, "--velocity", 'write motion = "constant_velocity" in the file')
    place = None if position is None else np.array(coordinates(position, "position"))
    if geodetic and place is not None:
        if not problem.frame.geodetic or len(place) != 3:
            what = "latitude, longitude and height need a geodetic frame and three numbers"
            raise InvalidProblem(what, "--geodetic", "remove this option")
        place = problem.frame.from_geodetic(np.radians(place[0]), np.radians(place[1]), place[2])[: problem.dimension]
    # All targets get the same position and velocity.
    values = {"position": place, "velocity": None if velocity is None else coordinates(velocity, "--velocity")}
    layout = problem.layout
    # `shared` has the unknowns of all epochs together, `local` the unknowns of each epoch. A slot is the place of an
    # unknown in one of them.
    shared, local = np.zeros(layout.n_shared), np.zeros((problem.epochs, layout.n_local))
    for i, motion in enumerate(problem.motions):
        if motion.known is not None:
            continue
        for name in state_names(i, len(problem.motions), motion.order):
            value = values.get(name.partition("[")[0])
            if value is None:
                continue
            if len(value) != problem.dimension:
                what = f"{len(value)} coordinates do not fit {problem.dimension} dimensions"
                raise InvalidProblem(what, name, "give one number for each dimension")
            slot, is_shared = layout.find(name)
            (shared if is_shared else local)[..., slot.start : slot.start + slot.size] = value
    for bias in problem.biases:
        if bias.sigma is not None:
            slot, is_shared = layout.find(bias.name)
            (shared if is_shared else local)[..., slot.start : slot.start + slot.size] = np.ravel(bias.mean)
    return np.concatenate([shared, local.ravel()])
