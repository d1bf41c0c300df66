"""The valley of a curved likelihood: a curve of almost constant cost, traced from the fix in both directions.

Ranges from stations on a line leave a circle around it. Ranges from stations in a plane leave an arc through the fix
and its mirror image. Along such a curve no Gaussian covers; across it a Gaussian does.

A *node* is a point of the curve. Its coordinates z are metres, or coordinates of the inverse-range chart. The chart
(`optloc.problem.chart`) has a direction p and an inverse range w, which is 1 at the fix and 0 at infinity. Costs are
chi-square values. Letters: m nodes, n samples, q points, d coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optloc.base.types import Array
from optloc.model_checks.shape import cost_at_infinity
from optloc.problem.chart import CARTESIAN, basis, jacobian
from optloc.problem.fix import Fix
from optloc.problem.problem import Problem
from optloc.uncertainty.region import RegionSurface

# Corrections across the curve, in standard deviations: below _EASY the next step is longer, above _HARD the step is
# tried again. A step that changes the cost by more than _JUMP is tried again too. A circle takes 300 nodes, an arc 40.
_EASY, _HARD, _JUMP = 1.5, 4.0, 1.5
_LONGER, _SHORTER = 1.5, 0.5
# Excess of the cost over the fix at which a curve ends: a share of 4e-6 of the density remains.
_END = 25.0
# First step in standard deviations along the curve, most nodes in each direction, and most corrections of a node.
_FIRST, _NODES, _CORRECTIONS = 0.2, 400, 3
# Length of the last correction of a good node, standard deviations.
_SETTLED = 0.05
# Least step, as a share of the first: at shorter steps the curve has an end or a branch.
_TINY = 1e-6
# Factor of the spread of samples across the curve: chords leave the curve by a standard deviation.
_WIDER = 1.3
# Least w of a node in the inverse-range chart; zero is infinity.
_LEAST_W = 1e-6


@dataclass(frozen=True, slots=True)
class Arc:
    """A curve of least cost through a fix.

    Parameters
    ----------
    surface : RegionSurface
        The cost, and the fix.
    far : bool
        Whether it is traced in the inverse-range chart, because the data do not exclude infinity; else in metres.
    node : array (m, d)
        Points along it, metres, or chart coordinates p and w.
    cost : array (m,)
        Their costs.
    across : array (m, d, d - 1)
        Standard deviations across the curve, in columns, in the coordinates of the nodes.
    closed : bool
        Whether the last node equals the first.
    """

    surface: RegionSurface
    far: bool
    node: Array
    cost: Array
    across: Array
    closed: bool

    @property
    def position(self) -> Array:
        """Return the nodes as positions (m, d), metres."""
        return self._to_position(self.node)

    @property
    def mass(self) -> Array:
        """Return the share (m - 1,) of the probability between neighbouring nodes, for a uniform prior."""
        density = self._density()
        mass = self._lengths() * 0.5 * (density[1:] + density[:-1])
        return np.asarray(mass / mass.sum())

    def locate(self, points: Array) -> tuple[Array, Array]:
        """Return the coordinates of points along the curve, and their distances from it.

        Parameters
        ----------
        points : array (q, d)
            Metres.

        Returns
        -------
        share : array (q,)
            Share of the probability before each point along the curve: 0.025 to 0.975 contains 95 %.
        beside : array (q,)
            Distance across the curve, standard deviations.
        """
        z = self.surface.chart.to_chart(points) if self.far else np.asarray(points)
        start, chord = self.node[:-1], np.diff(self.node, axis=0)
        length = np.maximum((chord**2).sum(-1), np.finfo(float).tiny)
        fraction = np.clip(((z[:, None] - start) * chord).sum(-1) / length, 0.0, 1.0)
        apart = z[:, None] - start - fraction[..., None] * chord
        nearest = (apart**2).sum(-1).argmin(1)
        index = np.arange(len(z))
        before = np.append(0.0, np.cumsum(self.mass))
        share = before[nearest] + fraction[index, nearest] * self.mass[nearest]
        across = np.linalg.pinv(self.across[nearest]) @ apart[index, nearest][..., None]
        return share, np.sqrt((across[..., 0] ** 2).sum(-1))

    def draw(self, n: int, seed: int) -> tuple[Array, Array, Array]:
        """Return samples from along the curve.

        Parameters
        ----------
        n : int
            Number of samples.
        seed : int
            Seed of the draw.

        Returns
        -------
        position : array (n, d)
            Metres.
        log_weight : array (n,)
            Logarithms of their weights up to a constant, for a uniform prior in the coordinates of the nodes.
        share : array (n,)
            Coordinates along the curve at which they were drawn, see `locate`.
        """
        mass, d = self.mass, self.node.shape[-1]
        spaced, offsets, density = student(d - 1, n, seed)
        before = np.append(0.0, np.cumsum(mass))
        # number of the chord between two nodes, in proportion to the probability of the chords
        piece = np.searchsorted(before[1:-1], spaced, side="right")
        fraction = np.clip((spaced - before[piece]) / np.where(mass[piece] > 0.0, mass[piece], 1.0), 0.0, 1.0)
        along = self.node[piece] + fraction[:, None] * np.diff(self.node, axis=0)[piece]
        z = along + _WIDER * (self.across[piece] @ offsets[..., None])[..., 0]
        with np.errstate(divide="ignore"):
            density = density + np.log(mass[piece] / self._lengths()[piece]) - self._log_width()[piece]
        good = z[:, -1] > _LEAST_W if self.far else np.ones(n, dtype=bool)
        position = self._to_position(np.where(good[:, None], z, along))
        cost = self.surface.cost(position)
        return position, np.where(good, -0.5 * (cost - self.surface.least) - density, -np.inf), spaced

    def _to_position(self, z: Array) -> Array:
        """Return the positions (..., d), metres, of node coordinates (..., d)."""
        return self.surface.chart.to_position(z) if self.far else z

    def _lengths(self) -> Array:
        """Return the lengths (m - 1,) of the chords between nodes, in the unit of their coordinates."""
        return np.asarray(np.sqrt((np.diff(self.node, axis=0) ** 2).sum(-1)))

    def _log_width(self) -> Array:
        """Return the logarithms (m,) of the volumes that one standard deviation across the curve spans at each node."""
        gram = np.swapaxes(self.across, -1, -2) @ self.across
        return np.asarray(0.5 * np.linalg.slogdet(gram)[1])

    def _density(self) -> Array:
        """Return the density (m,) along the curve: Laplace's integral of the likelihood across it."""
        return np.asarray(np.exp(-0.5 * (self.cost - self.surface.least) + self._log_width()))


