"""The command ``optloc plot``: one function for each picture. ``optloc list pictures`` prints their first lines."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from optloc.base.errors import InvalidProblem, nearest
from optloc.cli.extensions import PictureRequest, extensions
from optloc.cli.output import Screen, claim_outputs, say, write_picture
from optloc.files.reader import Loaded, read
from optloc.problem.epochs import by_epoch, separable
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def run_plot(what: str, request: PictureRequest, quiet: bool) -> int:
    """Draw the picture with the name `what`, and return the exit code."""
    known = pictures()
    if what not in known:
        raise InvalidProblem(f"there is no picture {what!r}", "plot", nearest(what, list(known)))
    claim_outputs(picture=request.out, inputs=[request.file])
    known[what](request)
    say(Screen(quiet=quiet), f"The picture is in {request.out}.")
    return 0


def _solve_all(request: PictureRequest) -> tuple[Loaded, Problem, Fix]:
    """Return a file, its problem (separate epochs as a batch) and its fixes."""
    from optloc.solvers.solution import solve

    loaded = read(request.file)
    problem = by_epoch(loaded.problem) if separable(loaded.problem) else loaded.problem
    return loaded, problem, solve(problem, request.method)


def _solve_one(request: PictureRequest) -> tuple[Problem, Fix, str]:
    """Return the problem of one epoch, or of a run, with its fix and a title.

    If the epochs of the file share unknowns, the problem is the whole run. Otherwise it is the epoch that `request`
    names, or the first epoch.
    """
    from optloc.solvers.solution import solve

    loaded = read(request.file)
    if not separable(loaded.problem):
        return loaded.problem, solve(loaded.problem, request.method), loaded.title
    labels = [str(label) for label in loaded.epochs]
    label = labels[0] if request.epoch is None else request.epoch
    if label not in labels:
        raise InvalidProblem(f"there is no epoch {label!r}", "--epoch", nearest(label, labels))
    # Take one epoch as a batch of one, so that the picture shows its label.
    problem = by_epoch(loaded.problem).take(np.array([labels.index(label)]))
    return problem, solve(problem, request.method), f"{loaded.title}, epoch {label}"


def _fix(request: PictureRequest) -> None:
    """Stations, fix, 95 % ellipse and alternatives."""
    from optloc.show.pictures import plot_fixes

    loaded, _, fix = _solve_all(request)
    write_picture(plot_fixes(loaded.problem, fix, loaded.title), request.out)


def _residuals(request: PictureRequest) -> None:
    """Residuals by station."""
    from optloc.show.pictures import plot_residuals

    loaded, problem, fix = _solve_all(request)
    write_picture(plot_residuals(problem, fix, loaded.title), request.out)


def _draw_one(draw: Callable[..., Figure], request: PictureRequest) -> None:
    """Write a picture of one epoch or run; `draw` makes the figure from a problem, its fix and a title."""
    problem, fix, title = _solve_one(request)
    write_picture(draw(problem, fix, title), request.out)


def _landscape(request: PictureRequest) -> None:
    """Cost over target positions."""
    from optloc.show.pictures import plot_landscape

    _draw_one(plot_landscape, request)


def _convergence(request: PictureRequest) -> None:
    """End points of iterations from many starts."""
    from optloc.show.pictures import plot_convergence

    _draw_one(plot_convergence, request)


def _biases(request: PictureRequest) -> None:
    """Biases of a run against time, with 95 % intervals."""
    from optloc.show.pictures import plot_biases
    from optloc.solvers.running import growing

    loaded, problem, fix = _solve_all(request)
    units = {slot.name: loaded.bias_unit(slot.name, slot.unit) for slot in problem.layout.shared if slot.members}
    write_picture(plot_biases(growing(problem, fix), loaded.title, units=units), request.out)


def _bound(request: PictureRequest) -> None:
    """Map of the Cramer-Rao bound."""
    from optloc.cli.crlb import run_map

    run_map(request.file, request.out, None, None, None, None, geodetic=False, dilution=False)


def _track(request: PictureRequest) -> None:
    """Track of a run, with sigma and NIS."""
    from optloc.cli.track import TrackOptions, run_track

    run_track(request.file, TrackOptions(), plot=request.out, quiet=True)


_PICTURES: dict[str, Callable[[PictureRequest], None]] = {
    "fix": _fix,
    "landscape": _landscape,
    "convergence": _convergence,
    "residuals": _residuals,
    "biases": _biases,
    "bound": _bound,
    "track": _track,
}


def pictures() -> dict[str, Callable[[PictureRequest], None]]:
    """Return the functions of all pictures by name, including the pictures of neighbours."""
    return {**_PICTURES, **{name: draw for one in extensions() for name, draw in one.pictures.items()}}
