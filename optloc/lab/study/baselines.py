"""Baselines for comparison: iterations from a guess, methods of papers, general tools, weak relaxations.

No baseline searches for another minimum, and some claim every result as an answer. A study judges their answers by the
lowest cost that any method finds.

Letters in shapes: N problems (trials), m rows, s stations, d coordinates. `size` is the length of a parameter vector:
all unknowns of a problem in the order of its layout.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from formulations.backend import count
from optloc.engine import (
    WEIGHINGS,
    WORTH,
    centre_and_spread,
    depends_on_place,
    differentiate,
    equations_at,
    map_on_threads,
    one_position,
    prior_parts,
    step,
    vectors,
    with_station_noise,
)
from optloc.lab.study.networks import NetworkResult, Networks, each, from_truth, refined
from optloc.lab.study.simulation import DrawnCase
from optloc.models import MODELS
from optloc.problem import (
    Array,
    Fix,
    InvalidProblem,
    Problem,
    Registry,
    Stage,
    Status,
    has_correlated_epochs,
    whiten,
    window,
)
from optloc.sites.calibration.likelihood import NetworkEstimate, likelihood
from optloc.sites.calibration.network import Network
from optloc.sites.calibration.restarts import starts_of
from optloc.solvers import given, judge, judge_points, offer, range_rows, spread_of

_ASIDE = 0.2
"""Width of the box of random centres, in radii of the array. The random centre misses every station, and its distances
to all stations are similar."""

_FIRST = 40
"""First epochs that the recursion uses together, as in the paper: its first normal equations are then regular."""

_EVALUATIONS = 200
"""Most evaluations of SciPy: ten times the number that a good start takes (8 to 20 in shipped studies)."""


def start_of(kind: str, width: float, drawn: DrawnCase) -> Array:
    """Return the starting vectors (N, size) of trials: the truth, or a position near the stations and zeros elsewhere.

    Parameters
    ----------
    kind : str
        "truth", "centre" of the stations, or "box": at random in a box around the centre. The centre is shifted at
        random by at most a tenth of the stations' spread in each coordinate, because ranges have no derivative at a
        station.
    width : float
        Width of the box, metres.
    drawn : DrawnCase
        The trials. They contain the points in the box, so that all methods start at the same points.
    """
    if kind == "truth":
        return drawn.truth
    centre, radius = centre_and_spread(drawn.problem.stations.places)
    place = centre + (width if kind == "box" else _ASIDE * radius[..., None]) * drawn.wild
    start = np.zeros_like(drawn.truth)
    slot, _ = drawn.problem.layout.find(drawn.position)
    start[:, slot.start : slot.start + slot.size] = place
    return start


# Iterations of the papers, for any problem.


def single_step(problem: Problem, start: Array) -> Array:
    """Return the vectors (N, size) after one Gauss-Newton step from `start` (N, size); NaN for singular equations."""
    with np.errstate(all="ignore"):
        return _full_step(problem, start)


def recursion(problem: Problem, start: Array, *, iterations: int = 2) -> Array:
    """Return the vectors (N, size) that the recursion of the paper on registration reaches.

    At each new epoch, the recursion makes `iterations` undamped Gauss-Newton steps with all data up to this epoch. The
    first steps use forty epochs, and every step is accepted. `problem` is a flat batch of N runs, and `start` are
    vectors (N, size). The result is NaN if the steps diverge, or if the problem has unknowns of single epochs.
    """
    if problem.layout.n_local or has_correlated_epochs(problem):
        return np.full_like(start, np.nan)
    x = start
    with np.errstate(all="ignore"):
        for last in range(min(_FIRST, problem.epochs), problem.epochs + 1):
            data_so_far = window(problem, 0, last) if last < problem.epochs else problem
            for _ in range(iterations):
                x = _full_step(data_so_far, x)
    return x


def _full_step(problem: Problem, x: Array) -> Array:
    """Return the vectors (N, size) after one undamped Gauss-Newton step; NaN for singular equations."""
    # No damping: these baselines demonstrate steps that are too long.
    move, ok = step(equations_at(problem, x), np.zeros(len(x)))
    return x + np.where(ok[:, None], move, np.nan)


def claim(problem: Problem, start: Array, x: Array) -> Fix:
    """Return points `x` (N, size) as fixes with the status ok, except points that are not finite.

    `problem` is a flat batch of N problems; `start` (N, size) are the points where the method started.
    """
    found = np.asarray(np.isfinite(x).all(-1))
    with np.errstate(all="ignore"):
        cost = np.where(found, equations_at(problem, np.where(found[:, None], x, start)).cost, np.inf)
    code = np.where(found, Status.OK, Status.NUMERICAL).astype(np.int8)
    stage = Stage("claimed", f"{found.sum()} points", 0.0)
    return judge_points(problem, start, x[:, None], cost[:, None], code[:, None], stage)


# Listeners for the costs that a method evaluates, trial by trial: a study counts them, a history stores them.

Listener = Callable[[int, float], None]
"""Function that is called at each evaluation of a cost, with the number of the trial in the call, and the cost."""

_LISTENER: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def listening(by: Listener) -> Iterator[None]:
    """Register a listener that external methods call at each evaluation of a cost inside this context."""
    token = _LISTENER.set(by)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def teller(trial: int) -> Callable[[float], None]:
    """Return a function that passes each cost of a trial to the registered listener; without one, it does nothing."""
    listener = _LISTENER.get()
    return (lambda _: None) if listener is None else lambda cost: listener(trial, cost)


def weighings(problem: Problem) -> int:
    """Return the number of times that a trial is solved: 1, or more if the noise depends on the position.

    Noise with errors of the stations depends on the position. Then the trial is solved again and again, each time with
    the noise at the last solution.
    """
    return WEIGHINGS if depends_on_place(problem) else 1


def weighed_at(problem: Problem, x: Array, start: Array) -> Problem:
    """Return problems with the noise at the points `x` (N, size); at `start` (N, size) where a point is not finite."""
    return with_station_noise(problem, np.where(np.isfinite(x).all(-1, keepdims=True), x, start))


# General tools on the same data: SciPy's least squares from a guess, and the lifted relaxation of ranges.


def least_squares(problem: Problem, start: Array, limit: int = _EVALUATIONS) -> Fix:
    """Return the fixes of `scipy.optimize.least_squares` with exact derivatives, problem by problem.

    `problem` is a flat batch of N problems without constraints, `start` are vectors (N, size), and `limit` is the
    greatest number of evaluations. The fixes get their status in the same way as fixes of optloc's refinement. A failed
    problem has the status of the failure.
    """
    from scipy import optimize

    began = perf_counter()
    # Shape (N, 1, size): one candidate for each problem. Cost and code mark a failure until a run succeeds.
    pool = np.array(start, dtype=float)[:, None]
    cost, code = np.full(pool.shape[:2], np.inf), np.full(pool.shape[:2], int(Status.NUMERICAL), dtype=np.int8)
    for _ in range(weighings(problem)):
        plain = weighed_at(problem, pool[:, 0], start)
        for i in range(len(pool)):
            residual, jacobian = whiten_one(plain.take(np.array([i])), teller(i))
            try:
                end = optimize.least_squares(residual, pool[i, 0], jacobian, method="lm", max_nfev=limit)
            except ValueError:  # values that are not finite, or fewer rows than unknowns
                continue
            pool[i, 0], cost[i, 0] = end.x, 2.0 * end.cost  # the cost of SciPy is half the sum of squares
            code[i, 0] = Status.OK if end.status > 0 else Status.MAX_ITERATIONS
            count("scipy", int(end.nfev))
    stage = Stage("scipy", f"{len(pool)} problems", perf_counter() - began)
    return judge_points(problem, start, pool, cost, code, stage)


def whiten_one(
    one: Problem, tell: Callable[[float], None]
) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Return two functions of the vector (size,) for SciPy: residual (m,) and Jacobian (m, size) of one problem.

    Residuals are in standard deviations. Each unknown with a prior adds a residual, so m is the number of rows and of
    these unknowns. The residual function passes its cost to `tell`.
    """
    whitening, (prior_matrix, prior_values) = whiten(one.noise, one.weight), _prior_rows(one)

    def residual(x: Array) -> Array:
        values = differentiate(one, x[None])[0][..., None]
        residuals = np.concatenate(
            [*(block.apply(values)[0, :, 0] for block in whitening), prior_values - prior_matrix @ x]
        )
        tell(float(residuals @ residuals))
        return residuals

    def jacobian(x: Array) -> Array:
        H = differentiate(one, x[None])[1]
        # A residual is measured minus predicted, so its derivative has the opposite sign.
        return -np.concatenate([*(block.apply(H)[0] for block in whitening), prior_matrix])

    return residual, jacobian


