"""Report of a study: the HTML page, its tables and its figures, made from the output folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optloc.bounds import BoundMap, bound_map, extent, map_coordinates
from optloc.files import claim, harmless_column, make_folder, replace_together, write_text, written
from optloc.lab.report import figures as drawn
from optloc.lab.report.sheets import latex, sheets
from optloc.lab.study import summary
from optloc.lab.study.design import StudyDesign
from optloc.lab.study.folder import StudyManifest, design_of_manifest, read_frame, read_manifest, references
from optloc.lab.study.networks import NetworkCase
from optloc.lab.study.profiles import Profiles, profiles
from optloc.lab.study.simulation import Case, draw
from optloc.lab.study.summary import case_label, noise_text
from optloc.problem import Array, InvalidProblem
from optloc.show import (
    Canvas,
    Drawing,
    Look,
    PagePart,
    Picture,
    Sheet,
    figure_class,
    inline,
    map_element,
    marks,
    plot_bound_map,
    svg_text,
    with_legend,
    write_page,
)

if TYPE_CHECKING:
    import pandas as pd


# Maps of the bound for scenarios whose stations are the same in all trials.

# Points of a map along each axis: 4096 bounds take a fraction of a second, and isolines are smooth.
_POINTS = 64
# Most maps of a report, and most trials of a map; more dots would cover one another.
_MOST_MAPS, _MOST_DOTS = 8, 400
# Margin of a map around stations and true positions, as a share of the longer side.
_MARGIN = 0.2


@dataclass(frozen=True, slots=True)
class Place:
    """Map of the bound of a case.

    Parameters
    ----------
    title : str
        Case and noise level.
    found : BoundMap
        The bound at the points of the map.
    truths : array (n, 2)
        True positions of trials, as x and y of the map.
    off : bool array (n,)
        Whether some method was wrong but ok in the trial: its status is ok, and a lower cost is known.
    """

    title: str
    found: BoundMap
    truths: Array
    off: Array


def scenario_maps(design: StudyDesign, frame: pd.DataFrame) -> Iterator[Place]:
    """Yield the map of each case whose stations are the same in all trials, at its first noise level.

    Cases for which the bound has no map are left out.
    """
    first: dict[str, Case | NetworkCase] = {}
    for cell in design.cells:
        first.setdefault(case_label(cell.case.table.name, cell.case.sweep), cell.case)
    for title, case in list(first.items())[:_MOST_MAPS]:
        if isinstance(case, NetworkCase):
            continue
        layout = case.table.layout
        if layout is not None and (layout.placement == "random" or layout.survey is not None):
            continue
        rows = frame[(frame["case"] == title) & (frame["noise_label"] == case.label)]
        try:
            yield _scenario_map(title, case, rows)
        except InvalidProblem:
            continue


def _scenario_map(title: str, case: Case, rows: pd.DataFrame) -> Place:
    """Return the map of a case at one noise level, with the true positions of its trials."""
    # The stations are fixed, so the stations of one trial serve all trials.
    one = draw(case, 0, 1)
    problem, d = one.problem.take(np.zeros(1, dtype=int)), one.problem.dimension
    per_trial = rows.groupby("trial", sort=True).agg(
        off=("wrong", "any"), x=("truth_x", "first"), y=("truth_y", "first"), z=("truth_z", "first")
    )
    position = per_trial[["x", "y", "z"]].to_numpy(dtype=float)[:_MOST_DOTS, :d]
    earth = problem.frame.geodetic and d == 3
    plain = map_coordinates(problem.frame, position, earth)
    # Height of the middle trial, rounded to metres because the page prints it.
    height = float(np.round(np.median(plain[:, 2]))) if d == 3 and len(plain) else 0.0
    west, east, south, north = extent(problem, position, widen=_MARGIN)
    found = bound_map(
        problem, one.truth[0], np.linspace(west, east, _POINTS), np.linspace(south, north, _POINTS), height
    )
    off = per_trial["off"].to_numpy(dtype=bool)[:_MOST_DOTS]
    return Place(f"{title}, {noise_text(case.label)}", found, plain[:, :2], off)


Tell = Callable[[str], None]
"""Called with the name of each step of the report."""

# Pixels of an inch in PNG files: a figure of 5.2 inches has 1040, enough for screens of twice the usual density.
_DPI = 200


@dataclass(frozen=True, slots=True)
class _StudyContent:
    """Content of a report. `profiles` leaves out methods that start at the truth; it is None if no trial has a fix."""

    manifest: StudyManifest
    frame: pd.DataFrame
    cells: pd.DataFrame
    looks: dict[str, Look]
    sheets: dict[str, Sheet]
    places: list[Place]
    profiles: Profiles | None


@dataclass(frozen=True, slots=True)
class _Section:
    """Section of the page: figures of one subject, and the text above them."""

    name: str
    title: str
    text: str
    make: Callable[[_StudyContent], list[Picture]]
    lines: bool = True
    wide: bool = False
    tables: tuple[str, ...] = ()


def write_report(folder: Path, out: Path | None = None, tell: Tell | None = None) -> list[Path]:
    """Write the report of the finished parts of a study.

    Parameters
    ----------
    folder : Path
        Output folder of a study.
    out : Path, optional
        Folder of ``report.html``, ``tables`` and ``figures``; by default ``report`` in the folder of the study.
    tell : callable, optional
        Called with the name of each step.

    Returns
    -------
    list of Path
        The files, the page first.

    Raises
    ------
    InvalidProblem
        If the folder has no study or no finished part, matplotlib is missing, or a file cannot be written.
    """
    figure_class()
    target_folder = folder / "report" if out is None else out
    target = target_folder / "report.html"
    say = tell or (lambda _: None)
    say("reading")
    found = _study_content(folder)
    make_folder(target_folder)
    claim(target)
    with replace_together():
        files = [
            _table_file(target_folder, sheet, ending) for sheet in found.sheets.values() for ending in ("csv", "tex")
        ]
        parts = [PagePart("ranking", "Ranking", tables=[found.sheets["ranking"]])]
        for section in _SECTIONS:
            say(section.title.lower())
            pictures = section.make(found)
            if pictures:
                parts.append(_part(section, found, pictures))
                files += [path for one in pictures for path in _figure_files(target_folder, one, legend=section.lines)]
        if found.places:
            say("maps")
            part, more = _maps(target_folder, found)
            parts.append(part)
            files += more
        source = found.manifest.text
        origin = "Machine, versions and study file"
        parts.append(PagePart("made", origin, tables=[found.sheets["machine"]], source=source))
        write_text(target, _page(found, parts))
    return [target, *files]


def _study_content(folder: Path) -> _StudyContent:
    """Return the content of the report from the output folder of a study."""
    manifest = read_manifest(folder)
    rows = read_frame(folder, [*summary.COLUMNS])
    if not len(rows):
        advice = "wait for the first part, or run the study"
        raise InvalidProblem("the study has no finished part yet", str(folder), advice)
    frame = summary.judged(rows)
    # Best first: the order of tables, legends and colours.
    order, cells = summary.methods(frame), summary.cells(frame)
    design = design_of_manifest(manifest)
    references_of_design = references(design)
    # Methods that know the truth are not ranked, unless the study has no others.
    rivals = frame[~frame["method"].isin(references_of_design)]
    rivals = rivals if len(rivals) else frame
    # If every trial failed, there are no times and no profiles.
    timed = frame["processor"].notna().any()
    profiled = profiles(rivals) if timed else None
    tables = {sheet.shown.name: sheet for sheet in sheets(frame, rivals, cells, order, profiled)}
    places = [] if design is None else list(scenario_maps(design, frame))
    return _StudyContent(manifest, frame, cells, marks(order), tables, places, profiled)


def _page(found: _StudyContent, parts: list[PagePart]) -> str:
    """Return the HTML page of the report."""
    m, rows = found.manifest, len(found.frame)
    state = "complete" if rows == m.rows else f"{rows} of {m.rows} rows: not finished, so the results may change"
    trials = found.frame[["data", "trial"]].drop_duplicates()
    facts = (
        f"{rows} fixes of {len(trials)} trials by {len(found.looks)} methods ({state}). optloc {m.version}, started "
        f"{m.created[:10]}, seed {m.seed}, {m.machine}."
    )
    opening = [m.note] if m.note else []
    return write_page(m.title or m.name, parts, opening=opening, facts=facts, methods=found.looks.values())


def _part(section: _Section, found: _StudyContent, pictures: list[Picture]) -> PagePart:
    """Return a section of the page with its drawings and its folded tables."""
    folded = [found.sheets[name] for name in section.tables]
    # Draw before the files are written: the files get a legend inside the figure, the page does not.
    drawings = [inline(picture) for picture in pictures]
    return PagePart(section.name, section.title, section.text, drawings=drawings, wide=section.wide, folded=folded)


def _figure_files(place: Path, picture: Picture, *, legend: bool) -> list[Path]:
    """Write a picture as PNG and SVG; with `legend`, draw a legend of the methods into the figure first.

    The legend changes the figure, so the page's copy must be drawn before.
    """
    figure = picture.figure
    if legend:
        with_legend(figure)
    paths = [place / "figures" / f"{picture.name}.{ending}" for ending in ("png", "svg")]
    make_folder(paths[0].parent)
    write_text(paths[1], svg_text(figure))
    with written(paths[0]) as file:
        figure.savefig(file, dpi=_DPI)
    return paths


def _table_file(place: Path, sheet: Sheet, ending: str) -> Path:
    """Write a table as .csv or .tex, and return its path."""
    path = place / "tables" / f"{sheet.shown.name}.{ending}"
    make_folder(path.parent)
    if ending != "csv":
        write_text(path, latex(sheet.shown, sheet.words))
        return path
    frame = sheet.frame.assign(**{str(name): harmless_column(cells) for name, cells in sheet.frame.items()})
    with written(path) as file:
        frame.to_csv(file, index=False, lineterminator="\n")
    return path


def _maps(place: Path, found: _StudyContent) -> tuple[PagePart, list[Path]]:
    """Return the section of maps and the files of its pictures; maps of places on Earth can be moved and zoomed."""
    text = (
        "Bound of the position error (root of its trace) for a target at each point of the map, at the height of the "
        "middle trial. On interactive maps, dots are true positions. Where a method was wrong but ok, the dot is "
        "orange; the others are blue."
    )
    maps: list[Canvas | Drawing] = []
    files = []
    for i, one in enumerate(found.places):
        name = f"map-{i + 1}"
        picture = Picture(name, f"Bound: {one.title}", plot_bound_map(one.found, one.title))
        trials = (one.truths, one.off)
        maps.append(map_element(one.found, name, one.title, trials) if one.found.geodetic else inline(picture))
        files += _figure_files(place, picture, legend=False)
    return PagePart("maps", "Maps of the bound", text, maps=maps, headings=True), files


def _cell_pictures(make: Callable[..., object], found: _StudyContent) -> list[Picture]:
    """Return pictures of the cells of the study."""
    return list(make(found.cells, found.looks))  # type: ignore[call-overload,no-any-return]


def _row_pictures(make: Callable[..., object], found: _StudyContent) -> list[Picture]:
    """Return pictures of the rows of the study."""
    return list(make(found.frame, found.looks))  # type: ignore[call-overload,no-any-return]


def _profile_pictures(found: _StudyContent) -> list[Picture]:
    """Return the pictures of both profiles; empty without profiles."""
    return [] if found.profiles is None else list(drawn.profiles(found.profiles, found.looks))


_SECTIONS = (
    _Section(
        "success",
        "Right answers",
        "Right: the method claims an answer, and no lower cost is known for the same data. Bars are 95 % intervals.",
        partial(_cell_pictures, drawn.success),
        lines=False,
        tables=("success", "statuses"),
    ),
    _Section(
        "accuracy",
        "Error over the bound, against noise",
        "Root mean square error of the answers, divided by the Cramer-Rao bound at the truth. Bars are 95 % "
        "intervals. A single gross error can lift a point far, so look at the distributions too.",
        partial(_cell_pictures, drawn.accuracy),
        tables=("accuracy",),
    ),
    _Section(
        "errors",
        "Distribution of errors",
        "Share of trials whose error, in units of the bound, is at most the value on the axis. A curve ends at the "
        "share of trials with an answer. The broad grey curve belongs to an efficient estimate.",
        partial(_row_pictures, drawn.distributions),
    ),
    _Section(
        "gaps",
        "Cost above the best known",
        "Share of trials whose cost exceeds the lowest known cost, of any method or of the truth, by at most the value "
        "on the axis. Positions without refinement count too, so the figure shows how tight a relaxation is. Less than "
        "a millionth is drawn at a millionth.",
        partial(_row_pictures, drawn.gaps),
        tables=("certificates",),
    ),
    _Section(
        "profile",
        "Data and performance profiles",
        "Share of trials that a method solves: within a given processor time (Moré and Wild 2009), or within a "
        "multiple of the time of the trial's fastest method (Dolan and Moré 2002). Solved: the cost exceeds the least "
        "known cost by at most a thousandth; the status does not matter. If a call makes many fixes, each trial gets "
        "their mean time. Methods that start at the truth are left out.",
        _profile_pictures,
        tables=("profiles",),
    ),
    _Section(
        "time",
        "Time against size",
        "Median time of a fix; bars reach from the 10th to the 90th percentile. Points of one size are drawn side by "
        "side.",
        partial(_row_pictures, drawn.timing),
        tables=("timing",),
    ),
)
