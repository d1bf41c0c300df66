"""The likelihood of networks: costs, normal equations without the pulses, and their minimum, of many starts at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array
from optloc.calibration.descent import (
    EASE,
    FINAL,
    FIRST,
    FLOOR,
    HELD,
    LEAST,
    MOST,
    NOTHING,
    SETTLED,
    SHORT,
    STIFFEN,
    Rows,
    State,
    descend,
)
from optloc.calibration.network import CLOCKED, Network
from optloc.compute.jit import usable
from optloc.models import MODELS

# Steps of a refinement.
_STEPS = 100
# Numbers that the table of derivatives holds at a time: 64 MB.
_HELD = 8_000_000


@dataclass(frozen=True, slots=True)
class Estimate:
    """Values of all unknowns, of S estimates at once.

    Parameters
    ----------
    stations : array (S, M, d)
        Metres.
    clocks : array (S, M)
        Offsets times the speed of propagation, metres; zeros where the stations share a clock.
    pulses : array (S, N, d)
        Metres.
    emission : array (S, N)
        Times of emission times the speed of propagation, metres.
    """

    stations: Array
    clocks: Array
    pulses: Array
    emission: Array

    @property
    def count(self) -> int:
        """Return how many estimates there are."""
        return int(self.stations.shape[0])

    def take(self, which: Array | slice) -> Estimate:
        """Return some of the estimates (mask, indices or slice)."""
        return Estimate(self.stations[which], self.clocks[which], self.pulses[which], self.emission[which])

    def where(self, mask: Array, other: Estimate) -> Estimate:
        """Return the other's values where the mask (S,) is false."""
        two, three = mask[:, None], mask[:, None, None]
        return Estimate(
            np.where(three, self.stations, other.stations),
            np.where(two, self.clocks, other.clocks),
            np.where(three, self.pulses, other.pulses),
            np.where(two, self.emission, other.emission),
        )


def together(*estimates: Estimate) -> Estimate:
    """Return all estimates of several."""
    names = Estimate.__dataclass_fields__
    return Estimate(*(np.concatenate([getattr(one, name) for one in estimates]) for name in names))