def trace_arc(problem: Problem, fix: Fix) -> Arc:
    """Return the curve along which the data hardly determine a fix, traced in both directions.

    Parameters
    ----------
    problem : Problem
        The problem of the fix: one static position.
    fix : Fix
        A single fix.

    Notes
    -----
    Steps follow the axis of least information, and Gauss-Newton corrects them across it. The curve ends if the cost
    exceeds the cost of the fix by 25, or if the curve returns to the fix.
    """
    return trace_from(RegionSurface.of(problem, fix))


def trace_from(surface: RegionSurface) -> Arc:
    """Return the curve through the fix of a surface, see `trace_arc`."""
    endless = cost_at_infinity(surface.problem, surface.x)[0] <= surface.least + _END
    far = bool(endless and surface.kind != CARTESIAN and surface.chart.distance > 0.0)
    valley = _Valley(surface, far)
    start, first = valley.start()
    one, closed = valley.walk(start, first)
    nodes = one
    if not closed:
        other, closed = valley.walk(start, -first)
        # the nodes of the other direction in reverse order, without the fix, which is the first node of `one`
        nodes = other[:0:-1] + one
    if closed:
        # A closed curve is cut at its least likely node, and shares count from there.
        least = int(np.argmax([node.cost for node in nodes]))
        nodes = nodes[least:] + nodes[:least]
        nodes.append(nodes[0])
    return Arc(
        surface,
        far,
        np.array([node.z for node in nodes]),
        np.array([node.cost for node in nodes]),
        np.array([node.across for node in nodes]),
        closed,
    )


@dataclass(frozen=True, slots=True)
class _Node:
    """A point of the curve.

    `z` (d,) are its coordinates, `cost` its cost, and `along` (d,) the unit direction of the curve. `across` (d, d - 1)
    are standard deviations across the curve, in columns.
    """

    z: Array
    cost: float
    along: Array
    across: Array


