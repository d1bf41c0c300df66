"""The command ``optloc track``: track targets through the scans of a file; write tables, pictures and pages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.outputs import is_stream
from optloc.cli.file_fixes import table_json
from optloc.cli.from_table import read_problem
from optloc.cli.options import coordinates
from optloc.cli.output import (
    LOG,
    Screen,
    bar,
    claim_outputs,
    dumps,
    is_csv,
    show_answer,
    uses_standard_output,
    write_picture,
    write_results,
    write_text,
)
from optloc.files.constraint_table import ConstraintTable
from optloc.files.reader import Loaded
from optloc.files.table_import import ColumnHints
from optloc.files.wave_speed import WaveOptions
from optloc.files.writer import GrowingTable
from optloc.problem.problem import Problem
from optloc.show.columns import Columns, covariance_columns, geodetic_columns, join_tables, records
from optloc.show.describe_track import CLEAN, answer_of_scans
from optloc.show.formats.marks import Results
from optloc.tracking.differences import differences
from optloc.tracking.dynamics import Dynamics
from optloc.tracking.entry import Entry, Rules
from optloc.tracking.floor_tracks import track_on_floors
from optloc.tracking.named_models import motion_named
from optloc.tracking.run import tracked
from optloc.tracking.several_targets import alone
from optloc.tracking.track import State
from optloc.tracking.updates import Update, filter_of, reweighted

# Seconds between two additions to the growing table: each addition takes a millisecond, the time of ten scans.
_MIN_GAP = 0.1


@dataclass(frozen=True, slots=True)
class TrackOptions:
    """Options of a track; see the help of the command.

    Parameters
    ----------
    model, filter : str
        Names of the motion model and of the filter.
    noise : float, optional
        Standard deviation of the process noise, SI units.
    memory : float
        Correlation time of an acceleration, s.
    rules : Rules
        Rules for the gate, and for the start and end of tracks.
    start, sigma : str, optional
        Initial state and its standard deviations.
    loss : str, optional
        Loss that weights the rows.
    """

    model: str = "cv"
    filter: str = "iekf"
    noise: float | None = None
    memory: float = 10.0
    rules: Rules = field(default_factory=Rules)
    start: str | None = None
    sigma: str | None = None
    loss: str | None = None


@dataclass(frozen=True, slots=True)
class TargetTrack:
    """The track of one target so far.

    name: name of the target. problem: run of the target. labels: labels of the epochs (k). entries: results of the
    scans until now, at most k.
    """

    name: str
    problem: Problem
    labels: tuple[str, ...]
    entries: list[Entry]

    def since(self, first: int) -> TargetTrack:
        """Return the track from scan number `first` on."""
        return replace(self, labels=self.labels[first : len(self.entries)], entries=self.entries[first:])


def run_track(
    file: Path,
    wanted: TrackOptions,
    *,
    out: Path | None = None,
    as_json: bool = False,
    plot: Path | None = None,
    html: Path | None = None,
    quiet: bool = False,
    table: ColumnHints | WaveOptions | None = None,
    more: Mapping[str, ConstraintTable] | None = None,
) -> int:
    """Track the targets of a file or a table, write the requested files, and return the exit code.

    `wanted` has the options of the tracks, and `more` further constraints by the name of their option. After an error,
    the track so far is written first. A killed run leaves a CSV file next to `out`, with ``.partial`` appended to its
    name. At most the rows of the last tenth of a second are missing.
    """
    dynamics = dynamics_of(wanted)
    # Reject wrong names before reading the file.
    update = filter_of(wanted.filter) if wanted.loss is None else reweighted(wanted.filter, wanted.loss)
    on_output = uses_standard_output(out, html, as_json=as_json)
    loaded = read_problem(file, table, more, quiet=quiet or as_json, on_error=on_output)
    claim_outputs(html, results=(out, loaded.problem.frame), picture=plot, inputs=[file])
    ones = [TargetTrack(*parts, []) for parts in runs_of(loaded)]
    if wanted.start is not None and len(ones) > 1:
        raise InvalidProblem("one initial state does not fit several targets", "--start", "remove this option")
    growing = GrowingTable(out) if out is not None and not is_stream(out) else None
    try:
        with bar(loaded.title, sum(one.problem.epochs for one in ones), quiet or as_json) as advance:
            for one in ones:
                start = _start(one.problem, dynamics, wanted)
                for entry in _entries(one.problem, loaded.floors, dynamics, update, start, wanted.rules):
                    one.entries.append(entry)
                    _append_new_rows(growing, ones, _MIN_GAP)
                    advance(1)
    # After an interrupt or an error, write the results so far.
    finally:
        _append_new_rows(growing, ones)
        columns = (
            join_tables([track_columns(one) for one in ones if one.entries]) if any(o.entries for o in ones) else {}
        )
        if columns:
            _write(loaded, ones, columns, (out, plot, html), growing)
            if as_json:
                write_text(Path("-"), dumps(_json(loaded, columns)))
    if not quiet and not as_json:
        show_answer(answer_of_scans(columns, loaded.title), Screen(stderr=on_output))
    return 0 if set(columns["status"].tolist()) <= CLEAN else 1


def _entries(
    problem: Problem,
    floors: Sequence[float],
    dynamics: Dynamics,
    update: Update,
    start: State | None,
    settings: Rules,
) -> Iterable[Entry]:
    """Return the results of the scans of a run; with `floors`, m, of the track on the floor that fits best."""
    if not floors:
        return tracked(problem, dynamics, update, start=start, rules=settings)
    found = track_on_floors(problem, floors, dynamics, update, start=start, rules=settings)
    LOG.info(
        "the track is at the height %g m; the next best of the stated heights costs %g more", found.height, found.margin
    )
    return found.entries


def _append_new_rows(table: GrowingTable | None, ones: list[TargetTrack], min_gap: float = 0.0) -> None:
    """Append the missing entries to the table, unless the last addition is less than `min_gap` seconds ago.

    `table` has the rows of all targets one after the other; None means that no table is written. `ones` are the tracks.
    """
    if table is None or monotonic() - table.when < min_gap:
        return
    first = table.rows
    for one in ones:
        if len(one.entries) > first:
            table.add(track_columns(one.since(first)))
        first = max(0, first - len(one.entries))


def _json(loaded: Loaded, columns: Columns) -> dict[str, Any]:
    """Return a track as a JSON value."""
    about = {"file": loaded.source, "title": loaded.title, **table_json(loaded)}
    return about | {"scans": records(columns)}


def dynamics_of(wanted: TrackOptions) -> Dynamics:
    """Return the motion model; raise InvalidProblem for an unknown name."""
    return motion_named(wanted.model, wanted.noise, wanted.memory, "--model")


def rules(gate: float, gap: float | None, loss: str | None = None) -> Rules:
    """Return the tracking rules; raise InvalidProblem for a gate or a gap that is not positive.

    `gate` is in standard deviations, and `gap` is the longest time without rows, s. A loss expects gross errors, so the
    starting fixes then use the method `robust`, which finds them too.
    """
    for value, where in ((gate, "--gate"), (gap, "--gap")):
        if value is not None and not value > 0.0:
            raise InvalidProblem(f"{value:g} is not positive", where, "give a positive number")
    return Rules(gate=gate, gap=gap, starts="auto" if loss is None else "robust")


def runs_of(loaded: Loaded) -> Iterator[tuple[str, Problem, tuple[str, ...]]]:
    """Yield name, run and epoch labels of each unknown target of a file, for one track each.

    Raise InvalidProblem for a file that a track cannot use, such as a file with priors or without times.
    """
    problem, source = loaded.problem, loaded.source
    if problem.priors:
        what = f"the file has a prior of {problem.priors[0].name!r}; a track cannot use priors"
        raise InvalidProblem(what, source, "remove the prior, and give --start and --start-sigma")
    if all(motion.known is not None for motion in problem.motions):
        raise InvalidProblem("the motion of each target is known", source, "remove the known positions of a target")
    if problem.epochs > 1 and not np.isfinite(loaded.times).all():
        uses: Mapping[str, str] = loaded.table.get("columns", {})
        column = next((name for name, role in uses.items() if role == "time"), None)
        if column is not None:
            what = f"the unit of the times in column {column!r} is unknown"
            raise InvalidProblem(what, source, "state it with --time-unit, such as --time-unit s")
        raise InvalidProblem("a track needs the time of each epoch", source, "give the measurements a column 'time'")
    # With `own_epochs`, each epoch belongs to one target; otherwise targets share epochs, and rows name their target.
    target_of_row = np.array(loaded.targets)[problem.epoch] if loaded.own_epochs else None
    names = dict.fromkeys(loaded.targets)
    for i, name in enumerate(names):
        if not loaded.own_epochs and problem.motions[i].known is not None:
            continue
        target = np.concatenate([rows.target for rows in problem.rows])
        kept = target_of_row == name if target_of_row is not None else target == i
        epochs = np.unique(problem.epoch[kept])
        again = np.flatnonzero(np.diff(loaded.times[epochs]) <= 0.0)  # epochs are sorted, so a difference is 0 or more
        if len(again):
            one, two = (loaded.epochs[epochs[again[0] + j]] for j in (0, 1))
            what = f"the epochs {one!r} and {two!r} of {name} have the same time"
            raise InvalidProblem(what, source, "correct the times, or give both epochs the same label")
        # A file without times has one epoch, so any time serves.
        times = loaded.times if np.isfinite(loaded.times).all() else problem.times
        run = replace(alone(problem, kept, times), dated=loaded.dated)
        # Arrival times depend on an unknown emission time; their differences do not.
        run = differences(run) if run.emitting else run
        if not run.count:
            what = f"each epoch of {name} has one arrival, which has no information without its emission time"
            raise InvalidProblem(what, source, "give arrivals at two or more stations for each emission")
        yield name, run, tuple(loaded.epochs[k] for k in epochs)


def _start(problem: Problem, dynamics: Dynamics, wanted: TrackOptions) -> State | None:
    """Return the initial state of the options, SI; None without an initial state.

    The state has position, and velocity and acceleration if the model `dynamics` has them.
    """
    if (wanted.start is None) != (wanted.sigma is None):
        lacking = "--start" if wanted.start is None else "--start-sigma"
        raise InvalidProblem("an initial state needs numbers and standard deviations", lacking, "give both or neither")
    if wanted.start is None or wanted.sigma is None:
        return None
    d, parts = problem.dimension, dynamics.order + 1
    mean = np.array(coordinates(wanted.start, "--start", "separate finite numbers by commas"))
    sigma = np.array(coordinates(wanted.sigma, "--start-sigma", "separate finite numbers by commas"))
    if len(mean) != d * parts:
        advice = "give position, and velocity and acceleration if the model has them"
        raise InvalidProblem(f"{len(mean)} numbers for a state of {d * parts}", "--start", advice)
    if len(sigma) != parts or (sigma <= 0.0).any():
        what = f"{wanted.sigma!r} are not standard deviations of {'position velocity acceleration'.split()[:parts]}"
        raise InvalidProblem(what.replace("'", ""), "--start-sigma", f"give {parts} positive numbers")
    # All axes have the same standard deviation, without correlation.
    return State(float(problem.times[0]), mean, np.diag(np.repeat(sigma, d) ** 2))


def track_columns(one: TargetTrack) -> Columns:
    """Return the table of a track: one row for each scan; metres, seconds, degrees; NaN for missing numbers."""
    entries, d = one.entries, one.problem.dimension
    mean = np.stack([e.updated.mean for e in entries])
    cov = np.stack([e.updated.cov for e in entries])
    sigma = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    columns: Columns = {
        "epoch": np.array(one.labels[: len(entries)], dtype=object),
        "time": np.array([e.time for e in entries]),
        "target": np.array([one.name] * len(entries), dtype=object),
        "status": np.array([e.label for e in entries], dtype=object),
        "reason": np.array([e.reason for e in entries], dtype=object),
    }
    names = [f"{letter}{axis}" for letter in ("", "v", "a") for axis in "xyz"[:d]][: mean.shape[-1]]
    columns |= {name: mean[:, i] for i, name in enumerate(names)}
    columns |= {f"sigma_{name}": sigma[:, i] for i, name in enumerate(names)}
    columns |= covariance_columns(cov[:, :d, :d], "xyz")
    columns |= geodetic_columns(one.problem.frame, mean[:, :d], cov[:, :d, :d])
    columns["nis"] = np.array([float(e.updated.nis) for e in entries])
    columns["rows"] = np.array([int(e.updated.count) for e in entries])
    columns["rejected"] = np.array([e.rejected for e in entries])
    return columns


def _map(loaded: Loaded, ones: list[TargetTrack], columns: Columns) -> str:
    """Return an HTML page with the map of the tracks `ones`, whose table is `columns`."""
    from optloc.show.maps.map_marks import scan_spots
    from optloc.show.maps.map_pages import track_page

    pairs = zip(columns["target"].tolist(), columns["epoch"].tolist(), strict=True)
    names = [f"{target} {label}" if len(ones) > 1 else label for target, label in pairs]
    clean = np.isin(columns["status"].astype(str), sorted(CLEAN))
    marks = scan_spots(loaded.problem, columns, names, clean, dated=loaded.dated)
    return track_page(loaded.problem, marks, loaded.title, answer_of_scans(columns, loaded.title))


def _write(
    loaded: Loaded,
    ones: list[TargetTrack],
    columns: Columns,
    paths: tuple[Path | None, Path | None, Path | None],
    table: GrowingTable | None,
) -> None:
    """Write the requested table, picture and page.

    `paths` are the files of the table, the picture and the page. A growing CSV file already has all rows and only gets
    its final name. For another format, the growing file is discarded.
    """
    out, plot, html = paths
    if table is not None and is_csv(table.path):
        table.file.finish()
        LOG.info("wrote %s: %d rows", table.path, table.rows)
    elif out is not None:
        write_results(out, Results(columns, loaded.problem.frame, (), loaded.problem, loaded.title, loaded.dated))
        if table is not None:
            table.file.discard()
    if plot is not None:
        from optloc.show.pictures.track import PlottedTrack, plot_tracks

        drawn = [PlottedTrack(one.name, one.problem, tuple(one.entries)) for one in ones if one.entries]
        write_picture(plot_tracks(drawn, title=loaded.title), plot)
    if html is not None:
        write_text(html, _map(loaded, ones, columns))
