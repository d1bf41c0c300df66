"""Tables of a study's report: as numbers for programs, and as short text for people.

A `Sheet` contains a table twice: a frame of numbers and a table of text. The variable `columns` in this module is a
list of headings, each with a function from a row of the frame to the text of a cell. `frame` contains judged rows
(`optloc.lab.study.summary.judged`). `cells` are the statistics of a study by cell (`optloc.lab.study.summary.cells`).
`order` are the names of the methods, best first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from optloc.lab.study.profiles import RATIOS, Profiles, shares
from optloc.lab.study.summary import PROVEN, by_status, clopper_pearson, noise_text, ranking, wilson
from optloc.show import Sheet, TextTable

if TYPE_CHECKING:
    import pandas as pd


SHIFT = 1e-5
"""Shift of geometric means of times, seconds: the time of a fast fix, so that shorter times change the mean little."""


def number(value: float, digits: int = 3) -> str:
    """Return a number as text with `digits` significant digits; a dash if the number is not finite."""
    if not np.isfinite(value):
        return "–"
    # In this range a plain number is shorter than one with a power of ten.
    if value and not 1e-3 <= abs(value) < 1e5:
        mantissa, _, power = f"{value:.{digits - 1}e}".partition("e")
        return f"{mantissa}·10{str(int(power)).translate(_SUPERSCRIPT)}"
    places = max(0, digits - 1 - int(np.floor(np.log10(abs(value))))) if value else 0
    return f"{value:.{places}f}"


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def duration(seconds: float) -> str:
    """Return a time in seconds as text, in s, ms, µs or ns."""
    # From 0.9995 on, three digits round to 1.00 of the unit.
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= scale * 0.9995:
            return f"{number(seconds / scale)} {unit}"
    return f"{number(seconds * 1e9)} ns" if np.isfinite(seconds) else "–"


def percent(share: float) -> str:
    """Return a share (0 to 1) as text in per cent; only the shares 0 and 1 are printed as 0 and 100."""
    if not np.isfinite(share):
        return "–"
    text = f"{100 * share:.1f}"
    # These shares would be rounded to 0.0 or 100.0.
    if share not in {0.0, 1.0} and not 0.0005 <= share < 0.9995:
        text = "> 99.9" if share > 0.5 else "< 0.1"
    return text if text not in {"0.0", "100.0"} else text[:-2]


def _interval(hits: float, count: float) -> str:
    """Return a share in per cent with its 95 % interval as text."""
    low, high = wilson(hits, count)
    return f"{percent(float(hits / count))} ({100 * float(low):.1f} to {100 * float(high):.1f})"


def _at_most(hits: int, count: int) -> str:
    """Return a count as text, and in brackets the upper end of the 95 % interval of its share in per cent."""
    return f"{hits} (≤ {number(100 * float(clopper_pearson(hits, count)[1]), 2)} %)"


Column = tuple[str, Callable[[Any], str]]


def _sheet(name: str, title: str, note: str, frame: pd.DataFrame, columns: list[Column], words: int) -> Sheet:
    """Return a frame with its table of text; each column has a heading and a function from a row to text.

    `words` is the number of columns at the left that contain words.
    """
    rows = tuple(tuple(show(row) for _, show in columns) for row in frame.itertuples(index=False))
    return Sheet(frame, TextTable(name, title, tuple(head for head, _ in columns), rows, note), words)


def _case(words: tuple[str, ...] = ("case", "noise", "method")) -> list[Column]:
    """Return the columns that `words` names: case, noise (level) and method."""
    columns: dict[str, Column] = {
        "case": ("case", lambda r: str(r.case)),
        "noise": ("noise", lambda r: noise_text(r.noise_label)),
        "method": ("method", lambda r: str(r.method)),
    }
    return [columns[word] for word in words]


def best_first(frame: pd.DataFrame, order: list[str]) -> Sheet:
    """Return a table of the ranking of the methods, best first."""
    table = ranking(frame, order, SHIFT)
    sums = frame.groupby("method", observed=True)[["answered", "right", "wrong", "false"]].sum()
    # Over all rows; the times are over the trials that every method ran.
    counts = frame.groupby("method", observed=True).size()
    table = table.join(sums, on="method").assign(trials=[int(counts[name]) for name in table["method"]])
    limits = wilson(table["right"].to_numpy(), table["trials"].to_numpy())
    table = table.assign(right_low=limits[0], right_high=limits[1])
    columns: list[Column] = [
        ("method", lambda r: str(r.method)),
        ("trials", lambda r: str(r.trials)),
        ("right, % (95 %)", lambda r: _interval(r.right, r.trials)),
        ("answered, %", lambda r: percent(r.answered / r.trials)),
        ("wrong but ok", lambda r: _at_most(r.wrong, r.trials)),
        ("false proofs", lambda r: str(r.false)),
        ("shifted mean time", lambda r: duration(r.mean)),
        ("relative", lambda r: number(r.relative)),
        ("fastest, %", lambda r: percent(r.fastest)),
    ]
    note = (
        "Right: an answer, and neither another method nor the truth has a lower cost. Wrong but ok: the status is ok, "
        "but a lower cost is known; in brackets the upper end of the 95 % interval of the share. Mean time: "
        f"geometric, shifted by {duration(SHIFT)}, over the {int(table['instances'].max())} trials that every method "
        "ran. An answer that is not right counts ten times the slowest time of the study. "
        "Methods that start at the truth are not ranked."
    )
    return _sheet("ranking", "Ranking", note, table, columns, 1)


def success(cells: pd.DataFrame) -> Sheet:
    """Return a table of the shares of right answers of each method, cell by cell."""
    names = "case noise noise_unit noise_label method trials answered right wrong died".split()
    table = cells[names].copy()
    table["right_low"], table["right_high"] = wilson(table["right"].to_numpy(), table["trials"].to_numpy())
    columns = [
        *_case(),
        ("trials", lambda r: str(r.trials)),
        ("right, % (95 %)", lambda r: _interval(r.right, r.trials)),
        ("answered, %", lambda r: percent(r.answered / r.trials)),
        ("wrong but ok", lambda r: _at_most(r.wrong, r.trials)),
        ("died", lambda r: str(r.died)),
    ]
    return _sheet("success", "Right answers", "Intervals are Wilson's.", table, columns, 3)


def statuses(frame: pd.DataFrame) -> Sheet:
    """Return a table of the statuses of the answers of each method, with the trials in which a lower cost is known."""
    columns: list[Column] = [
        ("method", lambda r: str(r.method)),
        ("status", lambda r: str(r.status)),
        ("trials", lambda r: str(r.trials)),
        ("right", lambda r: str(r.right)),
        ("a lower cost is known", lambda r: _at_most(r.better, r.trials)),
    ]
    note = (
        "A fix with the status ok has no known fault. If a lower cost is known all the same, the fix was wrong but ok. "
        "Each other status names a possible fault. In brackets: upper end of the 95 % interval of the share."
    )
    return _sheet("statuses", "Statuses", note, by_status(frame), columns, 2)


def accuracy(cells: pd.DataFrame) -> Sheet:
    """Return a table of the errors of the answers relative to the bound, cell by cell."""
    names = "case noise noise_unit noise_label method rmse bound ratio ratio_half deviation_median deviation_p95 nees"
    columns = [
        *_case(),
        ("RMSE, m", lambda r: number(r.rmse)),
        ("CRLB, m", lambda r: number(r.bound)),
        ("RMSE / CRLB", lambda r: f"{number(r.ratio)} ± {number(r.ratio_half, 2)}"),
        ("error / bound, median", lambda r: number(r.deviation_median)),
        ("95 %", lambda r: number(r.deviation_p95)),
        ("NEES / dimension", lambda r: number(r.nees)),
    ]
    note = (
        "Over the answers of a method, or over all its positions if it claims no answer. The bound is averaged over "
        "the same trials. A single gross error dominates the root mean square, so compare it with the median. NEES "
        "over the dimension is 1 if the claimed covariances are right."
    )
    return _sheet("accuracy", "Errors and bounds", note, cells[names.split()], columns, 3)


def timing(cells: pd.DataFrame) -> Sheet:
    """Return a table of the times of a fix, cell by cell."""
    names = "case noise noise_unit noise_label method rows seconds_median seconds_p10 seconds_p90 build iterations"
    columns = [
        *_case(),
        ("measurements", lambda r: str(r.rows)),
        ("median", lambda r: duration(r.seconds_median)),
        ("10 %", lambda r: duration(r.seconds_p10)),
        ("90 %", lambda r: duration(r.seconds_p90)),
        ("first fix", lambda r: duration(r.build) if r.build else "–"),
        ("iterations", lambda r: number(r.iterations)),
    ]
    note = (
        "Time of a call over the number of its fixes. First fix: longest time of the first fix in a process. It "
        "includes compilation or canonicalisation, and the other columns leave it out."
    )
    return _sheet("timing", "Times", note, cells[names.split()], columns, 3)


def solved_within(profile: Profiles) -> Sheet:
    """Return a table of the shares of trials that each method solves within multiples of the least work."""
    import pandas as pd

    rows = [
        {"method": method_share.method, "trials": method_share.trials, "solved": method_share.solved}
        | {f"within_{ratio:g}": method_share.within[ratio] for ratio in RATIOS}
        | {f"median_{profile.work}": method_share.median}
        for method_share in shares(profile)
    ]
    as_text = duration if profile.work == "processor" else number
    columns: list[Column] = [
        ("method", lambda r: str(r.method)),
        ("trials", lambda r: str(r.trials)),
        ("solved, % (95 %)", lambda r: _interval(r.solved, r.trials)),
        *((f"within {ratio:g}×", partial(_within, ratio)) for ratio in RATIOS),
        ("median when solved", lambda r: as_text(getattr(r, f"median_{profile.work}"))),
    ]
    note = (
        f"Solved: the cost exceeds the least known cost by at most {profile.tau:g}; the status does not matter. The "
        f"next columns give the share, in per cent, that is solved within multiples of the {_LEAST[profile.work]} that "
        "the best method needs for the trial. Methods that know the truth are left out."
    )
    if profile.silent:
        note += f" Without a count of evaluations, and left out: {', '.join(profile.silent)}."
    return _sheet("profiles", "Solved within a given work", note, pd.DataFrame(rows), columns, 1)


_LEAST = {"processor": "processor time", "evaluations": "evaluations of the cost"}


def _within(ratio: float, row: Any) -> str:
    """Return the share of trials that a method solves within `ratio` times the least work, as text in per cent."""
    return percent(getattr(row, f"within_{ratio:g}"))


# Proofs of an answer, from the strongest on.
_PROOFS = (PROVEN, "region", "local")


def _proven(kind: str, row: Any) -> str:
    """Return the share of trials with a proof of this kind, as text in per cent."""
    return percent(getattr(row, f"proven_{kind}") / row.trials)


def certificates(frame: pd.DataFrame, order: list[str]) -> Sheet:
    """Return a table of the proofs of each method's answers, and the number of false ones."""
    import pandas as pd

    lines = []
    for name in order:
        part = frame[frame["method"] == name]
        proofs = part["proof"].astype(str).value_counts()
        share = {f"proven_{kind}": int(proofs.get(kind, 0)) for kind in _PROOFS}
        # Gap between the cost and its proven lower bound; NaN without a proof.
        gaps = (part["cost"] - part["bound"]).to_numpy(dtype=float)
        gaps = gaps[np.isfinite(gaps)]
        certificates = ", ".join(sorted(set(part["certificate"].astype(str)) - {"none", "nan", ""}))
        gap = float(np.median(gaps)) if len(gaps) else np.nan
        lines.append(
            {"method": name, "by": certificates, "trials": len(part), **share, "false": int(part["false"].sum())}
        )
        lines[-1] |= {"cost_less_bound_median": gap}
    table = pd.DataFrame(lines)
    columns: list[Column] = [
        ("method", lambda r: str(r.method)),
        ("by", lambda r: r.by or "–"),
        *((kind, partial(_proven, kind)) for kind in _PROOFS),
        ("false proofs", lambda r: _at_most(r.false, r.proven_global) if r.proven_global else "–"),
        ("cost less bound, median", lambda r: number(r.cost_less_bound_median)),
    ]
    note = (
        "Share of trials, in per cent, whose answer was proven best everywhere, in a region, or locally. A global "
        "proof is false if another method, or the truth, has a lower cost. In brackets: upper end of the 95 % interval "
        "of the share of false proofs."
    )
    return _sheet("certificates", "Certificates", note, table, columns, 2)


