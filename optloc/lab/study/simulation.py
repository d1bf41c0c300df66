"""Simulation of the trials of a case: stations, target and measurement errors, as a function of seed, case and number.

Trials are drawn in blocks with one seed each. So a trial does not depend on other trials, on the machine or on the
order of computation.

Letters in shapes: n trials, m rows, s stations, d coordinates. `size` is the length of a parameter vector: all unknowns
of a problem in the order of its layout. Positions are in metres in the frame of the problem.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from optloc.engine import arrays, simulate, simulate_walks, walks
from optloc.files import Units, join
from optloc.lab.study.document import LayoutTable, ScenarioTable, TruthTable, sigma_of
from optloc.problem import Amount, Array, Bias, Frame, InvalidProblem, Problem, form_of, nearest, state_names, with_bias

Rng = np.random.Generator

# Most numbers and most trials of a block. Both decide the seed of a trial: with other values the data differ, and
# earlier studies could not continue. A block is large enough that NumPy draws it in one step. It is small (25 000
# numbers, 200 kB), so a chunk that needs a small part of a block draws few unused numbers. 500 trials are also the
# least of a chunk of a fast method.
_NUMBERS, _MOST = 25_000, 500


@dataclass(frozen=True)
class Case:
    """Common data of all trials of a case, without functions, so that it can be sent to workers.

    Parameters
    ----------
    table : ScenarioTable
        The scenario with its swept values inserted.
    sweep : str
        The swept values as JSON.
    label, unit : str
        The noise level as written in the file, and the unit of `level`.
    level : float
        The noise level as a number.
    template : Problem
        Stations, rows and noise; the measurements are NaN.
    seed : int
        Seed of the study.
    trials : int
        Number of trials.
    """

    table: ScenarioTable
    sweep: str
    label: str
    unit: str
    level: float
    template: Problem
    seed: int
    trials: int

    @cached_property
    def key(self) -> str:
        """Return 16 hexadecimal digits that identify the data of all trials."""
        # The level and the swept values are included as text. The number of trials is not, so that a study with more
        # trials can continue one with fewer.
        problem, text = self.template, self.table.model_dump_json(exclude={"noise", "sweep", "trials"})
        made = hashlib.blake2b(f"{self.seed} {self.label} {self.sweep} {text} {problem.frame}".encode(), digest_size=8)
        made.update(repr(problem.structure).encode())
        for array in (
            problem.stations.position,
            problem.stations.covariance,
            problem.stations.velocity_covariance,
            problem.weight,
            *(rows.correction for rows in problem.rows),
            *(block.covariance for block in problem.noise.blocks),
            *(part for bias in problem.biases for part in (bias.mean, bias.sigma)),
        ):
            made.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
        return made.hexdigest()

    @property
    def where(self) -> str:
        """Return the location that error messages name."""
        return f"scenario {self.table.name!r}"

    @property
    def numbers(self) -> int:
        """Return the number of measurements of a trial."""
        return self.template.count

    @property
    def facts(self) -> dict[str, Any]:
        """Return the columns of the table that all trials share, by name."""
        problem = self.template
        sizes = {"dimension": problem.dimension, "stations": problem.stations.count, "rows": problem.count}
        return {"kinds": "+".join(rows.kind for rows in problem.rows), **sizes, "epochs": problem.epochs}

    def draw(self, first: int, count: int) -> DrawnCase:
        """Return `count` trials, from the trial `first` on."""
        return draw(self, first, count)

    @property
    def state(self) -> tuple[str, ...]:
        """Return the names of the target's position and, if it moves, of its velocity and acceleration."""
        motions = self.template.motions
        i = next(i for i, motion in enumerate(motions) if motion.known is None)
        return state_names(i, len(motions), motions[i].order)


