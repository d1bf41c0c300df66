"""Short forms of the values of the core, and the rendering of all short forms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.base.short_form import ShortForm
from optloc.base.types import Array, Status
from optloc.show.answer_texts import finite, with_sigma
from optloc.show.describe_emitters import answer_of_emitters
from optloc.show.fix_answer import FixSheet, Row
from optloc.show.render import html_of_sheet, sheet_lines

if TYPE_CHECKING:
    from optloc.base.frames import Frame
    from optloc.multi_target.answer import Emitters
    from optloc.problem.problem import Problem
    from optloc.show.sheet import Sheet
    from optloc.solvers.posing.posed import Posed
    from optloc.solvers.prepared import Prepared
    from optloc.tracking.track import Track
    from optloc.uncertainty.region import Region

# A short form has at most 15 lines and 1 000 characters: at most 12 rows of about 80 characters.
_ROWS, _LABEL, _LONGEST, _TITLE = 12, 32, 64, 100
# The sentence of a status, in a row without a label, is never cut: it has the advice at its end.
_SENTENCE = 200
# Names in one line; further names are counted.
_NAMES = 4


def text_of_form(form: ShortForm) -> str:
    """Return a short form as text of at most 15 lines and about 1 000 characters."""
    return "\n".join(sheet_lines(_sheet(form)))


def html_of_form(form: ShortForm) -> str:
    """Return a short form as an HTML table; all texts are escaped."""
    return html_of_sheet(_sheet(form))


def _sheet(form: ShortForm) -> FixSheet:
    """Return a short form as a sheet, with long texts cut."""
    rows = [(_cut(label, _LABEL), _cut(text, _LONGEST if label else _SENTENCE)) for label, text in form.rows[:_ROWS]]
    return FixSheet(_cut(form.title, _TITLE), (), [*rows, *([("next", form.following)] if form.following else [])])


def _cut(text: str, most: int = _LONGEST) -> str:
    """Return a text of at most `most` characters; the end of a longer text is replaced by dots."""
    return text if len(text) <= most else f"{text[: most - 3].rstrip()}..."


def listed(names: Sequence[str], most: int = _NAMES) -> str:
    """Return names as text; of many names, the first names and the number of the others."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(map(str, names[:most])) + more


# The functions of the table take a value and return its short form.


def _problem(problem: Problem) -> ShortForm:
    """Return the short form of a problem: rows, stations, unknowns, prior knowledge and frame."""
    shape, stations, span = problem.batch_shape, problem.stations, np.asarray(problem.times)
    kinds = Counter({block.kind: 0 for block in problem.rows})
    for block in problem.rows:
        kinds[block.kind] += block.count
    rows: list[Row] = [("rows", listed([f"{count} {kind}" for kind, count in kinds.items()], 8))]
    absent = int(np.sum(np.asarray(problem.weight) == 0.0)) if not shape else 0
    rows += [("absent rows", str(absent))] if absent else []
    moving = " (moving)" if stations.velocity is not None else ""
    rows.append(("stations", f"{listed(stations.names)}{moving}"))
    if problem.epochs > 1:
        known = finite(span)
        rows.append(("epochs", f"{problem.epochs}" + (f" in {np.ptp(known):.4g} s" if len(known) else "")))
    slots = [(slot, "") for slot in problem.layout.shared] + [(slot, " at each epoch") for slot in problem.layout.local]
    rows.append(("unknowns", listed([f"{slot.size} of {slot.name}{when}" for slot, when in slots], 6) or "none"))
    named: Mapping[str, Sequence[Any]] = {
        "priors": problem.priors,
        "constraints": problem.constraints,
        "fences": problem.fences,
    }
    rows += [(label, listed([each.name for each in found])) for label, found in named.items() if found]
    rows.append(("frame", _frame_text(problem.frame)))
    batch = f"{_times(shape)} problems of " if shape else ""
    size = f"{problem.count} rows, {stations.count} stations, {problem.dimension} dimensions"
    return ShortForm(f"Problem: {batch}{size}", tuple(rows), "optloc.solve(problem), problem.rows, problem.stations")


def _frame_text(frame: Frame) -> str:
    """Return the kind of a frame, with its origin in degrees if it has one."""
    if frame.origin is None:
        return str(frame.kind)
    lat, lon = np.degrees(frame.origin[:2])
    return f"{frame.kind}, origin {lat:.5f}, {lon:.5f} deg, {frame.origin[2]:.1f} m"


def _times(shape: tuple[int, ...]) -> str:
    """Return the shape of a batch as text, such as "100" or "4 x 100"."""
    return " x ".join(map(str, shape))


def status_counts(code: Array) -> str:
    """Return the number of items of each status as text, `ok` first; `code` (...) holds numbers of `Status`."""
    found = Counter(np.ravel(code).tolist())
    order = sorted(found, key=lambda number: (number != Status.OK, -found[number]))
    return listed([f"{found[number]} {Status(int(number)).label}" for number in order])