def _prior_rows(one: Problem) -> tuple[Array, Array]:
    """Return the matrix A (r, size) and the values b (r,) of the priors of one problem, whose cost is |b - A x|^2.

    r is the number of unknowns with a prior.
    """
    layout, rows, values = one.layout, [np.zeros((0, one.layout.size))], [np.zeros(0)]
    for name, mean, precision in prior_parts(one):
        slot, shared = layout.find(name)
        # There is one problem, so leading axes have length one.
        prior_mean, root = mean.reshape(slot.size), np.linalg.cholesky(precision.reshape(slot.size, slot.size))
        for k in range(1 if shared else layout.epochs):
            first = slot.start + (0 if shared else layout.n_shared + k * layout.n_local)
            rows.append(root.T @ np.eye(layout.size)[first : first + slot.size])
            values.append(root.T @ prior_mean)
    return np.concatenate(rows), np.concatenate(values)


def lifted_sdp(problem: Problem) -> Fix:
    """Return the unrefined points of the semidefinite relaxation of ranges of order 1.

    `problem` is a flat batch of N problems of one epoch with one static target. The points are NaN if rows are not sums
    of ranges.

    References
    ----------
    K. Yang, G. Wang and Z.-Q. Luo (2009); see `formulations.lifted`.
    """
    from formulations.lifted import lifted_ranges

    began, problem = perf_counter(), with_station_noise(problem)
    size, d = problem.batch_shape[0], problem.dimension
    position = np.full((size, 1, d), np.nan)
    models = [MODELS[rows.kind] for rows in problem.rows]
    if one_position(problem) and all(model.ranges is not None and not model.emission for model in models):
        # Shift and scale each problem, so that the relaxation has numbers near 1.
        centre, scale = spread_of(problem)

        def relax(i: int) -> None:
            """Solve the relaxation of problem i."""
            K, z = range_rows(problem.take(np.array([i])), float(scale[i]))
            stations = np.broadcast_to(problem.stations.position, (size, *problem.stations.position.shape[-3:]))
            found = lifted_ranges(K, z, (stations[i, 0] - centre[i]) / scale[i])
            position[i, 0] = found.point * scale[i] + centre[i]

        map_on_threads(relax, range(size), least=WORTH)
    return judge(problem, offer(problem, vectors(problem, position), None, "lifted-sdp", began))


