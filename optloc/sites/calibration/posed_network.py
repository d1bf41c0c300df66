"""`pose_network`: the times of emission of a network of least nuclear norm, as a problem that users change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.metric_upgrade import unknowns, upgrade
from formulations.nuclear_norm import affine_network, nuclear_data, nuclear_offsets, nuclear_problem, truncated_slope
from optloc.problem import Array, InvalidProblem
from optloc.sites.calibration.likelihood import NetworkEstimate, likelihood
from optloc.sites.calibration.network import Network
from optloc.sites.calibration.restarts import starts_of
from optloc.solvers import ConvexProgram


@dataclass(frozen=True, slots=True)
class RelaxedNetwork:
    """The solution of a posed network.

    Parameters
    ----------
    emission : array (N,)
        Times of emission times the propagation speed, metres; NaN without a solution.
    estimate : NetworkEstimate, optional
        Minimum of the likelihood that least squares reaches from these times; None if they give no network.
    cost : float
        Its chi-square; NaN without an estimate.
    value : float
        Objective: square metres, unless the objective is your own.
    bound : float
        Lower bound of the objective, recomputed from a dual point; NaN without one.
    duals, values : mapping of str to float or array
        Multiplier, and left side minus right side in SI units, of each named constraint.
    backend : formulations.solver_report.SolverReport
        Report of the back end.
    """

    emission: Array
    estimate: NetworkEstimate | None
    cost: float
    value: float
    bound: float
    duals: Mapping[str, float | Array]
    values: Mapping[str, float | Array]
    backend: Any


class PosedNetwork:
    """The nuclear norm of a network; see `pose_network`.

    Attributes
    ----------
    emission : cvxpy expression (N,)
        Times of emission times the propagation speed, metres.
    """

    def __init__(self, network: Network, *, truncated: bool) -> None:
        self._network, self._starts = network, starts_of(likelihood(network), 0)
        self._z = (self._starts.z - self._starts.shift[:, None]) / self._starts.spread
        data, unit = nuclear_data(self._z)
        if truncated:
            found = nuclear_offsets(self._z, network.dimension)
            if np.isfinite(found.value):
                data["slope"] = truncated_slope(data, found.offset / unit, network.dimension)
        program = nuclear_problem(network.stations, network.pulses)
        for parameter in program.parameters():
            parameter.value = data[parameter.name()]
        (offset,) = program.variables()
        length = unit * self._starts.spread
        self._convex, self.emission = ConvexProgram(program, length**2), self._starts.shift + length * offset

    @property
    def problem(self) -> Any:
        """Return the relaxation as a cvxpy problem."""
        return self._convex.problem

    def add(self, constraint: Any, *, name: str | None = None) -> None:
        """Add a relation of cvxpy between times of emission.

        Parameters
        ----------
        constraint : cvxpy relation
            For instance ``posed.emission[1] - posed.emission[0] >= 300``.
        name : str, optional
            Name for duals and messages.

        Raises
        ------
        InvalidProblem
            If it is not a convex relation of this problem, or if its name is in use.
        """
        label = name or f"constraint {1 + len(self._convex.relations)}"
        if label in self._convex.relations:
            raise InvalidProblem(f"there is already a constraint {label!r}", "name", "give each its own name")
        self._convex.relations[label] = self._convex.relation(constraint, label)
        self._convex.restate()

    def minimise(self, expression: Any) -> None:
        """Replace the objective by a convex expression of your own; raise InvalidProblem for any other expression."""
        self._convex.minimise(expression)

    def solve(self, solver: str = "CLARABEL", settings: Mapping[str, Any] | None = None) -> RelaxedNetwork:
        """Return the times of emission, and the network that least squares reaches from them.

        Parameters
        ----------
        solver : str
            Name of the solver in cvxpy.
        settings : mapping, optional
            Its settings.
        """
        report = self._convex.solve(solver.upper(), settings, warm=False)
        solved = self._convex.has_solution(report)
        duals, values, value = self._convex.results(solved=solved)
        emission = np.asarray(self.emission.value) if solved else np.full(self._network.pulses, np.nan)
        estimate, cost = self._refined(emission) if solved else (None, np.nan)
        bound = self._convex.bound() if solved else np.nan
        return RelaxedNetwork(emission, estimate, cost, value, bound, duals, values, report)

    def _refined(self, emission: Array) -> tuple[NetworkEstimate | None, float]:
        """Return the cheapest minimum of the likelihood from times of emission (N,), and its cost."""
        own, network = self._starts, self._network
        offset = (emission - own.shift) / own.spread
        stations, pulses, choices = upgrade(affine_network(self._z, offset, network.dimension))
        if not len(choices):
            return None, np.nan
        times, clocks = np.repeat(emission[None], len(choices), axis=0), np.zeros((len(choices), network.stations))
        starts = NetworkEstimate(own.spread * stations, clocks, own.spread * pulses, times)
        minima, cost = likelihood(network).refine(starts)
        if not np.isfinite(cost).any():
            return None, np.nan
        best = int(np.nanargmin(cost))
        return minima.take(np.array([best])), float(cost[best])


def pose_network(network: Network, *, truncated: bool = True) -> PosedNetwork:
    """Return the problem of least nuclear norm of a network, to read, to change and to solve.

    Parameters
    ----------
    network : Network
        Arrivals at stations with one clock, none missing.
    truncated : bool
        Whether to use the objective of the last pass, in which the largest singular values are free. False: the
        objective of the first pass, the nuclear norm of all of them.

    Returns
    -------
    PosedNetwork
        The problem as ``posed.problem``, times of emission in metres, and ``add``, ``minimise`` and ``solve``.

    Raises
    ------
    InvalidProblem
        If stations have separate clocks, an arrival is missing, or there are too few arrivals.

    References
    ----------
    M. Fazel, "Matrix rank minimization with applications", PhD thesis, Stanford University, 2002.
    """
    m, n, d = network.stations, network.pulses, network.dimension
    if not (network.synchronised and network.given.all() and network.emission.all()):
        raise InvalidProblem(
            "the nuclear norm needs arrival times of one clock, none missing", "network", "use optloc.calibrate"
        )
    if max(m, n) < unknowns(d) or m <= d + 1:
        raise InvalidProblem(f"{m} stations and {n} pulses are too few", "network", "use optloc.calibrate")
    return PosedNetwork(network, truncated=truncated)
