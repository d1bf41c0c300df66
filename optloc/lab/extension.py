"""Commands, lists and pictures of the lab: studies, papers and data sets."""

from __future__ import annotations

import os
from typing import Any

import typer

from optloc.cli import MORE, Extension, PictureRequest, Rows, registry
from optloc.lab.commands.reproduce import EXAMPLES, reproduce
from optloc.lab.commands.study import study


def _commands(app: typer.Typer) -> None:
    app.command(rich_help_panel=MORE, epilog=EXAMPLES)(reproduce)
    app.add_typer(study, name="study", rich_help_panel=MORE)


def _studies() -> Rows:
    """Return the shipped studies for `optloc list studies`."""
    import tomllib

    from optloc.lab.study.design import shipped

    texts = {name: tomllib.loads(entry.read_text(encoding="utf-8")) for name, entry in shipped().items()}
    return [{"study": name, "summary": data.get("title", data["name"])} for name, data in texts.items()]


def _datasets() -> Rows:
    """Return the data sets for `optloc list datasets`, and whether their files exist."""
    from optloc.lab.datasets import available
    from optloc.lab.datasets.catalogue import ENTRIES

    here = available()
    return [
        {
            "dataset": name,
            "here": "yes" if name in here else "no",
            "licence": entry.licence,
            "summary": entry.description,
        }
        for name, entry in ENTRIES.items()
    ]


def _folder() -> dict[str, Any]:
    """Return the folder of data sets and the names of the sets in it, for the report on the installation."""
    from optloc.lab.datasets import available

    folder = os.environ.get("OPTLOC_DATA")
    return {"folder": folder, "there": list(available()) if folder else []}


def _accuracy(asked: PictureRequest) -> None:
    """Draw the errors of a study's methods and the bound against the noise."""
    import numpy as np

    from optloc.cli import write_picture
    from optloc.lab.study import summary
    from optloc.lab.study.folder import read_frame
    from optloc.problem import InvalidProblem, nearest
    from optloc.show import plot_accuracy

    if not asked.file.is_dir():
        raise InvalidProblem("this picture needs a study", str(asked.file), "give the output folder of a study")
    rows = read_frame(asked.file, [*summary.COLUMNS])
    if not len(rows):
        raise InvalidProblem("the study has no finished part yet", str(asked.file), "run the study")
    cells = summary.cells(summary.judged(rows))
    names = list(dict.fromkeys(str(case) for case in cells["case"]))
    name = names[0] if asked.epoch is None else asked.epoch
    if name not in names:
        raise InvalidProblem(f"there is no case {name!r}", "--epoch", nearest(name, names))
    case = cells[cells["case"].astype(str) == name]
    # Methods may lack some noise levels: reindex, so that each method has a value or NaN at each level.
    noise = np.unique(case["noise"].to_numpy(dtype=float))
    bound = case.groupby("noise")["bound"].max().reindex(noise).to_numpy(dtype=float)
    errors = {
        str(method): part.groupby("noise")["rmse"].first().reindex(noise).to_numpy(dtype=float)
        for method, part in case.groupby("method", sort=False, observed=True)
    }
    unit = str(case["noise_unit"].iloc[0])
    write_picture(plot_accuracy(noise, errors, bound, name, unit="" if unit == "x" else unit), asked.out)


EXTENSION = Extension(
    _commands,
    lists={
        "baselines": registry("baseline", "optloc.lab.study.baselines:BASELINES"),
        "executors": registry("executor", "optloc.lab.study.execute:EXECUTORS"),
        "studies": _studies,
        "papers": registry("paper", "optloc.lab.papers:PAPERS"),
        "datasets": _datasets,
    },
    pictures={"accuracy": _accuracy},
    facts={"datasets": _folder},
)