@dataclass(frozen=True, slots=True)
class _Valley:
    """The cost in the coordinates in which a curve is traced: metres, or the inverse-range chart if `far`."""

    surface: RegionSurface
    far: bool

    def look(self, z: Array) -> tuple[float, Array, Array]:
        """Return cost, information (d, d) and half the downhill gradient (d,) at coordinates z (d,)."""
        if not self.far:
            cost, information, vector = self.surface.look(z)
            return float(cost), information, vector
        chart = self.surface.chart
        cost, information, vector = self.surface.look(chart.to_position(z))
        G = jacobian(z, chart.position, chart.centre)
        return float(cost), G.T @ information @ G, G.T @ vector

    def start(self) -> tuple[_Node, Array]:
        """Return the fix as a node, and the first step (d,) along the direction of least information."""
        z = self.surface.chart.mean if self.far else self.surface.position
        cost, information, _ = self.look(z)
        values, vectors = np.linalg.eigh(information)
        node = self._node(z, cost, information, vectors[:, 0])
        size = _FIRST / np.sqrt(max(values[0], 1e-12 * values[-1]))
        return node, size * vectors[:, 0]

    def walk(self, start: _Node, first: Array) -> tuple[list[_Node], bool]:
        """Return the nodes in the direction of the first step (d,), and whether the curve has returned to the fix.

        The first node is the fix, `start`.
        """
        size = least = float(np.sqrt((first**2).sum()))
        least *= _TINY
        nodes, along = [start], first / size
        while len(nodes) < _NODES and size > least:
            here = nodes[-1]
            found, moved = self._settle(here.z + size * along, along)
            if found is None or moved > _HARD or abs(found.cost - here.cost) > _JUMP:
                size *= _SHORTER
                continue
            # the first chords begin at the fix or near it, so they are not tested
            if len(nodes) > 3 and self._passes(start, here, found):
                return nodes, True
            nodes.append(found)
            if found.cost > self.surface.least + _END:
                break
            along = found.along
            size *= _LONGER if moved < _EASY else 1.0
        return nodes, False

    def _settle(self, z: Array, along: Array) -> tuple[_Node | None, float]:
        """Return the node next to coordinates z (d,), and the first correction in standard deviations.

        `along` (d,) is the direction of the curve before. Without a node the result is None and infinity.
        """
        moved = 0.0
        for number in range(_CORRECTIONS + 1):
            if self.far and not z[-1] > _LEAST_W:
                return None, np.inf
            cost, information, vector = self.look(z)
            if not (np.isfinite(cost) and np.isfinite(information).all()):
                return None, np.inf
            weakest = np.linalg.eigh(information)[1][:, 0]
            along = weakest if weakest @ along > 0.0 else -weakest
            node = self._node(z, cost, information, along)
            # Gauss-Newton step across the curve, in standard deviations
            step = node.across.T @ vector
            size = float(np.sqrt((step**2).sum()))
            moved = size if number == 0 else moved
            if size < _SETTLED or number == _CORRECTIONS:
                return node, moved
            z = z + node.across @ step
        return None, np.inf

    def _node(self, z: Array, cost: float, information: Array, along: Array) -> _Node:
        """Return the node at coordinates z (d,), with one standard deviation across the curve.

        `along` (d,) is the unit direction of the curve, and `information` (d, d) is in the coordinates of the node.
        """
        sides = basis(along)
        values, vectors = np.linalg.eigh(sides.T @ information @ sides)
        root = vectors / np.sqrt(np.maximum(values, np.finfo(float).tiny))
        return _Node(z, cost, along, sides @ root)

    def _passes(self, start: _Node, here: _Node, there: _Node) -> bool:
        """Return whether the chord between two nodes passes near the node `start`, so that the curve is closed."""
        chord, away = there.z - here.z, start.z - here.z
        share = (away @ chord) / max(chord @ chord, np.finfo(float).tiny)
        offset = np.linalg.pinv(there.across) @ (away - share * chord)
        return bool(0.0 < share <= 1.0 and np.sqrt((offset**2).sum()) < _HARD)


# Points from which samples are drawn: a Student distribution, spread evenly.

# Student's degrees of freedom: tails heavier than a Gaussian's keep the weights of far samples small.
_DEGREES = 5.0


def student(d: int, n: int, seed: int) -> tuple[Array, Array, Array]:
    """Return evenly spread points of a Student distribution, each with one more number.

    Parameters
    ----------
    d, n : int
        Dimensions and number of points.
    seed : int
        Seed of the draw.

    Returns
    -------
    spare : array (n,)
        Numbers between 0 and 1, spread evenly together with the points.
    points : array (n, d)
        Of scale one.
    log_density : array (n,)
        Logarithm of the density there up to a constant.
    """
    from scipy.special import gammaincinv, ndtri
    from scipy.stats import qmc

    # n need not be a power of two: the lost balance is negligible against the effect of the weights
    spaced = qmc.Sobol(d + 2, rng=np.random.default_rng(seed)).random_base2(int(np.ceil(np.log2(max(n, 2)))))[:n]
    spaced = np.clip(spaced, np.finfo(float).eps, 1.0 - np.finfo(float).eps)
    stretch = np.sqrt(_DEGREES / (2.0 * gammaincinv(0.5 * _DEGREES, spaced[:, 1])))
    points = ndtri(spaced[:, 2:]) * stretch[:, None]
    return spaced[:, 0], points, -0.5 * (_DEGREES + d) * np.log1p((points**2).sum(-1) / _DEGREES)