def made_with(frame: pd.DataFrame) -> Sheet:
    """Return a table of the machines and library versions that computed the rows."""
    names = ["machine", "versions"]
    table = frame.groupby(names, observed=True).size().rename("rows").reset_index()
    columns: list[Column] = [
        ("machine", lambda r: str(r.machine)),
        ("versions", lambda r: str(r.versions)),
        ("rows", lambda r: str(r.rows)),
    ]
    return _sheet("machine", "Machine and versions", "", table, columns, 2)


def sheets(
    frame: pd.DataFrame, rivals: pd.DataFrame, cells: pd.DataFrame, order: list[str], found: Profiles | None
) -> Iterator[Sheet]:
    """Yield all tables in reading order.

    `frame` are all judged rows, and `rivals` the rows of the ranked methods. `cells` are the statistics of the cells,
    and `order` are the methods with the best first. `found` are the profiles; with None, their table is left out.
    """
    yield best_first(rivals, [name for name in order if name in set(rivals["method"])])
    yield success(cells)
    yield statuses(frame)
    yield accuracy(cells)
    yield certificates(frame, order)
    if found is not None:
        yield solved_within(found)
    yield timing(cells)
    yield made_with(frame)


# Tables for papers: LaTeX with the rules of booktabs.

_SPECIAL = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\ensuremath{<}",
    ">": r"\ensuremath{>}",
    "≤": r"\ensuremath{\le}",
    "±": r"\ensuremath{\pm}",
    "·": r"\ensuremath{\cdot}",
    "×": r"\ensuremath{\times}",
    "µ": r"\ensuremath{\mu}",
    "–": "--",
    "°": r"\ensuremath{^\circ}",
}
_RAISED = dict(zip("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789", strict=True))


