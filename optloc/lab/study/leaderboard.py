"""Leaderboard of the public test set as a page of Markdown: shares of right answers, times, and the test data.

The test set is the shipped study `SET`. A scene is a case of this study.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optloc.lab.study.design import StudyDesign
from optloc.lab.study.folder import StudyManifest, read_frame, read_manifest
from optloc.lab.study.paired import paired
from optloc.lab.study.summary import COLUMNS, judged, methods, wilson

if TYPE_CHECKING:
    import pandas as pd

SET = "bench"
"""Name of the shipped study that contains the test set."""

_JUDGE = "truth"


def page(folder: Path, design: StudyDesign) -> str:
    """Return the leaderboard as text in Markdown.

    `folder` is the output folder of a run of the test set; `design` is the design of that run.
    """
    rows, manifest = judged(read_frame(folder, COLUMNS)), read_manifest(folder)
    # The baseline "truth" starts at the true position and judges the others, so it is not ranked.
    ranked = rows[rows["method"].astype(str) != _JUDGE]
    lines = ["---", "orphan: true", "---", "", "<!-- table -->", "", _about(manifest, design), ""]
    lines += [*_ranks(ranked), "", "Share of right answers by scene, %:", "", *_by_case(ranked)]
    return "\n".join(lines)


def _about(manifest: StudyManifest, design: StudyDesign) -> str:
    """Return a line with the version, date, test set, seed and machine of the run."""
    return (
        f"optloc {manifest.version}, {manifest.created[:10]}, test set {design.data[:16]}, seed {manifest.seed}, "
        f"{design.cells[0].case.trials} trials a scene; {manifest.machine}."
    )


def _ranks(rows: pd.DataFrame) -> list[str]:
    """Return the lines of the ranking as a Markdown table; `rows` are the judged rows of the ranked methods.

    The last column compares each method with the first method: trials that only one of the two solves correctly.
    """
    order = methods(rows)
    first = order[0]
    alone = dict.fromkeys(order, 0)
    first_alone = dict.fromkeys(order, 0)
    for pair in paired(rows, first):
        alone[pair.method] += pair.alone
        first_alone[pair.method] += pair.other_alone
    lines = [
        f"| | method | right, % | 95 % | ok but wrong, % | median ms | only this right : only {first} right |",
        "|---:|---|---:|---:|---:|---:|---:|",
    ]
    for rank, name in enumerate(order, 1):
        part = rows[rows["method"].astype(str) == name]
        count = len(part)
        low, high = wilson(float(part["right"].sum()), float(count))
        comparison = "" if name == first else f"{alone[name]} : {first_alone[name]}"
        shares = f"{100 * part['right'].mean():.2f} | {100 * float(low):.2f} to {100 * float(high):.2f}"
        wrong, time = 100 * part["wrong"].mean(), 1e3 * float(np.median(part["seconds"]))
        lines.append(f"| {rank} | {_cell(name)} | {shares} | {wrong:.2f} | {time:.3g} | {comparison} |")
    return lines


def _by_case(rows: pd.DataFrame) -> list[str]:
    """Return the lines of a Markdown table: share of right answers in percent, by scene and method."""
    order = methods(rows)
    shares = rows.pivot_table(index="case", columns="method", values="right", aggfunc="mean", observed=True)
    lines = [f"| scene | {' | '.join(map(_cell, order))} |", f"|---|{'---:|' * len(order)}"]
    for case, row in shares.iterrows():
        lines.append(f"| {_cell(str(case))} | {' | '.join(f'{100 * row[name]:.1f}' for name in order)} |")
    return lines


def _cell(text: str) -> str:
    """Return text as a table cell of Markdown, escaped because names of methods come from users."""
    return "".join(f"\\{c}" if c in "\\|`*_<>[]" else c for c in text)
