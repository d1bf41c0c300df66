"""What ``optloc plot`` draws: one function for each picture, whose first line is what ``optloc list pictures`` says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.cli.output import Screen, claim_outputs, say, write_picture
from optloc.files import Loaded, read
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Asked:
    """What is to be drawn.

    Parameters
    ----------
    file : Path
        Problem file, or the folder of a study.
    out : Path
        The picture.
    method : str
        How fixes are made.
    epoch : str, optional
        Label of the epoch, or case of a study; the first by default.
    """

    file: Path
    out: Path
    method: str
    epoch: str | None


def run_plot(what: str, asked: Asked, quiet: bool) -> int:
    """Draw a picture, and return the exit code."""
    if what not in PICTURES:
        raise InvalidProblem(f"there is no picture {what!r}", "plot", nearest(what, list(PICTURES)))
    claim_outputs(picture=asked.out, inputs=[asked.file])
    PICTURES[what](asked)
    say(Screen(quiet=quiet), f"The picture is in {asked.out}.")
    return 0


def _solve_all(asked: Asked) -> tuple[Loaded, Problem, Fix]:
    """Return a file, its problem (epochs that share nothing as a batch) and its fixes."""
    from optloc.solvers import solve

    loaded = read(asked.file)
    problem = by_epoch(loaded.problem) if separable(loaded.problem) else loaded.problem
    return loaded, problem, solve(problem, asked.method)


def _solve_one(asked: Asked) -> tuple[Problem, Fix, str]:
    """Return the problem of one epoch, or of a run, with its fix and a title."""
    from optloc.solvers import solve

    loaded = read(asked.file)
    if not separable(loaded.problem):
        return loaded.problem, solve(loaded.problem, asked.method), loaded.title
    labels = [str(label) for label in loaded.epochs]
    label = labels[0] if asked.epoch is None else asked.epoch
    if label not in labels:
        raise InvalidProblem(f"there is no epoch {label!r}", "--epoch", nearest(label, labels))
    # One epoch as a batch of one: its picture says the label.
    problem = by_epoch(loaded.problem).take(np.array([labels.index(label)]))
    return problem, solve(problem, asked.method), f"{loaded.title}, epoch {label}"


def _fix(asked: Asked) -> None:
    """Stations, fix, 95 % ellipse and alternatives."""
    from optloc.show.pictures import plot_fixes

    loaded, _, fix = _solve_all(asked)
    write_picture(plot_fixes(loaded.problem, fix, loaded.title), asked.out)


def _residuals(asked: Asked) -> None:
    """Residuals by station."""
    from optloc.show.pictures import plot_residuals

    loaded, problem, fix = _solve_all(asked)
    write_picture(plot_residuals(problem, fix, loaded.title), asked.out)


def _draw_one(draw: Callable[..., Figure], asked: Asked) -> None:
    problem, fix, title = _solve_one(asked)
    write_picture(draw(problem, fix, title), asked.out)


def _landscape(asked: Asked) -> None:
    """Cost over the place of the target."""
    from optloc.show.pictures import plot_landscape

    _draw_one(plot_landscape, asked)


def _convergence(asked: Asked) -> None:
    """Where iterations from many starts end."""
    from optloc.show.pictures import plot_convergence

    _draw_one(plot_convergence, asked)


def _biases(asked: Asked) -> None:
    """Biases of a run against time, with 95 %."""
    from optloc.show.pictures import plot_biases
    from optloc.solvers.running import growing

    loaded, problem, fix = _solve_all(asked)
    write_picture(plot_biases(growing(problem, fix), loaded.title), asked.out)


def _bound(asked: Asked) -> None:
    """Map of the Cramer-Rao bound."""
    from optloc.cli.crlb import run_map

    run_map(asked.file, asked.out, None, None, None, None, geodetic=False, dilution=False)


def _track(asked: Asked) -> None:
    """Track of a run, with sigma and NIS."""
    from optloc.cli.track import Wanted, run_track

    run_track(asked.file, Wanted(), plot=asked.out, quiet=True)


def _accuracy(asked: Asked) -> None:
    """Errors of a study's methods against the bound."""
    from optloc.lab.study import summary
    from optloc.lab.study.folder import read_frame
    from optloc.show.pictures import plot_accuracy

    if not asked.file.is_dir():
        raise InvalidProblem("the errors of methods are those of a study", str(asked.file), "name its output folder")
    rows = read_frame(asked.file, [*summary.COLUMNS])
    if not len(rows):
        raise InvalidProblem("nothing of the study is finished yet", str(asked.file), "run the study")
    cells = summary.cells(summary.judged(rows))
    names = list(dict.fromkeys(str(case) for case in cells["case"]))
    name = names[0] if asked.epoch is None else asked.epoch
    if name not in names:
        raise InvalidProblem(f"there is no case {name!r}", "--epoch", nearest(name, names))
    case = cells[cells["case"].astype(str) == name]
    # Methods may lack some noise levels: reindexed, so that all have values (or NaN) at the same ones.
    noise = np.unique(case["noise"].to_numpy(dtype=float))
    bound = case.groupby("noise")["bound"].max().reindex(noise).to_numpy(dtype=float)
    errors = {
        str(method): part.groupby("noise")["rmse"].first().reindex(noise).to_numpy(dtype=float)
        for method, part in case.groupby("method", sort=False, observed=True)
    }
    unit = str(case["noise_unit"].iloc[0])
    write_picture(plot_accuracy(noise, errors, bound, name, unit="" if unit == "x" else unit), asked.out)


PICTURES: dict[str, Callable[[Asked], None]] = {
    "fix": _fix,
    "landscape": _landscape,
    "convergence": _convergence,
    "residuals": _residuals,
    "biases": _biases,
    "bound": _bound,
    "track": _track,
    "accuracy": _accuracy,
}
"""Pictures by name."""