@dataclass(frozen=True, slots=True)
class DrawnCase:
    """Simulated trials of a case.

    Parameters
    ----------
    problem : Problem
        The problem that methods solve, with leading axis (n,).
    truth : array (n, size)
        True parameter vectors in the order of the problem's layout.
    wild : array (n, d)
        A random point of each trial in the unit cube around zero, for the start of methods that need a guess.
    seed : tuple of n str
        Names of the seeds of the trials' blocks.
    digest : tuple of n str
        Digests of the drawn numbers of the blocks. A seed decides the numbers, a digest verifies them.
    bad : int array (n,)
        Number of stations with a gross error.
    position : str
        Name of the unknown position in the layout.
    """

    problem: Problem
    truth: Array
    wild: Array
    seed: tuple[str, ...]
    digest: tuple[str, ...]
    bad: Array
    position: str = "position"

    def part(self, first: int, count: int) -> DrawnCase:
        """Return `count` trials, from the trial `first` on."""
        kept = slice(first, first + count)
        return replace(
            self,
            problem=self.problem.take(np.arange(first, first + count)),
            **{name: getattr(self, name)[kept] for name in ("truth", "wild", "seed", "digest", "bad")},
        )


def block_size(case: Case) -> int:
    """Return the number of trials in a block; the trials of a block share one seed."""
    return int(np.clip(_NUMBERS // case.numbers, 1, _MOST))


def draw(case: Case, first: int, count: int) -> DrawnCase:
    """Return `count` trials of a case, from the trial `first` on; they do not depend on other draws."""
    # Draw whole blocks, then select the wanted trials. So a trial does not depend on `first` and `count`.
    per_block = block_size(case)
    blocks = range(first // per_block, -(-(first + count) // per_block))
    parts = [_block(case, number, per_block) for number in blocks]
    wanted = slice(first - blocks[0] * per_block, first - blocks[0] * per_block + count)
    stations, truth, wild, z, bad = (np.concatenate(arrays)[wanted] for arrays in zip(*parts, strict=True))
    # Stations of a file are the same in all trials, and are stored once.
    problem = case.template if case.table.layout is None else _with_stations(case.template, stations)
    names = [f"{case.seed}:{case.key}:{number}" for number in blocks]
    digests = [_digest(case, part) for part in parts]
    block_of_trial = [trial // per_block - blocks[0] for trial in range(first, first + count)]
    seed, digest = (tuple(texts[block] for block in block_of_trial) for texts in (names, digests))
    return DrawnCase(problem.with_rows(z=z), truth, wild, seed, digest, bad, case.state[0])


def _digest(case: Case, block: tuple[Array, ...]) -> str:
    """Return 16 hexadecimal digits that are equal for blocks whose drawn numbers are equal, bit for bit."""
    # The key covers noise, weights and frame, which are not drawn. Otherwise equal measurements of different noise
    # would have equal digests.
    digest = hashlib.blake2b(case.key.encode(), digest_size=8)
    for array in block:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _block(case: Case, number: int, n: int) -> tuple[Array, Array, Array, Array, Array]:
    """Return the drawn numbers of the block `number` with n trials.

    The arrays are: stations (n, s, d), metres; true parameter vectors (n, size); random points (n, d) for starts, see
    `DrawnCase.wild`; measurements (n, m); number of stations with a gross error (n,).
    """
    # A seed sequence mixes words of 32 bits.
    key = [int(case.key[:8], 16), int(case.key[8:], 16)]
    # Separate streams for geometry, noise, guesses and clock steps: a change of one does not shift the others.
    geometry, noise, guess, steps = np.random.SeedSequence([case.seed, *key], spawn_key=(number,)).spawn(4)
    rng, problem, table = np.random.default_rng(geometry), case.template, case.table
    stations = np.broadcast_to(problem.stations.position.mean(0), (n, *problem.stations.position.shape[-2:]))
    if table.layout is not None:
        if table.layout.placement != "frozen":  # the template contains the frozen stations
            stations = place_stations(table.layout, case.where, rng, n)
        problem = _with_stations(problem, stations)
    true_problem, injected = add_injected_errors(problem, table, case.where)
    # `names` are the names of the position and, if the target moves, of the velocity.
    place, names = join(case.where, "truth"), case.state
    # The order of these draws decides the data, like the seed.
    values = {names[0]: place_targets(table.truth, problem.frame, stations, place, rng)}
    if len(names) > 1:
        values[names[1]] = _velocities(table.truth, problem.dimension, place, rng, n)
    values |= {bias.name: _biases(case, bias, rng, n) for bias in problem.biases}
    errors = _draw_errors(injected, {error.name: _size_of(true_problem, error.name) for error in injected}, rng, n)
    values |= errors
    is_gross = [errors[error.name] != 0.0 for error in injected if error.share is not None]
    bad = np.any(is_gross, axis=0).sum(-1) if is_gross else np.zeros(n, dtype=int)
    z = np.broadcast_to(
        simulate(true_problem, _parameter_vectors(true_problem, values, n, steps), noise).z, (n, problem.count)
    )
    wild = np.random.default_rng(guess).uniform(-0.5, 0.5, (n, problem.dimension))
    return stations, _parameter_vectors(problem, values, n, steps), wild, z, bad


def _with_stations(problem: Problem, stations: Array) -> Problem:
    """Return the problem with stations (n, s, d) in metres, the same in all its epochs."""
    return replace(problem, stations=replace(problem.stations, position=stations[:, None]))


def _parameter_vectors(problem: Problem, values: dict[str, Array], n: int, steps: np.random.SeedSequence) -> Array:
    """Return parameter vectors (n, size) with the named values; all other unknowns are zero.

    `values` contains arrays with leading axis n by the name of the unknown. Unknowns that walk from epoch to epoch
    start at their value, and add random steps from the seed `steps`.
    """
    layout = problem.layout
    vectors = np.zeros((n, layout.size))
    for offset, slot in (*((0, slot) for slot in layout.shared), *((layout.n_shared, slot) for slot in layout.local)):
        if slot.name in values:
            vectors[:, offset + slot.start : offset + slot.start + slot.size] = values[slot.name]
    return simulate_walks(problem, vectors, steps) if walks(problem) else vectors


def _size_of(problem: Problem, name: str) -> int:
    """Return the number of members of the unknown `name`."""
    return problem.layout.find(name)[0].size


# Stations.


def metres(values: list[Amount], where: str, count: int | None = None) -> Array:
    """Return amounts of length as an array in metres; raise InvalidProblem if their number is not `count`."""
    if count is not None and len(values) != count:
        advice = "give one for each, or set dimension"
        raise InvalidProblem(f"{len(values)} numbers do not fit {count} dimensions", where, advice)
    return np.array([Units("length").plain(value, "m", where) for value in values])


def place_stations(layout: LayoutTable, where: str, rng: Rng, count: int) -> Array:
    """Return the stations of `count` trials by the rule of a layout, (count, s, d) in metres.

    Rules without a draw return equal stations for all trials. `where` is the location for error messages.
    """
    s, d = layout.stations, layout.dimension
    if layout.placement == "given":
        return np.broadcast_to(_given(layout, where), (count, s, d))
    box = metres(layout.box[:d], join(where, "box"), d)
    if layout.placement in ("random", "frozen"):
        return rng.uniform(-0.5, 0.5, (count, s, d)) * box
    central = int(layout.placement == "star")
    angle = 2.0 * np.pi * np.arange(s - central) / max(s - central, 1)
    # In three dimensions stations are alternately high and low. A plane ring would not determine the sign of the
    # height.
    circle = np.stack([arrays.cos(angle), arrays.sin(angle), 1.0 - 2.0 * (np.arange(s - central) % 2)], -1)[:, :d]
    ring = np.concatenate([np.zeros((central, d)), 0.5 * circle * box])
    return np.broadcast_to(ring, (count, s, d))


def _given(layout: LayoutTable, where: str) -> Array:
    """Return the stations (s, d) of a layout with given positions, metres."""
    place = join(where, "places")
    if layout.places is None or len(layout.places) != layout.stations:
        found = 0 if layout.places is None else len(layout.places)
        raise InvalidProblem(f"{found} places do not fit {layout.stations} stations", place, "give one for each")
    if any(len(point) != layout.dimension for point in layout.places):
        raise InvalidProblem(f"a place needs {layout.dimension} coordinates", place, "give metres")
    return np.array(layout.places, dtype=float)


# Targets: each kind of truth is a function ``(table, frame, stations (n, s, d), location, rng) -> positions (n, d)``.


def _fixed(truth: TruthTable, frame: Frame, stations: Array, where: str, rng: Rng) -> Array:
    """Return the same position for all trials, (n, d) in metres."""
    count, d = len(stations), stations.shape[-1]
    if truth.at is not None:
        return np.broadcast_to(metres(truth.at, join(where, "at"), d), (count, d))
    assert truth.at_deg is not None
    if len(truth.at_deg) != 3:
        raise InvalidProblem("a place on Earth has three numbers", join(where, "at_deg"), "add the height in metres")
    lat, lon, height = truth.at_deg
    return np.broadcast_to(frame.from_geodetic(np.radians(lat), np.radians(lon), height), (count, d))


def _in_box(truth: TruthTable, frame: Frame, stations: Array, where: str, rng: Rng) -> Array:
    """Return positions (n, d) that are uniform in a box, metres; on Earth the box is along east, north and up."""
    (count, _, d), centre = stations.shape, stations.mean(1)
    assert truth.box is not None
    box = metres(truth.box, join(where, "box"), d)
    middle = centre if truth.centre is None else metres(truth.centre, join(where, "centre"), d)
    return np.asarray(middle + _from_enu(frame, centre, rng.uniform(-0.5, 0.5, (count, d)) * box))


def _in_shell(truth: TruthTable, frame: Frame, stations: Array, where: str, rng: Rng) -> Array:
    """Return positions (n, d) in random directions from the stations' centre, metres; the distance is uniform."""
    (count, _, d), centre = stations.shape, stations.mean(1)
    assert truth.distance is not None
    low, high = metres(truth.distance, join(where, "distance"))
    offset = _directions(truth, d, count, rng) * rng.uniform(low, high, (count, 1))
    return np.asarray(centre + _from_enu(frame, centre, offset))


def _in_hull(truth: TruthTable, frame: Frame, stations: Array, where: str, rng: Rng) -> Array:
    """Return random positions (n, d) in the hull of the stations, metres."""
    # Uniform over the weights, not over the volume: this works for every hull, even a flat one.
    share = rng.dirichlet(np.ones(stations.shape[1]), len(stations))
    return np.asarray((share[..., None] * stations).sum(1))


def _in_area(truth: TruthTable, frame: Frame, stations: Array, where: str, rng: Rng) -> Array:
    """Return positions (n, 3) at uniform latitudes and longitudes, metres in the frame."""
    count = len(stations)
    spans = [np.array(span) for span in (truth.lat_deg, truth.lon_deg) if span]
    lat, lon = (np.radians(rng.uniform(span[0], span[1], count)) for span in spans)
    height = metres([truth.height], join(where, "height"))[0]
    return np.asarray(frame.from_geodetic(lat, lon, np.full(count, height)))


def _from_enu(frame: Frame, points: Array, local: Array) -> Array:
    """Return vectors (n, d) in the frame, from vectors along the axes east, north and up at the points (n, d).

    In a frame that is not on Earth, the vectors do not change.
    """
    return arrays.product(local, frame.enu_axes(points)) if frame.geodetic else local


def _directions(truth: TruthTable, d: int, count: int, rng: Rng) -> Array:
    """Return unit vectors (count, d): uniform on the circle, on the sphere, or between the elevations of the truth."""
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    flat = np.stack([arrays.cos(azimuth), arrays.sin(azimuth)], axis=-1)
    if d == 2:
        return flat
    low, high = truth.elevation_deg or (-90.0, 90.0)
    # Archimedes: the area of a sphere is uniform in the sine of the elevation.
    lowest, highest = arrays.sin(np.radians([low, high]))
    sine = rng.uniform(lowest, highest, count)
    return np.concatenate([flat * np.sqrt(1.0 - sine[:, None] ** 2), sine[:, None]], axis=-1)


class _Truth(NamedTuple):
    """A kind of truth.

    `needed` are its required keys, `more` are its optional keys, and `place` is the function that draws its positions.
    """

    needed: tuple[str, ...]
    more: tuple[str, ...]
    place: Callable[[TruthTable, Frame, Array, str, Rng], Array]


_TRUTHS = {
    "fixed": _Truth((), ("at", "at_deg"), _fixed),
    "box": _Truth(("box",), ("centre",), _in_box),
    "shell": _Truth(("distance",), ("elevation_deg",), _in_shell),
    "hull": _Truth((), (), _in_hull),
    "area": _Truth(("lat_deg", "lon_deg"), ("height",), _in_area),
}
_ANY = {"kind", "speed", "velocity"}


def place_targets(truth: TruthTable, frame: Frame, stations: Array, where: str, rng: Rng) -> Array:
    """Return the true positions (count, d) of targets, metres in the frame, for stations (count, s, d) in metres.

    `where` is the location for error messages.
    """
    return _TRUTHS[truth.kind].place(truth, frame, stations, where, rng)


def check_truth(truth: TruthTable, frame: Frame, dimension: int, where: str) -> None:
    """Raise InvalidProblem if a truth has keys of another kind, has invalid amounts, or does not fit the frame.

    `dimension` is the number of coordinates of the problem.
    """
    needed, more, _ = _TRUTHS[truth.kind]
    foreign = sorted(truth.model_fields_set - _ANY - {*needed, *more})
    if foreign:
        advice = f"use {', '.join(needed + more)}" if needed + more else "remove it"
        raise InvalidProblem(f"a truth of kind {truth.kind!r} has no key {foreign[0]!r}", where, advice)
    for key in needed:
        if getattr(truth, key) is None:
            raise InvalidProblem(f"a truth of kind {truth.kind!r} needs the key {key!r}", where, "add it")
    if truth.kind == "fixed" and (truth.at is None) == (truth.at_deg is None):
        raise InvalidProblem("a fixed truth needs one position", where, "give at, or at_deg on Earth")
    if (truth.at_deg is not None or truth.kind == "area") and not (frame.geodetic and dimension == 3):
        advice = "give a frame of the Earth, or metres"
        raise InvalidProblem("latitude and longitude need a frame on Earth in three dimensions", where, advice)
    _check_spans(truth, where)
    # A trial draw reports invalid amounts before any computation; the positions of the stations do not matter.
    place_targets(truth, frame, np.ones((1, 2, dimension)), where, np.random.default_rng(0))


def _check_spans(truth: TruthTable, where: str) -> None:
    """Raise InvalidProblem if a least value exceeds its greatest value, or an angle is out of range."""
    degrees = {"elevation_deg": 90.0, "lat_deg": 90.0, "lon_deg": 360.0}
    for key, limit in {"distance": np.inf, **degrees}.items():
        given = getattr(truth, key)
        if given is None:
            continue
        place = join(where, key)
        low, high = metres(given, place) if key == "distance" else given
        if low > high:
            raise InvalidProblem(f"the least value {low:g} is above the greatest, {high:g}", place, "exchange them")
        if max(-low, high) > limit:
            raise InvalidProblem(f"{low:g} to {high:g} is beyond {limit:g} degrees", place, "give degrees")


def _velocities(truth: TruthTable, dimension: int, where: str, rng: Rng, count: int) -> Array:
    """Return true velocities (count, d), metres per second."""
    units = Units("speed")
    if truth.velocity is not None:
        if len(truth.velocity) != dimension:
            raise InvalidProblem(f"the velocity needs {dimension} components", join(where, "velocity"), "give each")
        given = [units.plain(value, "m/s", join(where, "velocity")) for value in truth.velocity]
        return np.broadcast_to(np.array(given), (count, dimension))
    direction = rng.standard_normal((count, dimension))
    # The direction is drawn even for speed zero, so that a sweep of speeds does not change the other draws.
    speed = 0.0 if truth.speed is None else units.plain(truth.speed, "m/s", join(where, "speed"))
    return np.asarray(speed * direction / np.linalg.norm(direction, axis=-1, keepdims=True))


# Errors: biases of the problem file, which methods may estimate, and injected errors, which no method has a model of.


def _biases(case: Case, bias: Bias, rng: Rng, n: int) -> Array:
    """Return true values (n, q) of a bias with q members, in SI units.

    By default they are the mean of the prior. A list in the study file gives the values; a number is the standard
    deviation of a draw around the mean.
    """
    members = _size_of(case.template, bias.name)
    mean = np.broadcast_to(np.ravel(bias.mean), (members,))
    true = case.table.bias.get(bias.name)
    if true is None:
        return np.broadcast_to(mean, (n, members))
    where = join(case.where, f"bias {bias.name!r}")
    if isinstance(true, list):
        if len(true) != members:
            raise InvalidProblem(f"{len(true)} values do not fit {members} members", where, "give one for each")
        return np.broadcast_to(np.array([_bias_value(case, bias, value, where) for value in true]), (n, members))
    return np.asarray(mean + _bias_value(case, bias, true, where) * rng.standard_normal((n, members)))


def _bias_value(case: Case, bias: Bias, value: Amount, where: str) -> float:
    """Return a value of a bias in SI units; an offset has the unit of its rows, a boresight is an angle.

    `value` is a number in SI units, or a text with a unit and perhaps a sign.
    """
    if isinstance(value, int | float):
        return float(value)
    form = form_of(bias)
    # The value has the quantity of the rows: its unit is a unit of the kind of the first row that the bias affects.
    if form.quantity is None and not form.rate:
        starts = np.array(case.template.starts)
        kind = case.template.rows[int(np.searchsorted(starts, bias.row[0], side="right")) - 1].kind
        text = value.strip()
        sign = -1.0 if text.startswith("-") else 1.0
        return sign * sigma_of(kind, text.lstrip("-"), where)
    return Units(form.quantity or "plain").plain(value, None, where)


@dataclass(frozen=True, slots=True)
class InjectedError:
    """Errors of the stations in rows of one kind: constant errors of every station, or gross errors of a few.

    Parameters
    ----------
    name : str
        Name of the unknown that contains the errors in the true problem.
    size : float
        Standard deviation of constant errors, or size of gross errors, in SI units.
    share : float, optional
        Probability that a station has a gross error; None for constant errors.
    late : bool
        Whether all gross errors are positive; otherwise their signs are random.
    """

    name: str
    size: float
    share: float | None = None
    late: bool = False


def add_injected_errors(
    problem: Problem, table: ScenarioTable, where: str
) -> tuple[Problem, tuple[InjectedError, ...]]:
    """Return the problem with unknowns for errors that no method has a model of, and the list of these errors.

    `problem` is the problem that methods solve. Only the simulation uses the returned problem. `where` is the location
    of the scenario for error messages. Raise InvalidProblem for a kind that the problem lacks, or a size that is not
    positive.
    """
    place, errors = join(where, "error"), []
    offset, outliers = table.error.offset, table.error.outliers
    if offset is not None:
        sizes = _sizes(problem, offset, join(place, "offset"))
        errors += [(kind, InjectedError(f"unmodelled {kind}", size)) for kind, size in sizes.items()]
    if outliers is not None:
        sizes = _sizes(problem, outliers.size, join(place, "outliers"))
        errors += [
            (kind, InjectedError(f"gross {kind}", size, outliers.share, outliers.late)) for kind, size in sizes.items()
        ]
    for kind, error in errors:
        problem = with_bias(problem, error.name, kind=kind)
    return problem, tuple(error for _, error in errors)


def _sizes(problem: Problem, given: Amount | dict[str, Amount], where: str) -> dict[str, float]:
    """Return the given sizes of errors in SI units, by kind; one size for all kinds is repeated."""
    kinds = [rows.kind for rows in problem.rows]
    named = given if isinstance(given, dict) else dict.fromkeys(kinds, given)
    for kind in named:
        if kind not in kinds:
            raise InvalidProblem(f"the problem has no rows of kind {kind!r}", where, nearest(kind, kinds))
    return {kind: sigma_of(kind, amount, where) for kind, amount in named.items()}


def _draw_errors(injected: tuple[InjectedError, ...], lengths: dict[str, int], rng: Rng, n: int) -> dict[str, Array]:
    """Return the errors of n trials (n, stations) by the name of their unknown, in SI units.

    `lengths` are the numbers of stations by this name.
    """
    constant = [error for error in injected if error.share is None]
    drawn: dict[str, Array] = {
        error.name: error.size * rng.standard_normal((n, lengths[error.name])) for error in constant
    }
    # One chance and one sign for each station: a bad station is bad in all kinds, and in the same direction.
    most = max(lengths.values(), default=0)
    chance, sign = rng.random((n, most)), np.where(rng.random((n, most)) < 0.5, -1.0, 1.0)
    for error in injected:
        if error.share is not None:
            values = (chance < error.share) * (1.0 if error.late else sign) * error.size
            drawn[error.name] = values[:, : lengths[error.name]]
    return drawn
