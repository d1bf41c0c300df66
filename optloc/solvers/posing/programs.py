"""The maximum-likelihood problem as the statement of a nonlinear program."""

from __future__ import annotations

from dataclasses import replace

from optloc.base.errors import InvalidProblem
from optloc.linear.normal import with_station_noise
from optloc.problem.problem import Problem
from optloc.solvers.posing.convex_statement import ConicStatement, Locate
from optloc.solvers.scaled_program import ScaledProblem
from optloc.solvers.starts.block_averages import average_blocks
from optloc.solvers.starts.position import is_registration_run
from optloc.solvers.starts.registration import BLOCKS


def pose_program(problem: Problem, locate: Locate) -> ScaledProblem:
    """Return a flat batch of one problem as a program with its own symbols, without constraints.

    A long run is averaged to `BLOCKS` epochs, as in the method "nlp": a program with thousands of rows is slow.
    `locate` is not used.
    """
    free = replace(problem, constraints=())
    if is_registration_run(problem) and problem.epochs >= 2 * BLOCKS:
        free = average_blocks(free, BLOCKS)
    return ScaledProblem(with_station_noise(free), shared=False)


def pose_pulses(problem: Problem, locate: Locate) -> ConicStatement:
    """Raise InvalidProblem: the nuclear norm states networks whose stations and pulses have no known position."""
    raise InvalidProblem(
        "the nuclear norm states networks of stations at unknown positions",
        "formulation",
        "use optloc.sites.calibration.pose_network",
    )