# Networks: from random positions, and from the convex start.


def at_random(count: int) -> Callable[[Network, int], NetworkResult]:
    """Return a method for networks: the best result of least squares from `count` networks of random positions.

    The spread of the positions is estimated from the arrivals.
    """
    return lambda network, seed: refined(network, starts_of(likelihood(network), seed).random(count))


def by_nuclear_norm(network: Network, seed: int) -> NetworkResult:
    """Return the network that least squares reaches from the emission times of least truncated nuclear norm.

    This start needs one clock for all stations, no missing arrival, and enough stations and pulses. Otherwise the
    result has no network. `seed` has no effect, because this start is not random.
    """
    from formulations.metric_upgrade import unknowns, upgrade
    from formulations.nuclear_norm import affine_network, nuclear_offsets

    m, n, d = network.stations, network.pulses, network.dimension
    generator = starts_of(likelihood(network), seed)
    starts = generator.random(0)  # no start; with none, `refined` returns a result without a network
    if network.synchronised and network.given.all() and max(m, n) >= unknowns(d) and m > d + 1:
        # Arrivals (n, m) less the median of each pulse, in units of their spread: numbers near 1 for the solver.
        z = (generator.z - generator.shift[:, None]) / generator.spread
        found = nuclear_offsets(z, d)
        if np.isfinite(found.value):
            stations, pulses, choices = upgrade(affine_network(z, found.offset, d))
            emission = np.repeat((generator.shift + generator.spread * found.offset)[None], len(choices), axis=0)
            starts = NetworkEstimate(
                generator.spread * stations, np.zeros((len(choices), m)), generator.spread * pulses, emission
            )
    return refined(network, starts)


def only_networks(drawn: DrawnCase, start: Array) -> Fix:
    """Raise InvalidProblem: the function `run` of baselines that solve networks only."""
    raise InvalidProblem("this baseline solves networks only", "baseline", "give [[network]] tables")


# Table of baselines.


