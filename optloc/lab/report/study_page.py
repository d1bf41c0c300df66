"""Report of a study: the HTML page, its tables and its figures, made from the output folder.

A section of the page shows the figures of one subject, and folded tables below them. Maps show the bound of the
position error for cases whose stations are the same in all trials.
"""

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
from optloc.lab.study.folder import StudyManifest, read_frame, read_manifest, references
from optloc.lab.study.networks import NetworkCase
from optloc.lab.study.problem_copies import design_of_manifest
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
class BoundMapOfCase:
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


def scenario_maps(design: StudyDesign, frame: pd.DataFrame) -> Iterator[BoundMapOfCase]:
    """Yield the map of each case whose stations are the same in all trials, at its first noise level.

    `frame` are the judged rows. Cases for which the bound has no map are left out.
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


def _scenario_map(title: str, case: Case, rows: pd.DataFrame) -> BoundMapOfCase:
    """Return the map of a case at one noise level, with the true positions of its trials."""
    # The stations are fixed, so the stations of one trial are the stations of all trials.
    trial = draw(case, 0, 1)
    problem, d = trial.problem.take(np.zeros(1, dtype=int)), trial.problem.dimension
    per_trial = rows.groupby("trial", sort=True).agg(
        off=("wrong", "any"), x=("truth_x", "first"), y=("truth_y", "first"), z=("truth_z", "first")
    )
    position = per_trial[["x", "y", "z"]].to_numpy(dtype=float)[:_MOST_DOTS, :d]
    earth = problem.frame.geodetic and d == 3
    map_position = map_coordinates(problem.frame, position, earth)
    # Height of the middle trial, rounded to metres because the page prints it.
    height = float(np.round(np.median(map_position[:, 2]))) if d == 3 and len(map_position) else 0.0
    west, east, south, north = extent(problem, position, widen=_MARGIN)
    bounds = bound_map(
        problem, trial.truth[0], np.linspace(west, east, _POINTS), np.linspace(south, north, _POINTS), height
    )
    # Trials in which some method was wrong but ok.
    off = per_trial["off"].to_numpy(dtype=bool)[:_MOST_DOTS]
    return BoundMapOfCase(f"{title}, {noise_text(case.label)}", bounds, map_position[:, :2], off)


Tell = Callable[[str], None]
"""Function that is called with the name of each step of the report, to show progress."""

# Pixels of an inch in PNG files: a figure of 5.2 inches has 1040, enough for screens of twice the usual density.
_DPI = 200


@dataclass(frozen=True, slots=True)
class _StudyContent:
    """Content of a report.

    `frame` are all judged rows, and `cells` their statistics (`summary.cells`). `looks` are the colours and marks of
    the methods by name, `sheets` the tables by name, `places` the maps. `profiles` leaves out methods that start at the
    truth; it is None if no trial has a fix.
    """

    manifest: StudyManifest
    frame: pd.DataFrame
    cells: pd.DataFrame
    looks: dict[str, Look]
    sheets: dict[str, Sheet]
    places: list[BoundMapOfCase]
    profiles: Profiles | None


@dataclass(frozen=True, slots=True)
class _Section:
    """Section of the page: figures of one subject, and the text above them.

    `name` is the anchor of the section in the page, and `make` makes the figures. `lines` is True if the figures show
    the methods as lines or marks, and so need a legend in files. `wide` is True for figures of the full width. `tables`
    are the names of the folded tables.
    """

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
    tell_step = tell or (lambda _: None)
    tell_step("reading")
    content = _study_content(folder)
    make_folder(target_folder)
    claim(target)
    with replace_together():
        files = [
            _table_file(target_folder, sheet, ending) for sheet in content.sheets.values() for ending in ("csv", "tex")
        ]
        parts = [PagePart("ranking", "Ranking", tables=[content.sheets["ranking"]])]
        for section in _SECTIONS:
            tell_step(section.title.lower())
            pictures = section.make(content)
            if pictures:
                parts.append(_part(section, content, pictures))
                files += [
                    path for picture in pictures for path in _figure_files(target_folder, picture, legend=section.lines)
                ]
        if content.places:
            tell_step("maps")
            part, map_files = _maps(target_folder, content)
            parts.append(part)
            files += map_files
        source = content.manifest.text
        origin = "Machine, versions and study file"
        parts.append(PagePart("made", origin, tables=[content.sheets["machine"]], source=source))
        write_text(target, _page(content, parts))
    return [target, *files]


def _study_content(folder: Path) -> _StudyContent:
    """Return the content of the report from the output folder; raise InvalidProblem without a finished part."""
    manifest = read_manifest(folder)
    rows = read_frame(folder, [*summary.COLUMNS])
    if not len(rows):
        advice = "wait for the first part, or run the study"
        raise InvalidProblem("the study has no finished part yet", str(folder), advice)
    frame = summary.judged(rows)
    # Best first: the order of tables, legends and colours.
    order, cells = summary.methods(frame), summary.cells(frame)
    design = design_of_manifest(manifest, folder)
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


def _page(content: _StudyContent, parts: list[PagePart]) -> str:
    """Return the HTML page of the report."""
    manifest, rows = content.manifest, len(content.frame)
    state = (
        "complete"
        if rows == manifest.rows
        else f"{rows} of {manifest.rows} rows: not finished, so the results may change"
    )
    trials = content.frame[["data", "trial"]].drop_duplicates()
    facts = (
        f"{rows} fixes of {len(trials)} trials by {len(content.looks)} methods ({state}). optloc {manifest.version}, "
        f"started {manifest.created[:10]}, seed {manifest.seed}, {manifest.machine}."
    )
    opening = [manifest.note] if manifest.note else []
    return write_page(
        manifest.title or manifest.name, parts, opening=opening, facts=facts, methods=content.looks.values()
    )


def _part(section: _Section, content: _StudyContent, pictures: list[Picture]) -> PagePart:
    """Return a section of the page with its drawings and its folded tables; `pictures` are the figures."""
    folded = [content.sheets[name] for name in section.tables]
    # Draw before the files are written: the files get a legend inside the figure, the page does not.
    drawings = [inline(picture) for picture in pictures]
    return PagePart(section.name, section.title, section.text, drawings=drawings, wide=section.wide, folded=folded)


def _figure_files(folder: Path, picture: Picture, *, legend: bool) -> list[Path]:
    """Write a picture as PNG and SVG into the folder of the report, and return the paths.

    With `legend`, draw a legend of the methods into the figure first. The legend changes the figure, so the page's copy
    must be drawn before.
    """
    figure = picture.figure
    if legend:
        with_legend(figure)
    paths = [folder / "figures" / f"{picture.name}.{ending}" for ending in ("png", "svg")]
    make_folder(paths[0].parent)
    write_text(paths[1], svg_text(figure))
    with written(paths[0]) as file:
        figure.savefig(file, dpi=_DPI)
    return paths


def _table_file(folder: Path, sheet: Sheet, ending: str) -> Path:
    """Write a table as .csv or .tex (`ending`) into the folder of the report, and return its path."""
    path = folder / "tables" / f"{sheet.shown.name}.{ending}"
    make_folder(path.parent)
    if ending != "csv":
        write_text(path, latex(sheet.shown, sheet.words))
        return path
    frame = sheet.frame.assign(**{str(name): harmless_column(cells) for name, cells in sheet.frame.items()})
    with written(path) as file:
        frame.to_csv(file, index=False, lineterminator="\n")
    return path


def _maps(folder: Path, content: _StudyContent) -> tuple[PagePart, list[Path]]:
    """Return the section of maps and the files of its pictures; maps of places on Earth can be moved and zoomed."""
    text = (
        "Bound of the position error (root of its trace) for a target at each point of the map, at the height of the "
        "middle trial. On interactive maps, dots are true positions. Where a method was wrong but ok, the dot is "
        "orange; the others are blue."
    )
    maps: list[Canvas | Drawing] = []
    files = []
    for i, case in enumerate(content.places):
        name = f"map-{i + 1}"
        picture = Picture(name, f"Bound: {case.title}", plot_bound_map(case.found, case.title))
        trials = (case.truths, case.off)
        maps.append(map_element(case.found, name, case.title, trials) if case.found.geodetic else inline(picture))
        files += _figure_files(folder, picture, legend=False)
    return PagePart("maps", "Maps of the bound", text, maps=maps, headings=True), files


def _cell_pictures(make: Callable[..., object], content: _StudyContent) -> list[Picture]:
    """Return the pictures that `make` draws from the cells of the study."""
    return list(make(content.cells, content.looks))  # type: ignore[call-overload,no-any-return]


def _row_pictures(make: Callable[..., object], content: _StudyContent) -> list[Picture]:
    """Return the pictures that `make` draws from the judged rows of the study."""
    return list(make(content.frame, content.looks))  # type: ignore[call-overload,no-any-return]


def _profile_pictures(content: _StudyContent) -> list[Picture]:
    """Return the pictures of the data profile and of the performance profile; empty without profiles."""
    return [] if content.profiles is None else list(drawn.profiles(content.profiles, content.looks))


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
