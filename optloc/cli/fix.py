"""The command ``optloc fix``: fixes of a file as a table, with misfits, possible causes and advice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from rich.console import Console
from rich.table import Table

from optloc.advice.advising import advise, advise_at
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.outputs import claim, replace_together
from optloc.base.types import Array, Status
from optloc.cli.file_fixes import (
    FileFixes,
    answer_of_file,
    fix_file,
    fixes_json,
    results_of,
)
from optloc.cli.from_table import read_problem
from optloc.cli.output import (
    Screen,
    claim_outputs,
    dumps,
    say,
    say_all,
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
from optloc.model_checks.cause import Advice
from optloc.model_checks.elements import GROUPINGS, By, batch_of
from optloc.model_checks.noise_level import SEVERAL, CommonLevel, LateSignals, common_level_at, late_signals_at
from optloc.model_checks.plausibility import CHECKS
from optloc.model_checks.single_error import explained_at
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.show.answer_texts import as_p, with_sigma
from optloc.show.columns import Columns, records
from optloc.show.fix_answer import advice_lines
from optloc.show.formats.marks import geojson
from optloc.solvers.policy import P_MISFIT
from optloc.station_health.levels import (
    NoiseLevels,
    common_level,
    late_signals,
)
from optloc.station_health.structure import with_estimated_noise

# Largest number of lines of a list on a screen. The remaining lines are counted; --json and --out have all lines.
_STATES = 12


def run_fix(
    file: Path,
    method: str,
    more: Mapping[str, ConstraintTable],
    *,
    as_json: bool = False,
    geojson_path: Path | None = None,
    plot: Path | None = None,
    out: Path | None = None,
    html: Path | None = None,
    quiet: bool = False,
    noise: str | None = None,
    rescale: bool = False,
    late: bool = False,
    explain: bool = False,
    allow: tuple[Status, ...] = (),
    table: ColumnHints | WaveOptions | None = None,
) -> int:
    """Fix a problem file or a table under more constraints, write and print the result, and return the exit code.

    `more` has the constraints by the name of their option. `as_json` prints JSON, and `quiet` prints nothing. `out`,
    `geojson_path`, `plot` and `html` are the files to write: results, GeoJSON, picture and page; None for no file.
    `allow` has the statuses that give exit code 0 as well as ok. `table` has the column hints of a table, or the
    options on the wave of a problem file. Four options estimate the noise and the causes of misfits. `noise` is the
    grouping of `--noise-from-data`, and None leaves the noise as stated. `rescale` applies one common factor to it.
    `late` fixes with a loss for late rows, and `explain` fixes again with the most likely systematic error.
    """
    on_output = uses_standard_output(out, geojson_path, html, as_json=as_json)
    claim(out, geojson_path, html, plot, inputs=[file])  # before a long table is read
    read = read_problem(file, table, more, quiet=quiet or as_json, on_error=on_output)
    claim_outputs(geojson_path, html, results=(out, read.problem.frame), picture=plot, inputs=[file])
    loaded = _estimate_noise(read, noise)
    rescaled = _common_level(loaded.problem) if rescale else None
    loaded = loaded if rescaled is None else replace(loaded, problem=rescaled.scale(loaded.problem))
    signals = late_signals(loaded.problem) if late else None
    found = fix_file(loaded, signals.method if signals is not None and signals.share else method, quiet or as_json)
    # The table of results has a row for each epoch and target. Add the late rows only if each fix is one row.
    if signals is not None and len(signals.late) == len(found.columns["x"]):
        found.columns.update(late_rows=signals.late, on_late_rows=signals.carried)
    levels = found.loaded.levels
    # the search for causes takes time, so do it only if the result is read by people
    silent = quiet and not as_json
    advice = () if silent and html is None else advice_for_fixes(found)
    _write(found, out, geojson_path, plot, html, advice)
    if silent:
        return 0 if found.passes(allow) else 1
    level, signals = rescaled or _level_of(found), signals or _late_of(found)
    used = rescaled is not None or bool(np.any(found.fix.has(Status.RESCALED)))
    other = _explain(found, method) if explain else None
    if as_json:
        noise_found: dict[str, Any] = {} if levels is None else {"noise": _levels_json(levels)}
        noise_found |= {} if level is None else {"noise_level": level_json(level, used)}
        noise_found |= {"explained": explained_json(found, other)} if explain else {}
        noise_found |= {} if signals is None else {"late_signals": late_json(signals, late)}
        write_text(Path("-"), dumps(fixes_json(found) | {"advice": advice_json(advice)} | noise_found))
    else:
        console = Screen(stderr=on_output)
        show(found, console, advice)
        if explain:
            _show_explained(found, other, console)
        if level is not None or signals is not None:
            say_all(console, tell_level(level, used, signals, late))
        if levels is not None:
            _show_levels(levels, console)
    return 0 if found.passes(allow) else 1


def _write(
    found: FileFixes,
    out: Path | None,
    geojson_path: Path | None,
    plot: Path | None,
    html: Path | None,
    advice: tuple[Advice, ...],
) -> None:
    """Write the requested files: all of them, or none if one fails; `advice` is part of the page `html`."""
    with replace_together():
        if out is not None:
            write_results(out, results_of(found))
        if geojson_path is not None:
            write_text(geojson_path, dumps(geojson(results_of(found))))
        if plot is not None:
            draw(found, plot)
        if html is not None:
            from optloc.show.maps.map_pages import fix_page
            from optloc.show.page import LISTED

            marks = results_of(found).marks()
            labels = [mark.name for mark in marks]
            named: dict[str, Any] = {"times": [mark.time for mark in marks], "dated": found.loaded.dated}
            named["targets"] = [mark.target for mark in marks]
            problem, title = found.loaded.problem, found.loaded.title
            answer = answer_of_file(found, advice, LISTED)
            page = fix_page(problem, (found.fix,), title, labels, **named, answer=answer)
            write_text(html, page)


def draw(found: FileFixes, path: Path) -> None:
    """Draw fixes to a picture file; raise InvalidProblem if that fails."""
    from optloc.show.pictures import plot_fixes

    write_picture(plot_fixes(found.loaded.problem, (found.fix,), title=found.loaded.title), path)


def show(found: FileFixes, console: Console, advice: tuple[Advice, ...] = ()) -> None:
    """Print the answer of the fixes of a file, and the errors that the search for suspects would not notice."""
    show_answer(answer_of_file(found, advice), console)
    if len(found.columns["x"]) == 1 or not found.apart:
        _show_unnoticed(found, found.fix[0] if found.apart else found.fix, console)


def _show_unnoticed(found: FileFixes, fix: Fix, console: Console) -> None:
    """Print the errors that the search for suspects would not notice; print nothing without a search."""
    if fix.explanations is None or not fix.answered:
        return
    from optloc.cli.crlb import reliability_of, show_reliability

    show_reliability(reliability_of(found.loaded.problem, fix.x, fix.suspects), console)


# Noise from data.

# The word for the grouping that explains the data best.
_AUTO = "auto"


def _estimate_noise(loaded: Loaded, by: str | None) -> Loaded:
    """Return the file with noise estimated for each station, pair or kind; unchanged if `by` is None.

    `by` is the value of the option: a grouping, a grouping with "+epoch", or "auto".
    """
    if by is None:
        return loaded
    grouping, plus, more = by.partition("+")
    if grouping == _AUTO and plus:
        raise InvalidProblem(
            f"{_AUTO} already chooses the error of an epoch", "--noise-from-data", f"write {_AUTO} alone"
        )
    if plus and more != "epoch":
        raise InvalidProblem(f"unknown component {more!r}", "--noise-from-data", "write +epoch, or remove it")
    group = None if grouping == _AUTO else grouping_of(grouping, "--noise-from-data")
    problem, levels = with_estimated_noise(loaded.problem, group, common=bool(plus))
    return replace(loaded, problem=problem, levels=levels)


def _common_level(problem: Problem) -> CommonLevel:
    """Return the common factor of the stated noise; raise InvalidProblem if the epochs cannot determine it."""
    try:
        return common_level(problem)
    except InvalidProblem as error:
        raise InvalidProblem(error.what, "--rescale-noise", "remove this option") from None


# If chance explains the number of refuted fixes with less than this probability, the stated noise is tested.
_BY_CHANCE = 0.01


def _needs_causes(fix: Fix) -> bool:
    """Return whether a common cause of the misfits must be searched, such as a wrong noise or late signals.

    The answer is yes if chance does not explain the number of fixes that the data reject. It is also yes if the method
    searched for suspects. The probability of each rejection by chance is `P_MISFIT`.
    """
    from scipy.special import bdtrc

    refuted = np.isin(fix.code, [Status.MISFIT, Status.CONTRADICTORY])
    by_chance = bdtrc(int(refuted.sum()) - 1, len(fix), P_MISFIT)
    return bool(refuted.any() and by_chance < _BY_CHANCE) or fix.explanations is not None


def _level_of(found: FileFixes) -> CommonLevel | None:
    """Return the common factor of the stated noise; None for few fixes, or if no cause must be searched."""
    if not found.apart or len(found.fix) < SEVERAL or not _needs_causes(found.fix):
        return None
    return common_level_at(batch_of(found.loaded.problem), found.fix.x)


def _late_of(found: FileFixes) -> LateSignals | None:
    """Return the late rows of a file at its fixes; None for few fixes, or if no cause must be searched."""
    if not found.apart or len(found.fix) < SEVERAL or not _needs_causes(found.fix):
        return None
    x, answered = found.fix.x, found.fix.answered
    kept = answered & np.isfinite(x).all(-1)
    return late_signals_at(batch_of(found.loaded.problem), np.flatnonzero(kept), x[kept]) if kept.any() else None


def tell_level(
    level: CommonLevel | None, used: bool = False, late: LateSignals | None = None, late_used: bool = False
) -> tuple[str, ...]:
    """Return sentences on the stated noise and on late rows, each with the option that helps.

    `level` is the common factor of the stated noise, and `late` has the late rows; None without an estimate. `used` is
    whether the fixes already use the common factor. `late_used` is whether they use the loss for late rows.
    """
    texts = []
    if late is not None and late.sentence:
        # If rows are late, do not report the noise: larger noise explains late rows badly, and no other rows well.
        use = "this is used" if late_used else "--late-from-data fixes with this loss"
        texts.append(late.sentence if late.alike else f"{late.sentence}: {use}")
    elif late_used:
        texts.append("no late rows are found")
    if level is not None and level.suspect and (used or not texts):
        texts.append(f"{level.sentence}: {'this is used' if used else '--rescale-noise uses it'}")
    elif level is not None and level.alone:
        texts.append(f"{level.sentence}: see `optloc check`, or --noise-from-data auto")
    elif used:
        texts.append("the noise is used as stated: no common factor explains the residuals better")
    return tuple(texts)


def late_json(late: LateSignals, used: bool = False) -> dict[str, Any]:
    """Return the result for late rows as a JSON value; `used` is whether the fixes use the loss for late rows."""
    return asdict(late) | {"method": late.method, "used": used and late.share > 0.0, "sentence": late.sentence}


def level_json(level: CommonLevel, used: bool = False) -> dict[str, Any]:
    """Return the result for the stated noise as a JSON value; `used` is whether the fixes use the common factor."""
    return asdict(level) | {"used": used and level.suspect, "sentence": level.sentence}


def grouping_of(by: str, where: str) -> By:
    """Return the grouping of errors with this name; raise InvalidProblem for an unknown word."""
    if by not in GROUPINGS:
        raise InvalidProblem(f"unknown grouping {by!r}", where, nearest(by, (*GROUPINGS, _AUTO)))
    return cast("By", by)


def _levels_json(levels: NoiseLevels) -> dict[str, Any]:
    """Return noise levels as a JSON value, SI units."""
    # `low` and `high` of the levels are factors of the stated standard deviations.
    columns: Columns = {"name": np.array(levels.names), "sigma": levels.sigma, "sigma_error": levels.sigma_error}
    columns |= {"low": levels.low * levels.stated, "high": levels.high * levels.stated}
    columns |= {
        "tails": levels.tails,
        "stated": levels.stated,
        "redundancy": levels.redundancy,
        "count": levels.count,
        "gross": levels.gross,
    }
    return {
        "by": levels.by,
        "common": levels.common,
        "levels": records(columns),
        "fixes": levels.fixes,
        "chi_square_stated": levels.before,
        "chi_square": levels.after,
        "sentences": list(levels.sentences),
    }


def _show_levels(levels: NoiseLevels, console: Console) -> None:
    """Print noise levels as a table."""
    common = f", and the error that rows of each {levels.common} share in an epoch" if levels.common else ""
    table = Table(title=f"Noise from data, by {levels.by}{common}", title_justify="left")
    table.add_column(levels.by)
    for name in ("sigma, SI", "95 %", "stated", "redundancy", "errors", "gross"):
        table.add_column(name, justify="right")
    low, high = levels.low * levels.stated, levels.high * levels.stated
    for i, name in enumerate(levels.names):
        # A level without an estimate is used as stated, or with a common factor.
        sigma = f"{levels.used[i] * levels.stated[i]:.3g}" + ("" if np.isfinite(levels.error[i]) else ", not estimated")
        within = f"{low[i]:.3g} to {high[i]:.3g}" if np.isfinite(high[i]) else "-"
        cells = (f"{levels.stated[i]:.3g}", f"{levels.redundancy[i]:.0%}", str(levels.count[i]), str(levels.gross[i]))
        table.add_row(name, sigma, within, *cells)
    console.print(table)
    say_all(console, levels.sentences)


# Causes and advice.


def advice_for_fixes(found: FileFixes) -> tuple[Advice, ...]:
    """Return the advice for all fixes of a file together; empty if all are ok."""
    if bool((found.fix.code == Status.OK).all()):
        return ()
    problem = found.loaded.problem
    advice = advice_for_vectors(problem, found.fix.x) if found.apart else tuple(advise(problem, found.fix))
    # The warnings of physical checks are printed before the fix.
    told = {check.name for check in CHECKS} if found.loaded.warnings else set()
    return tuple(one for one in advice if one.cause not in told)


def advice_for_vectors(problem: Problem, vectors: Array | None) -> tuple[Advice, ...]:
    """Return the advice for a problem at the parameters (k, size) of its epochs, or from the geometry alone."""
    return advise_at(problem, np.full((1, problem.layout.size), np.nan) if vectors is None else vectors)


def advice_json(found: tuple[Advice, ...]) -> list[dict[str, Any]]:
    """Return advice as a JSON value."""
    return [asdict(one) for one in found]


def show_advice(found: tuple[Advice, ...], console: Console) -> None:
    """Print each observation and its advice, followed by the lines to copy into a problem file."""
    for line in advice_lines(found):
        say(console, line)


# Option --explain: a second fix with the error that explains most of the misfit.


def _explain(found: FileFixes, method: str) -> FileFixes | None:
    """Return the fixes with the most likely error as an additional unknown; None if no error explains the misfit.

    `found` are the fixes without it, and `method` is the method of both.
    """
    larger = explained_at(found.loaded.problem, found.fix.x)
    return None if larger is None else fix_file(replace(found.loaded, problem=larger), method, True)


def explained_json(found: FileFixes, other: FileFixes | None) -> dict[str, Any] | None:
    """Return the error that explains the misfit, and the fixes with it as an unknown, as a JSON value.

    `found` are the fixes without this error and `other` the fixes with it; without `other` the result is None.
    """
    if other is None:
        return None
    moved = {f"change_{axis}": other.columns[axis] - found.columns[axis] for axis in _axes(found)}
    return {"name": other.loaded.problem.biases[-1].name, "change": records(moved)} | fixes_json(other)


def _show_explained(found: FileFixes, other: FileFixes | None, console: Console) -> None:
    """Print the fixes without the explaining error (`found`), and with it as an unknown (`other`)."""
    if other is None:
        say(console, "No single error explains the misfit.")
        return
    bias, fix = other.loaded.problem.biases[-1], other.fix  # the explaining error is the last bias of the problem
    table = Table(title=f"With the {bias.name}", title_justify="left")
    for name in ("", "without it", "with it", "change"):
        table.add_column(name, justify="left" if not name else "right")
    table.add_row("status", Status(int(found.fix.flat().code[0])).label, Status(int(fix.code)).label, "")
    # Separate epochs have a p-value each, so there is no single value to compare.
    before = "-" if found.apart else as_p(float(found.fix.p_value))
    table.add_row("p", before, as_p(float(fix.p_value)), "")
    rows = min(len(found.columns["x"]), _STATES)
    for i in range(rows):
        owner = _owner(found.columns, i) if len(found.columns["x"]) > 1 else ""
        for axis in _axes(found):
            one, two = (each.columns[axis][i] for each in (found, other))
            sigmas = [each.columns[f"sigma_{axis}"][i] for each in (found, other)]
            texts = [with_sigma(value, sigma, "m") for value, sigma in zip((one, two), sigmas, strict=True)]
            table.add_row(f"{axis}{owner}", *texts, f"{two - one:+.4g} m")
    console.print(table)
    if rows < len(found.columns["x"]):
        say(console, f"{len(found.columns['x']) - rows} more positions changed; --json prints all.")
    if np.isfinite(fix.x).all():
        slot, _ = fix.layout.find(bias.name)
        values = zip(fix.take(bias.name), fix.sigma(bias.name), strict=True)
        sizes = ", ".join(with_sigma(float(value), float(sigma), slot.unit) for value, sigma in values)
        say(console, f"The {bias.name} is {sizes}; the first fix above does not include it.")


def _axes(found: FileFixes) -> list[str]:
    """Return the names of the coordinates in the table of fixes, such as ["x", "y"]."""
    return [axis for axis in "xyz" if axis in found.columns]


def _owner(columns: Columns, i: int) -> str:
    """Return " of <target> at <epoch>" for row `i`; each part is empty if the table has only one target or epoch."""
    several = "target" in columns and len(set(columns["target"].tolist())) > 1
    epoch = f" at {columns['epoch'][i]}" if "epoch" in columns and columns["epoch"][i] != "run" else ""
    return (f" of {columns['target'][i]}" if several else "") + epoch