def _track(track: Track) -> ShortForm:
    """Return the short form of a track: statuses of its scans, the last state, and the size of the innovations."""
    shape, d = track.mean.shape[:-2], track.dimension
    first, last = (float(track.times[0]), float(track.times[-1])) if len(track.times) else (np.nan, np.nan)
    rows: list[Row] = [("status", status_counts(track.code)), ("times", f"{first:.6g} to {last:.6g} s")]
    if not shape and len(track.times):
        sigma = np.sqrt(np.maximum(np.diagonal(track.cov[-1]), 0.0))
        for word, start, unit in (("position", 0, "m"), ("velocity", d, "m/s")):
            pairs = zip(track.mean[-1][start : start + d], sigma[start : start + d], strict=True)
            text = ", ".join(with_sigma(float(value), float(size), unit) for value, size in pairs)
            rows += [(f"last {word}", text)] if text else []
    used = int(track.count.sum())
    nis = f"{np.nansum(track.nis) / used:.2f}" if used else "-"
    rows += [("rows used", str(used)), ("NIS per row", nis)]
    title = f"Track: {_times(shape) + ' targets, ' if shape else ''}{len(track.times)} scans"
    return ShortForm(title, tuple(rows), "track.position, track.velocity, track.cov, track.last")


def _region(region: Region) -> ShortForm:
    """Return the short form of a likelihood region: its extent, and whether it has an end."""
    rows: list[Row] = [("extent", "open: it continues to infinity" if region.open else "closed")]
    box = None if region.open else region.box
    if box is not None:
        sides = [f"{axis} {low:.6g} to {high:.6g} m" for axis, low, high in zip("xyz", *box, strict=False)]
        rows.append(("box", ", ".join(sides)))
    rows += [("least range", f"{region.least_range:.4g} m from the middle of the stations")] if region.open else []
    rows += [("cells", str(len(region.cells.edges)))] if region.cells is not None else [("cells", region.reason)]
    title = f"Region: contains the target with a probability of {region.level:.4g}"
    return ShortForm(title, tuple(rows), "region.covers(points), region.box, region.cone, region.points")


def _posed(posed: Posed) -> ShortForm:
    """Return the short form of a posed problem: formulation, size and changes."""
    rows: list[Row] = [("measurements", f"{posed.stated.count} rows")]
    problem = posed.problem
    if isinstance(problem, Mapping):
        rows.append(("size", f"{problem['x'].numel()} variables, {problem['g'].numel()} constraints (CasADi)"))
    else:
        count = sum(variable.size for variable in problem.variables())
        rows.append(("size", f"{count} variables, {len(problem.constraints)} constraints (cvxpy)"))
    rows.append(("constraints", listed(list(posed.relations)) or "none added"))
    rows.append(("objective", "yours" if posed.own_objective else "of the formulation"))
    following = "posed.add(...), posed.minimise(...), posed.solve(), posed.problem"
    return ShortForm(f"Posed problem {posed.formulation!r}", tuple(rows), following)


def _prepared(prepared: Prepared) -> ShortForm:
    """Return the short form of a prepared problem: method, rows and path."""
    path = "compiled plan" if prepared.plan is not None else "stages of the method"
    rows: list[Row] = [("method", prepared.method), ("path", path)]
    rows += [("batch", _times(prepared.shape))] if prepared.shape else []
    return ShortForm(f"Prepared problem: {prepared.count} rows", tuple(rows), "prepared(z), prepared.problem")


def _emitters(emitters: Emitters) -> ShortForm:
    """Return the short form of separated emitters: status, positions, and rows without an emitter."""
    answer = answer_of_emitters(emitters)
    rows = [*answer.section("use").rows, *answer.section("why not").rows[:2]]
    for sheet in answer.section("where").sheets:
        # The last column is the status, and each row begins with the number of the emitter.
        names = sheet.head[1:-3]
        for row in sheet.rows[:_NAMES]:
            place = ", ".join(f"{name.removesuffix(', m')} {cell}" for name, cell in zip(names, row[1:-3], strict=True))
            rows.append((f"emitter {row[0]}", f"{place}; {row[-1]}"))
    title = f"{emitters.count} emitter{'s' if emitters.count != 1 else ''}"
    return ShortForm(title, tuple(rows), "emitters.fixes, emitters.assignment, emitters.ghosts")


def _table(table: Sheet) -> ShortForm:
    """Return the short form of a table of a report: its columns and its first rows."""
    shown = table.shown
    rows: list[Row] = [("columns", listed(shown.header, 12)), ("rows", str(len(shown.rows)))]
    rows += [(cells[0], ", ".join(cells[1:])) for cells in shown.rows[:_NAMES]]
    return ShortForm(f"Table: {shown.title}", tuple(rows), "sheet.frame, sheet.shown.markdown()")


FORMS: dict[str, Callable[[Any], ShortForm]] = {
    "Problem": _problem,
    "Track": _track,
    "Region": _region,
    "Posed": _posed,
    "Prepared": _prepared,
    "Emitters": _emitters,
    "Sheet": _table,
}
"""Short forms of the values of the core, by the name of the class."""