@dataclass(frozen=True, slots=True)
class Likelihood:
    """A network as arrays that do not change while it is refined: see `likelihood`."""

    network: Network
    first: Array  # (R,) stations of each slot, and what their ranges, clocks and the emission count
    second: Array
    gains: Array
    ticks: Array
    emits: Array
    root: Array  # (N, R) inverse standard deviations, or (S, N, R) of each estimate
    prior: Array  # (M, d) the same of what is known of places; zero where exact
    free: Array  # (P,) which station unknowns move
    emission: Array  # (N,)
    hold: Array  # (0, 0, P), or (S, h, P) linear functions of station unknowns that keep their values

    def residual(self, at: Estimate) -> Array:
        """Return whitened residuals (S, N, R) of the measurements of pulses."""
        predicted = at.emission[..., None] * self.emits
        for end, gain, tick in zip((self.first, self.second), self.gains, self.ticks, strict=True):
            line = at.stations[:, None, end] - at.pulses[:, :, None]
            predicted = predicted + gain * np.sqrt(np.sum(line * line, axis=-1)) + tick * at.clocks[:, None, end]
        return np.asarray((self.network.z - predicted) * self.root)

    def spans(self, at: Estimate) -> tuple[Array, Array]:
        """Return whitened residuals of distances between stations (S, q), and their unit vectors over sigma."""
        i, k = self.network.between.T
        line = at.stations[:, i] - at.stations[:, k]
        length = np.maximum(np.sqrt(np.sum(line * line, axis=-1)), 1e-300)
        weight = 1.0 / self.network.distance_sigma
        return (self.network.distance - length) * weight, line * (weight / length)[..., None]

    def cost(self, at: Estimate) -> Array:
        """Return the weighted sum of squared residuals, (S,)."""
        return self.total(at, self.residual(at))

    def total(self, at: Estimate, residual: Array) -> Array:
        """Return the cost, the whitened residuals given."""
        known = (at.stations - self.network.place) * self.prior
        apart = self.spans(at)[0]
        return np.asarray((residual**2).sum(axis=(1, 2)) + (known**2).sum(axis=(1, 2)) + (apart**2).sum(axis=1))

    def jacobian(self, at: Estimate) -> tuple[Array, Array]:
        """Return whitened derivatives of predictions: by station unknowns (S, N, R, P) and by pulses (S, N, R, d + 1).

        Station unknowns are the M d coordinates, and the M clocks where these are sought.
        """
        s, (n, r), m, d = at.count, self.network.z.shape, self.network.stations, self.network.dimension
        by_station = np.zeros((s, n, r, self.free.size))
        by_pulse = np.zeros((s, n, r, d + 1))
        every = np.arange(r)
        for end, gain, tick in zip((self.first, self.second), self.gains, self.ticks, strict=True):
            line = at.stations[:, None, end] - at.pulses[:, :, None]
            length = np.maximum(np.sqrt(np.sum(line * line, axis=-1)), 1e-300)
            unit = line * (gain * self.root / length)[..., None]
            for c in range(d):
                by_station[:, :, every, end * d + c] += unit[..., c]
            by_pulse[..., :d] -= unit
            if not self.network.synchronised:
                by_station[:, :, every, m * d + end] += tick * self.root
        by_pulse[..., d] = self.emits * self.root
        by_station[..., ~self.free] = 0.0
        return by_station, by_pulse

    def known(self, at: Estimate) -> tuple[Array, Array]:
        """Return whitened residuals (S, q) and derivatives (S, q, P) of distances between stations and of priors."""
        m, d = self.network.stations, self.network.dimension
        apart, unit = self.spans(at)
        q = apart.shape[1]
        out = np.zeros((at.count, q, self.free.size))
        for c in range(d):
            out[:, np.arange(q), self.network.between[:, 0] * d + c] = unit[..., c]
            out[:, np.arange(q), self.network.between[:, 1] * d + c] = -unit[..., c]
        which = np.flatnonzero(self.prior.ravel() > 0.0)
        rows = np.zeros((len(which), self.free.size))
        rows[np.arange(len(which)), which] = self.prior.ravel()[which]
        offset = ((self.network.place - at.stations) * self.prior).reshape(at.count, m * d)[:, which]
        rows = np.broadcast_to(rows, (at.count, *rows.shape))
        jacobian = np.concatenate([out, rows], axis=1)
        jacobian[..., ~self.free] = 0.0
        return np.concatenate([apart, offset], axis=1), jacobian

    def refine(self, at: Estimate, steps: int = _STEPS) -> tuple[Estimate, Array]:
        """Return the minima that estimates lead to, and their costs (S,).

        Levenberg and Marquardt with the pulses eliminated: each is a block of d + 1 unknowns of its own.
        """
        n, r = self.network.z.shape
        if usable(descend, at.count * n):
            return self._descended(at, steps)
        size = max(1, _HELD // (n * r * self.free.size))
        parts = [np.arange(i, min(i + size, at.count)) for i in range(0, at.count, size)]
        found = [self.of(part).refine_together(at.take(part), steps) for part in parts]
        return together(*(one[0] for one in found)), np.concatenate([one[1] for one in found])

    def _descended(self, at: Estimate, steps: int) -> tuple[Estimate, Array]:
        net = self.network
        root = self.root.reshape(-1, *net.z.shape)
        known = (net.place, self.prior, self.free, net.between, net.distance, 1.0 / net.distance_sigma, self.hold)
        slots = (self.first, self.second, self.gains, self.ticks, self.emits, self.emission)
        # Row after row: machine code is of one order of arrays, and would be made anew for each other.
        rows = Rows(*(np.array(array, order="C") for array in (net.z, root, *slots, *known)))
        made = [np.array(getattr(at, name), order="C") for name in State._fields]
        cost = np.zeros(at.count)
        descend(rows, State(*made), cost, steps)
        return Estimate(*made), cost

    def of(self, which: Array) -> Likelihood:
        """Return this for some of the estimates, where each has weights or a held function of its own."""
        root = self.root[which] if self.root.ndim == 3 else self.root
        return replace(self, root=root, hold=self.hold[which] if len(self.hold) else self.hold)

    def refine_together(self, at: Estimate, steps: int = _STEPS) -> tuple[Estimate, Array]:
        """Refine estimates side by side in numpy: what `refine` does where there is no machine code."""
        out, cost = at.take(np.arange(at.count)), np.full(at.count, np.inf)
        left = np.arange(at.count)
        damping, settled = np.full(at.count, FIRST), np.zeros(at.count, dtype=int)
        for _ in range(steps):
            here, own = out.take(left), self.of(left)
            residual = own.residual(here)
            before = own.total(here, residual)
            there = own.step(here, residual, damping[left])
            after = own.total(there, own.residual(there))
            good = after < before
            now = there.where(good, here)
            out = _put(out, left, now)
            cost[left] = np.where(good, after, before)
            damping[left] = np.clip(damping[left] * np.where(good, EASE, STIFFEN), LEAST, MOST)
            # a bad step says nothing before damping has made it short
            small = (before - cost[left] <= SETTLED * (1.0 + before)) & (good | (damping[left] > SHORT))
            settled[left] = np.where(small, settled[left] + 1, 0)
            left = left[(settled[left] < FINAL) & np.isfinite(cost[left])]
            if not left.size:
                break
        return out, cost

    def step(self, at: Estimate, residual: Array, damping: Array) -> Estimate:
        """Return where a damped step of Gauss and Newton leads."""
        by_station, by_pulse = self.jacobian(at)
        extra, rows = self.known(at)
        s, n, r, p = by_station.shape
        inner, coupling, gradient = eliminated(by_station, by_pulse, residual, damping, self.emission)
        flat = by_station.reshape(s, n * r, p)
        normal = np.swapaxes(flat, 1, 2) @ flat + np.swapaxes(rows, 1, 2) @ rows
        largest = np.einsum("sii->si", normal).max(axis=1)
        _damp(normal, damping)
        _hold(normal, self.free)
        coupled = coupling.reshape(s, -1, p)
        right = np.einsum("sqp,sq->sp", flat, residual.reshape(s, -1)) + np.einsum("sqp,sq->sp", rows, extra)
        right = right - np.einsum("sqp,sq->sp", coupled, gradient.reshape(s, -1))
        normal -= np.swapaxes(coupled, 1, 2) @ coupled
        if len(self.hold):
            normal += (HELD * largest)[:, None, None] * (np.swapaxes(self.hold, 1, 2) @ self.hold)
        step = _solved(normal, right)
        local = gradient - (coupled @ step[..., None]).reshape(gradient.shape)
        found = np.linalg.solve(np.swapaxes(inner, -1, -2), local[..., None])[..., 0]
        m, d = self.network.stations, self.network.dimension
        clocks = at.clocks if self.network.synchronised else at.clocks + step[:, m * d :]
        return Estimate(
            at.stations + step[:, : m * d].reshape(s, m, d),
            clocks,
            at.pulses + found[..., :d],
            at.emission + np.where(self.emission, found[..., d], 0.0),
        )


def likelihood(network: Network) -> Likelihood:
    """Return the likelihood of a network.

    Parameters
    ----------
    network : Network
        What was measured.

    Returns
    -------
    Likelihood
        Costs, derivatives and minima. ``h = gain_a r_a + gain_b r_b`` and the emission are those of `MODELS`.
    """
    models = [MODELS[slot.kind] for slot in network.slots]
    clocked = np.array([float(slot.kind in CLOCKED) for slot in network.slots])
    gains = np.array([model.ranges for model in models], dtype=float).T
    exact = network.place_sigma <= 0.0
    with np.errstate(divide="ignore"):
        prior = np.where(exact, 0.0, 1.0 / network.place_sigma)
        root = 1.0 / network.sigma
    clocks = np.ones(0 if network.synchronised else network.stations, dtype=bool)
    return Likelihood(
        network,
        np.array([slot.a for slot in network.slots]),
        np.array([max(slot.b, 0) for slot in network.slots]),
        gains,
        gains * clocked,
        np.array([float(model.emission) for model in models]),
        root,
        prior,
        np.concatenate([~exact.ravel(), clocks]),
        network.emission,
        np.zeros((0, 0, exact.size + clocks.size)),
    )


def eliminated(
    by_station: Array, by_pulse: Array, residual: Array, damping: Array, emission: Array
) -> tuple[Array, Array, Array]:
    """Eliminate pulses from the normal equations.

    Parameters
    ----------
    by_station, by_pulse : array (S, N, R, P), (S, N, R, d + 1)
        Whitened derivatives.
    residual : array (S, N, R)
        Whitened residuals.
    damping : array (S,)
        Share of the diagonal that is added to it.
    emission : bool array (N,)
        Pulses whose last unknown is sought.

    Returns
    -------
    inner : array (S, N, d + 1, d + 1)
        Cholesky factors L of each pulse's block.
    coupling : array (S, N, d + 1, P)
        ``L^-1`` times the block's coupling to the stations.
    gradient : array (S, N, d + 1)
        ``L^-1`` times the block's gradient.
    """
    turned = np.swapaxes(by_pulse, -1, -2)
    block = turned @ by_pulse
    flat = block.reshape(-1, *block.shape[-2:])
    _damp(flat, np.repeat(damping, block.shape[1]))
    block = flat.reshape(block.shape)
    block[:, ~emission, -1, -1] = 1.0
    inner = np.linalg.cholesky(block)
    both = np.concatenate([turned @ by_station, turned @ residual[..., None]], axis=-1)
    solved = np.linalg.solve(inner, both)
    return inner, solved[..., :-1], solved[..., -1]


def _damp(normal: Array, damping: Array) -> None:
    """Add shares of the diagonal, and a little of its largest entry, which alone holds what no row sees."""
    diagonal = np.einsum("sii->si", normal)
    diagonal += damping[:, None] * diagonal + FLOOR * diagonal.max(axis=1, keepdims=True) + NOTHING


def _hold(normal: Array, free: Array) -> None:
    held = np.flatnonzero(~free)
    normal[:, held, held] = 1.0


def _solved(normal: Array, right: Array) -> Array:
    """Solve for each start; a singular system leaves its start where it is."""
    try:
        return np.linalg.solve(normal, right[..., None])[..., 0]
    except np.linalg.LinAlgError:
        size = normal.shape[-1]
        scale = np.einsum("sii->s", normal) / size
        lifted = normal + (1e-10 * scale)[:, None, None] * np.eye(size)
        return np.linalg.solve(lifted, right[..., None])[..., 0]


def _put(into: Estimate, which: Array, part: Estimate) -> Estimate:
    for name in Estimate.__dataclass_fields__:
        getattr(into, name)[which] = getattr(part, name)
    return into