@dataclass(frozen=True, slots=True)
class Baseline:
    """Method to compare with.

    Parameters
    ----------
    run : callable
        ``(drawn, start) -> Fix``: solves n trials from the starting vectors (n, size).
    summary : str
        One line for listings.
    guess : bool
        Whether it needs a start.
    slow : bool
        Whether it solves problems one by one.
    reference : bool
        Whether it knows the truth: it judges the other methods and is not ranked.
    method : str
        Name of the method of optloc that it runs from its start; empty for other baselines.
    networks : callable, optional
        ``Networks -> tuple of NetworkResult``, if it also solves networks.
    """

    run: Callable[[DrawnCase, Array], Fix]
    summary: str
    guess: bool = True
    slow: bool = False
    reference: bool = False
    method: str = ""
    networks: Callable[[Networks], tuple[NetworkResult, ...]] | None = None


def _iterate(method: str) -> Callable[[DrawnCase, Array], Fix]:
    """Return a baseline function that runs a method of optloc from a start."""

    def run(drawn: DrawnCase, start: Array) -> Fix:
        from optloc.solvers import solve

        return solve(drawn.problem, method, start=start)

    return run


def _truth(drawn: DrawnCase, start: Array) -> Fix:
    """Return the fixes of damped least squares from the truth."""
    return _iterate("lsr")(drawn, drawn.truth)


def _printed_sign(drawn: DrawnCase, start: Array) -> Fix:
    """Return the fixes of the undamped iteration with the sign of the residual that the paper prints.

    The paper is the source of `optloc.lab.papers.kinematic`.

    The positions are NaN for problems with other unknowns than a position.
    """
    from optloc.lab.papers.kinematic import taylor

    d = drawn.problem.dimension
    x = start.copy()
    x[:, :d] = taylor(drawn.problem, start, sign=-1.0) if start.shape[-1] == d else np.nan
    return given(drawn.problem, x)


def _method_of_paper(steps: Callable[[Problem, Array], Array]) -> Callable[[DrawnCase, Array], Fix]:
    """Return the method of a paper as a baseline function; it claims every finite point as an answer.

    `steps` returns the final vectors (N, size) of problems from starting vectors (N, size).
    """
    return lambda drawn, start: claim(drawn.problem, start, steps(drawn.problem, start))


def _network_baseline(summary: str, refine: Callable[[Network, int], NetworkResult]) -> Baseline:
    """Return a baseline for networks only, which refines them one by one."""
    return Baseline(only_networks, summary, guess=False, slow=True, networks=each(refine))


_OWN = {
    "truth": Baseline(
        _truth,
        "damped least squares from the truth: the best result that a start can have",
        guess=False,
        reference=True,
        networks=from_truth,
    ),
    "gauss-newton": Baseline(_iterate("lsr"), "damped least squares from a guess", method="lsr"),
    "taylor": Baseline(
        _iterate("taylor"),
        "undamped Taylor iteration from a guess (Foy 1976), as in the papers",
        method="taylor",
    ),
    "taylor-printed": Baseline(_printed_sign, "taylor with the sign of equations 8 and 15 of the paper `kinematic`"),
    "single-step": Baseline(
        _method_of_paper(single_step), "one linearised step from a guess, as in the update of the paper `angles`"
    ),
    "recursion": Baseline(
        _method_of_paper(recursion),
        "two undamped steps over all data at every new epoch, as in the paper `registration`",
    ),
    "ipopt": Baseline(_iterate("nlp"), "IPOPT from a guess, or another nonlinear solver", slow=True, method="nlp"),
    "scipy": Baseline(
        lambda drawn, start: least_squares(drawn.problem, start),
        "scipy.optimize.least_squares with exact derivatives from a guess",
        slow=True,
    ),
    "lifted-sdp": Baseline(
        lambda drawn, start: lifted_sdp(drawn.problem),
        "order-1 lifted ranges, unrefined: never tight for tdoa",
        guess=False,
        slow=True,
    ),
    "nuclear-norm": _network_baseline(
        "times of emission by the truncated nuclear norm, metric upgrade, least squares: networks with one clock and "
        "no missing arrival",
        by_nuclear_norm,
    ),
    "one-random": _network_baseline("networks: least squares from one network of random positions", at_random(1)),
    "ten-random": _network_baseline(
        "networks: the best result of least squares from ten networks of random positions", at_random(10)
    ),
}

BASELINES: Registry[Baseline] = Registry("optloc.baselines", lambda value: isinstance(value, Baseline), _OWN)
"""Baselines by name."""
