"""`pose_network`: the times of emission of a network of least nuclear norm, as a problem that users change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from formulations.metric_upgrade import unknowns, upgrade
from formulations.nuclear_norm import affine_network, nuclear_data, nuclear_offsets, nuclear_problem, truncated_slope
from optloc.problem import Array, InvalidProblem, PosedSolution
from optloc.sites.calibration.likelihood import NetworkEstimate, likelihood
from optloc.sites.calibration.network import Network
from optloc.sites.calibration.restarts import starts_of
from optloc.solvers import ConvexProgram, PosedProblem


@dataclass(frozen=True, slots=True, kw_only=True)
class RelaxedNetwork(PosedSolution):
    """The solution of a posed network; bound, duals, values and report are as in `optloc.problem.PosedSolution`.

    Parameters
    ----------
    value : float
        Objective: square metres, unless the objective is your own; NaN without a solution.
    emission : array (N,)
        Times of emission times the propagation speed, metres; NaN without a solution.
    estimate : NetworkEstimate, optional
        Minimum of the likelihood that least squares reaches from these times; None if they give no network.
    cost : float
        Its chi-square; NaN without an estimate.
    """

    emission: Array
    estimate: NetworkEstimate | None
    cost: float


class PosedNetwork(PosedProblem):
    """The nuclear norm of a network, with relations such as ``posed.emission[1] - posed.emission[0] >= 300``.

    See `pose_network`.

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
        self.emission = self._starts.shift + length * offset
        self._convex = ConvexProgram(
            program, length**2, example="posed.emission[0] <= 300", instead="use a convex expression"
        )
        super().__init__(self._convex)

    def solve(self, solver: str = "CLARABEL", settings: Mapping[str, Any] | None = None) -> RelaxedNetwork:
        """Return the times of emission, and the network that least squares reaches from them.

        Parameters
        ----------
        solver : str
            Name of the solver in cvxpy.
        settings : mapping, optional
            Its settings.
        """
        found = self._convex.solution(solver, settings)
        solved = self._convex.has_solution(found.backend)
        emission = np.asarray(self.emission.value) if solved else np.full(self._network.pulses, np.nan)
        estimate, cost = self._refined(emission) if solved else (None, np.nan)
        return RelaxedNetwork(**found.by_name(), emission=emission, estimate=estimate, cost=cost)

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