def latex_text(text: str) -> str:
    """Return text with LaTeX's special characters escaped; superscript digits become powers."""
    parts, power = [], ""
    # Consecutive superscript digits are one power.
    for character in [*text, ""]:
        if character in _RAISED and character:
            power += _RAISED[character]
            continue
        if power:
            parts.append(rf"\ensuremath{{^{{{power}}}}}")
            power = ""
        parts.append(_SPECIAL.get(character, character))
    return "".join(parts)


def latex(table: TextTable, words: int = 1) -> str:
    """Return a table as LaTeX that breaks across pages; it needs the packages booktabs and longtable.

    Parameters
    ----------
    table : TextTable
        Text cells.
    words : int
        Number of columns at the left that contain words and are aligned left; the others are aligned right.
    """
    columns = "l" * words + "r" * (len(table.header) - words)
    head = " & ".join(map(latex_text, table.header)) + r" \\"
    rows = [" & ".join(map(latex_text, row)) + r" \\" for row in table.rows]
    # The note is part of the caption: a paper has no other place for the note.
    caption = latex_text(f"{table.title}. {table.note}".strip())
    lines = [
        "% needs \\usepackage{booktabs, longtable}",
        rf"\begin{{longtable}}{{{columns}}}",
        rf"\caption{{{caption}}}\label{{tab:{table.name}}}\\",
        r"\toprule",
        head,
        r"\midrule\endfirsthead",
        r"\toprule",
        head,
        r"\midrule\endhead",
        r"\bottomrule\endlastfoot",
        *rows,
        r"\end{longtable}",
    ]
    return "\n".join(lines) + "\n"
