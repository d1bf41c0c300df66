"""The command ``optloc place``: choice of sites, gap to the best possible set, effect of each loss, and maps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from optloc.cli import Screen, claim_outputs, dumps, line, say, vector, write_picture, write_text
from optloc.files import is_stream, read
from optloc.problem import InvalidProblem, by_epoch, separable
from optloc.sites.placement import Placement, SiteSelection, picture, place
from optloc.sites.placement.chosen import PRIOR
from optloc.sites.placement.refinement import refined
from optloc.sites.placement.selection_file import (
    LoadedSelection,
    criterion_name,
    is_selection,
    read_selection,
    write_chosen,
)

# Largest number of lines in a table of places or stations, so that the table fits on a screen.
_LINES = 20


@dataclass(frozen=True, slots=True)
class PlaceOptions:
    """Options of the command line that replace settings of the file; None keeps the setting of the file.

    Parameters
    ----------
    choose, budget, criterion, worst, fail_one, gap, seconds
        See `SiteSelection`.
    at : str, optional
        The only place of interest, for instance "1200,800,50".
    rows : bool
        Whether single rows are chosen instead of stations.
    draws : int
        Simulated fixes at each place; 0: no check for ambiguity.
    """

    choose: int | None = None
    budget: float | None = None
    criterion: str | None = None
    worst: bool | None = None
    fail_one: bool | None = None
    gap: float | None = None
    seconds: float | None = None
    at: str | None = None
    rows: bool = False
    draws: int = 0


def run_place(
    file: Path, wanted: PlaceOptions, *, plot: Path | None, out: Path | None, as_json: bool = False, quiet: bool = False
) -> int:
    """Choose sites, print and write the result, and return the exit code.

    The code is 1 if the gap did not close or too many simulated fixes are ambiguous, otherwise 0.
    """
    claim_outputs(out, picture=plot, inputs=[file])
    loaded = read_selection(file) if is_selection(file) else _selection_of_problem(file, wanted)
    selection = _with_options(loaded.selection, wanted)
    with line(quiet or as_json) as tell:

        def report(bound: float, value: float, nodes: int) -> None:
            """Show the progress of the search."""
            tell(f"best {value:.5g}, no set below {bound:.5g}, {nodes} nodes")

        tell("searching")
        found = place(selection, draws=wanted.draws, tell=report)
        if loaded.regions:
            tell("refining")
            found = refined(selection, found, loaded.regions, loaded.ground)
    if out is not None:
        if not loaded.settings or selection.by == "row":
            raise InvalidProblem(
                "only a selection file with a choice of stations can be written as a problem", str(out), "remove --out"
            )
        write_chosen(loaded, (*found.chosen, *found.kept), out, file)
    if plot is not None:
        write_picture(picture(selection, found), plot)
    if as_json:
        write_text(Path("-"), dumps(_record(loaded, selection, found)))
    elif not quiet:
        _show(loaded, selection, found)
        if out is not None and not is_stream(out):
            say(Screen(), f"The chosen stations are in {out}: try optloc crlb {out} --map map.png.")
    return 0 if found.closed and (found.draws is None or found.draws.clean) else 1


def _selection_of_problem(file: Path, wanted: PlaceOptions) -> LoadedSelection:
    """Return the stations of a problem file as candidates, for a target at `--at` or at the fix of the file.

    `wanted` are the options of the command line.
    """
    loaded = read(file, values=False)
    problem = by_epoch(loaded.problem) if separable(loaded.problem) else loaded.problem
    problem = problem.flat().take(np.zeros(1, dtype=int)) if problem.batch_shape else problem
    if wanted.choose is None:
        what = "the file has no table [choice], so the number of stations to take is missing"
        raise InvalidProblem(what, loaded.source, "give -k, such as -k 4")
    if wanted.at is not None:
        places = vector(problem, wanted.at, None, False)[None, : problem.dimension]
    else:
        from optloc.solvers import solve

        places = solve(read(file).problem).position.reshape(-1, problem.dimension)[:1]
        if not np.isfinite(places).all():
            raise InvalidProblem(
                "the file has no fix, so the position of the target is unknown", loaded.source, "give a place with --at"
            )
    return LoadedSelection(SiteSelection(problem, places, choose=wanted.choose), loaded.source, loaded.title, {})


def _with_options(selection: SiteSelection, wanted: PlaceOptions) -> SiteSelection:
    """Return the selection with the options of the command line in place of the settings of the file."""
    given: dict[str, Any] = {
        key: value
        for key in ("choose", "budget", "worst", "fail_one", "gap", "seconds")
        if (value := getattr(wanted, key)) is not None
    }
    if wanted.criterion is not None:
        given["criterion"] = criterion_name(wanted.criterion)
    if wanted.choose is not None and wanted.budget is None:
        given |= {"budget": None, "cost": None}
    if wanted.at is not None:
        place_ = vector(selection.problem, wanted.at, None, False)[None, : selection.problem.dimension]
        given |= {"places": place_, "names": ("here",), "weights": None, "sight": None}
    if wanted.rows:
        given["by"] = "row"
    return replace(selection, **given)


def _names_of(selection: SiteSelection) -> tuple[str, ...]:
    """Return the names of the places; P1, P2 and so on if they have none."""
    count = len(np.atleast_2d(selection.places))
    return selection.names or tuple(f"P{i + 1}" for i in range(count))


def _record(loaded: LoadedSelection, selection: SiteSelection, found: Placement) -> dict[str, Any]:
    """Return the result as a dictionary for JSON output."""
    drawn = found.draws
    return {
        "file": loaded.source,
        "chosen": found.chosen,
        "kept": found.kept,
        "criterion": found.criterion,
        "value": found.value,
        "bound": found.bound,
        "gap": found.gap,
        "closed": found.closed,
        "reason": found.reason,
        "places": [
            {
                "name": name,
                "sigma": sigma,
                "before": before,
                "one_failed": failed,
                "share_of_prior": share,
                "spare": spare,
            }
            for name, sigma, before, failed, share, spare in zip(
                _names_of(selection),
                found.per_place,
                found.before,
                found.failed,
                found.share_of_prior,
                found.redundancy,
                strict=True,
            )
        ],
        "before": found.before_sites,
        "losses": [
            {"name": s.name, "value": s.value, "replacement": s.replacement, "replaced": s.replaced}
            for s in found.swaps
        ],
        "next": [{"name": name, "value": value} for name, value in found.following],
        "alternatives": [{"chosen": names, "value": value} for names, value in found.alternatives],
        "draws": None
        if drawn is None
        else {
            "count": drawn.count,
            "ambiguous": drawn.ambiguous,
            "rms_over_bound": drawn.ratio,
            "coverage": drawn.coverage,
            "clean": drawn.clean,
        },
        "banned": found.banned,
        "refined": None if found.refined is None else {"position": found.refined, "value": found.refined_value},
        "nodes": found.nodes,
    }


def _show(loaded: LoadedSelection, selection: SiteSelection, found: Placement) -> None:
    """Print the chosen sites, both tables and the remarks."""
    console = Screen()
    sure = "" if found.closed else " (not closed)"
    say(console, f"{loaded.title}: take {', '.join(found.chosen) or 'nothing'}.")
    words = {"rms": "mean bound", "volume": "mean axis of the ellipsoid", "axis": "longest axis of the ellipsoid"}
    none = "no choice that is not rejected" if found.banned else "no choice"
    least = f"{words[found.criterion]} {found.sigma:.4g} m, {none} below {np.sqrt(max(found.bound, 0.0)):.4g} m"
    say(console, f"{least[0].upper()}{least[1:]}{sure}: {found.reason}.")
    console.print(_places_table(selection, found))
    console.print(_losses_table(found))
    for text in _remarks(selection, found):
        say(console, text)


def _places_table(selection: SiteSelection, found: Placement) -> Table:
    """Return the table of the bounds at the places, largest bound first."""
    before = "kept stations" if set(found.before_sites) == set(found.kept) else "random set"
    table = Table(title="Bound of the position error, m", title_justify="left")
    for heading in ("place", f"before ({before})", "after", "one failed", "spare rows"):
        table.add_column(heading, justify="left" if heading == "place" else "right")
    order = np.argsort(-found.per_place, kind="stable")[:_LINES]
    names = _names_of(selection)
    for i in order:
        values = (found.before[i], found.per_place[i], found.failed[i])
        table.add_row(names[i], *(f"{v:.4g}" for v in values), str(found.redundancy[i]))
    if len(names) > _LINES:
        table.add_row("...", "", f"{len(names) - _LINES} better", "", "")
    return table


def _losses_table(found: Placement) -> Table:
    """Return the table of the bounds after the loss of each station."""
    table = Table(title="Bound after the loss of a station, m", title_justify="left")
    for heading in ("station", "without it", "best replacement", "with replacement"):
        table.add_column(heading, justify="left" if heading in ("station", "best replacement") else "right")
    for swap in found.swaps[:_LINES]:
        then = f"{np.sqrt(swap.replaced):.4g}" if swap.replacement else ""
        table.add_row(swap.name, f"{np.sqrt(swap.value):.4g}", swap.replacement or "none allowed", then)
    return table


def _remarks(selection: SiteSelection, found: Placement) -> list[str]:
    """Return sentences about weak places, the next station, simulated fixes and the refinement, for the user."""
    names, out = _names_of(selection), []
    weak = [names[i] for i in np.flatnonzero(found.share_of_prior > PRIOR)]
    if weak:
        out.append(f"The stations do not determine the position, only the prior does: {', '.join(weak)}.")
    bare = [names[i] for i in np.flatnonzero(found.redundancy <= 0)]
    if bare:
        out.append(f"Without a spare row, a wrong measurement is not detected: {', '.join(bare)}.")
    if found.following:
        name, value = found.following[0]
        out.append(f"The best station to add next is {name}: {np.sqrt(value):.4g} m.")
    if found.draws is not None:
        share = 100 * found.draws.ambiguous.mean()
        worst = names[int(found.draws.ambiguous.argmax())]
        text = f"{share:.2g} % of simulated fixes are ambiguous, most at {worst}"
        out.append(text + ("." if found.draws.clean else "; add a height, a constraint or a station off the plane."))
        coverage = np.nanmean(found.draws.coverage) if np.isfinite(found.draws.coverage).any() else np.nan
        out.append(f"For {100 * coverage:.3g} % of the other fixes, the 95 % ellipse contains the place.")
    if found.banned:
        out.append(
            f"Better sets were rejected because their fixes are ambiguous: {'; '.join(map(', '.join, found.banned))}."
        )
    if found.refined is not None:
        spots = "; ".join(", ".join(f"{v:.1f}" for v in row) for row in found.refined)
        out.append(f"The refinement reaches {np.sqrt(found.refined_value):.4g} m, a local optimum, at {spots}.")
    return out
