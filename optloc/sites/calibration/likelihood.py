"""The likelihood of a network: a problem with unknown stations, refined from many estimates at once.

The network becomes a run of `optloc.problem`: each pulse is an epoch, and the station errors are constant
over the run.

Letters: S estimates, M stations, N pulses, R slots (columns of measurements), m rows of a run, d coordinates. P is the
number of station unknowns: M d coordinates, then M clocks if the stations do not share a clock. A
whitened number is divided by its standard deviation.

Arguments of many functions: `net` is the network, and `at` are estimates of all unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.engine import differentiate, predict, refine
from optloc.models import BETWEEN
from optloc.problem import Array, Bias, Measured, Motion, Problem, Stations, assemble, measured, variances
from optloc.sites.calibration.network import CLOCKED, Network

# Largest number of refinement steps, and step length in standard deviations at which the refinement ends: the
# error of the cost is then 1e-6.
_STEPS, _LAST = 100, 1e-3
# Prior standard deviation of free coordinates and clocks about their start, in standard deviations of the best
# row. It fixes the frame, which no row determines, and hardly affects the rest.
_LOOSE = 1e7
# Standard deviation of coordinates that are known exactly, as a share of the network size.
_EXACT = 1e-7


@dataclass(frozen=True, slots=True)
class NetworkEstimate:
    """Values of all unknowns, for S estimates at once.

    Parameters
    ----------
    stations : array (S, M, d)
        Station positions, metres.
    clocks : array (S, M)
        Clock offsets times the propagation speed, metres; zeros if the stations share a clock.
    pulses : array (S, N, d)
        Pulse positions, metres.
    emission : array (S, N)
        Emission times multiplied by the propagation speed, metres.
    """

    stations: Array
    clocks: Array
    pulses: Array
    emission: Array

    @property
    def count(self) -> int:
        """Return the number S of estimates."""
        return int(self.stations.shape[0])

    def take(self, which: Array | slice) -> NetworkEstimate:
        """Return a selection of the estimates (mask, indices or slice)."""
        return NetworkEstimate(self.stations[which], self.clocks[which], self.pulses[which], self.emission[which])

    def where(self, mask: Array, other: NetworkEstimate) -> NetworkEstimate:
        """Return the estimates, with values of `other` where the mask (S,) is false."""
        two, three = mask[:, None], mask[:, None, None]
        return NetworkEstimate(
            np.where(three, self.stations, other.stations),
            np.where(two, self.clocks, other.clocks),
            np.where(three, self.pulses, other.pulses),
            np.where(two, self.emission, other.emission),
        )


def together(*estimates: NetworkEstimate) -> NetworkEstimate:
    """Return several sets of estimates as one; S is the sum of their numbers."""
    names = NetworkEstimate.__dataclass_fields__
    return NetworkEstimate(*(np.concatenate([getattr(one, name) for one in estimates]) for name in names))


@dataclass(frozen=True, slots=True)
class Likelihood:
    """A network as a run: the station errors are constant over the run, and each pulse is an epoch.

    Parameters
    ----------
    network : Network
        Measurements and prior knowledge.
    problem : Problem
        The run, with placeholder station positions.
    weight : array (S, N, R), optional
        Weights of the rows for each estimate; None: all rows have weight 1.
    tether : array (S,), optional
        Prior standard deviation of free coordinates about their start, metres; None: so large that it only fixes
        the frame.
    """

    network: Network
    problem: Problem
    weight: Array | None = None
    tether: Array | None = None

    @property
    def free(self) -> Array:
        """Return a mask (P,) of the station unknowns that can change: inexact coordinates, and unknown clocks."""
        clocks = np.ones(0 if self.network.synchronised else self.network.stations, dtype=bool)
        return np.concatenate([(self.network.place_sigma > 0.0).ravel(), clocks])

    def posed(self, at: NetworkEstimate) -> tuple[Problem, Array]:
        """Return S estimates as a batch of problems, and as parameter vectors (S, size) of these problems.

        Each problem is linearised about the stations and clocks of its estimate: the stations have the estimated
        positions, and the clocks are corrections of the rows. So the vectors contain only deviations of known
        coordinates, and the pulses.
        """
        net, problem, (j, r) = self.network, self.problem, rows_of(self.network)
        # `far` is the prior sigma of free coordinates about their start: the tether, or a wide one.
        known = np.isfinite(net.place_sigma)
        place = np.where(known, net.place, at.stations)
        exact = _EXACT * (float(np.ptp(at.stations)) or 1.0)
        far = np.array(_wide_sigma(net)) if self.tether is None else self.tether[:, None, None]
        deviation = np.where(known, np.maximum(net.place_sigma, exact), far)
        covariance = deviation[..., None] ** 2 * np.eye(net.dimension)
        first, second, sign = clock_signs(net)
        clock = sign[0, r] * at.clocks[:, first[r]] + sign[1, r] * at.clocks[:, second[r]]
        # Rows of pulses come first. Rows from `len(r)` on are distances between stations: no clock, no weight.
        rows = []
        for block, start in zip(problem.rows, problem.starts, strict=True):
            part = slice(start, start + block.count)
            if not net.synchronised and start < len(r):
                block = replace(block, correction=clock[:, part])  # noqa: PLW2901
            if self.weight is not None and start < len(r):
                block = replace(block, weight=self.weight[:, j[part], r[part]])  # noqa: PLW2901
            rows.append(block)
        stations = replace(problem.stations, position=place[:, None], covariance=covariance)
        made = replace(problem, stations=stations, rows=tuple(rows))
        # only numbers differ from `problem`, so its structure and caches are valid
        vars(made).update({name: getattr(problem, name) for name in ("starts", "layout", "structure")})
        layout, x = made.layout, np.zeros((at.count, made.layout.size))
        x[:, _columns(made, "stations")] = (at.stations - place).reshape(at.count, -1)
        local = at.pulses if layout.n_local == net.dimension else np.dstack([at.pulses, at.emission])
        x[:, layout.n_shared :] = local.reshape(at.count, -1)
        return made, x

    def _estimate(self, problem: Problem, x: Array, at: NetworkEstimate) -> NetworkEstimate:
        """Return the estimates at parameter vectors x (S, size) of `problem`, the result of `posed(at)`."""
        net, local = self.network, problem.layout.split(x)[1]
        moved = problem.stations.position[:, 0] + x[:, _columns(problem, "stations")].reshape(at.stations.shape)
        stations = np.where(net.place_sigma > 0.0, moved, net.place)
        clocks = at.clocks if net.synchronised else at.clocks + x[:, _columns(problem, "clock")]
        d = net.dimension
        return NetworkEstimate(stations, clocks, local[..., :d], local[..., d] if local.shape[-1] > d else at.emission)

    def refine(self, at: NetworkEstimate, steps: int = _STEPS) -> tuple[NetworkEstimate, Array]:
        """Return the minima that the refinement of the estimates reaches, and their costs (S,).

        `steps` is the largest number of steps.
        """
        if not at.count:
            return at, np.zeros(0)
        problem, x = self.posed(at)
        done = refine(problem, x, tolerance=_LAST, limit=steps)
        return self._estimate(problem, done.x, at), done.cost

    def _whitened(self, at: NetworkEstimate) -> Array:
        """Return whitened residuals (S, m) of all m rows, without weights."""
        problem, x = self.posed(at)
        return np.asarray((problem.observed - predict(problem, x)) / np.sqrt(variances(problem.noise, problem.count)))

    def cost(self, at: NetworkEstimate) -> Array:
        """Return the sum of squared whitened residuals (S,), priors included; `weight` does not affect it."""
        place = np.where(self.network.place_sigma > 0.0, self.network.place_sigma, np.inf)
        known = (at.stations - self.network.place) / place
        return np.asarray((self._whitened(at) ** 2).sum(axis=1) + (known**2).sum(axis=(1, 2)))

    def residual(self, at: NetworkEstimate) -> Array:
        """Return whitened residuals (S, N, R) of the pulse measurements, without weights; 0 without measurement."""
        j, r = rows_of(self.network)
        out = np.zeros((at.count, *self.network.z.shape))
        out[:, j, r] = self._whitened(at)[:, : len(j)]
        return out

    def jacobian(self, at: NetworkEstimate) -> tuple[Array, Array, Array]:
        """Return the whitened derivatives of the rows at one estimate.

        Parameters
        ----------
        at : NetworkEstimate
            The estimate, S = 1.

        Returns
        -------
        by_station : array (N, R, P)
            Derivatives of pulse rows by station coordinates and clocks.
        by_pulse : array (N, R, d or d + 1)
            Derivatives of pulse rows by position and emission time of the pulse.
        known : array (q, P)
            Derivatives of the rows for distances between stations and for prior coordinates.
        """
        net, (j, r) = self.network, rows_of(self.network)
        problem, x = self.posed(at)
        jacobian, n = differentiate(problem, x)[1][0], problem.layout.n_shared
        jacobian = jacobian / np.sqrt(variances(problem.noise, problem.count))[:, None]
        names = ("stations",) if net.synchronised else ("stations", "clock")
        shared = jacobian[:, np.concatenate([_columns(problem, name) for name in names])] * self.free
        by_station = np.zeros((*net.z.shape, shared.shape[1]))
        by_pulse = np.zeros((*net.z.shape, problem.layout.n_local))
        by_station[j, r], by_pulse[j, r] = shared[: len(j)], jacobian[: len(j), n:]
        place = np.where(net.place_sigma > 0.0, net.place_sigma, np.inf).ravel()
        soft = np.flatnonzero(np.isfinite(place))
        prior = np.eye(shared.shape[1])[soft] / place[soft, None]
        return by_station, by_pulse, np.concatenate([shared[len(j) :], prior])


def likelihood(net: Network) -> Likelihood:
    """Return the likelihood of a network, with weight 1 for all rows."""
    m, d, (j, r) = net.stations, net.dimension, rows_of(net)
    first, second, _ = clock_signs(net)
    rows = list[Measured]()
    for kind, part in _rows_by_kind(net, r):
        ends = {"a": first[r[part]], "b": second[r[part]]}
        rows.append(measured(kind, net.z[j, r][part], sigma=net.sigma[j, r][part], epoch=j[part], **ends))
    if len(net.between):
        a, b = net.between.T
        rows.append(measured(BETWEEN, net.distance, a=a, b=b, sigma=net.distance_sigma))
    stations = Stations(np.zeros((1, m, d)), net.names, covariance=np.tile(np.eye(d), (m, 1, 1)), span="run")
    biases, motion = () if net.synchronised else (_clock_bias(net, r),), Motion(span="epoch")
    return Likelihood(
        net, assemble(stations, *rows, times=np.arange(float(net.pulses)), motions=(motion,), biases=biases)
    )


def _wide_sigma(net: Network) -> float:
    """Return the wide prior standard deviation of free coordinates and clocks, metres."""
    return _LOOSE * float(min(net.sigma.min(), *net.distance_sigma, np.inf))


def clock_signs(net: Network) -> tuple[Array, Array, Array]:
    """Return the stations a (R,) and b (R,) of each slot, and the signs (2, R) of their clocks in the measurement.

    A sign is 1, -1 or 0 (no effect). For slots without a second station, b is 0 and its sign is 0.
    """
    first = np.array([slot.a for slot in net.slots])
    second = np.array([max(slot.b, 0) for slot in net.slots])
    sign = [[float(slot.kind in CLOCKED), -1.0 * (slot.kind == "tdoa")] for slot in net.slots]
    return first, second, np.array(sign).T


def _rows_by_kind(net: Network, r: Array) -> list[tuple[str, Array]]:
    """Return each kind with the indices of its rows; `r` (m,) is the slot of each of the m rows."""
    kinds = np.array([slot.kind for slot in net.slots])[r]
    return [(kind, np.flatnonzero(kinds == kind)) for kind in dict.fromkeys(kinds.tolist())]


def rows_of(net: Network) -> tuple[Array, Array]:
    """Return pulse (m,) and slot (m,) of each measurement, in the row order of the problem: kind by kind."""
    j, r = np.nonzero(net.given)
    order = np.concatenate([part for _, part in _rows_by_kind(net, r)])
    return j[order], r[order]


def _clock_bias(net: Network, r: Array) -> Bias:
    """Return the clock offsets of the stations as a bias, metres, relative to their start values.

    `r` (m,) is the slot of each row.
    """
    first, second, sign = clock_signs(net)
    row, member = np.tile(np.arange(len(r)), 2), np.concatenate([first[r], second[r]])
    sign = np.concatenate([sign[0, r], sign[1, r]])
    used, m = sign != 0.0, net.stations
    return Bias(
        "clock", net.names, row[used], member[used], sign[used], mean=np.zeros(m), sigma=np.full(m, _wide_sigma(net))
    )


def _columns(problem: Problem, name: str) -> Array:
    """Return the indices of the unknown `name` in the shared parameter vector."""
    slot, _ = problem.layout.find(name)
    return np.arange(slot.start, slot.start + slot.size)
