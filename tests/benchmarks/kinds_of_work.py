"""Problems of the benchmark of kinds that are no single fix: scans of trackers, registration, calibration, a table."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.kinds import BATCH, FAST, SIGMA, TDOA, TRIALS, Answers, Case, S, T, Way, generator, labels
from benchmarks.opponents import Opponent, differences, shared_arrival
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from sites.calibration.scenes import distances, hall

import optloc
from optloc import Motion, Problem, assemble, measured, with_bias
from optloc.cli.fix import run_fix
from optloc.files.table_import import ColumnHints
from optloc.sites.calibration import calibrate, network_of
from optloc.tracking import State, polynomial
from optloc.tracking.scan_rows import Scans
from optloc.tracking.track import step
from optloc.tracking.updates import UPDATES, filter_of

Array = np.ndarray
Call = Callable[[], Any]

# One scan of a tracker: a second after a state of 100 m and 5 m/s, five differences of six stations.

STEP, ACCELERATION = 1.0, 0.1
BEFORE = State(0.0, np.r_[T + np.array([30.0, -20.0, 40.0]), 5.0, 3.0, 0.0], np.diag([1e4] * 3 + [25.0] * 3))
WHITE = np.linalg.inv(np.linalg.cholesky(shared_arrival(5, SIGMA)))
# Nodes of the derivative along a step, and the step of the iterated filter in standard deviations that ends it.
NODES, SMALL, STEPS = tuple(zip(*np.polynomial.legendre.leggauss(5), strict=True)), 1e-6, 20


def scan(z: Array) -> Scans:
    """Return a run of one scan of measurements (..., 5)."""
    rows = measured("tdoa", z, a=np.arange(1, 6), b=0, epoch=np.zeros(5, dtype=int), arrival_sigma=SIGMA)
    return Scans.of(assemble(S, rows, times=[STEP], motions=(Motion(0, span="epoch"),)), 1)


def motion() -> tuple[Array, Array]:
    """Return transition and process noise of constant velocity."""
    one = np.eye(3)
    drive = np.concatenate([0.5 * STEP**2 * one, STEP * one]) * ACCELERATION
    return np.block([[one, STEP * one], [0.0 * one, one]]), drive @ drive.T


F, Q = motion()


def linearised(x: Array, z: Array) -> tuple[Array, Array]:
    """Return whitened residual (5,) and derivative to the position (5, 3)."""
    away = x[:3] - S
    r = np.sqrt((away**2).sum(1))
    unit = away / r[:, None]
    return WHITE @ (z - r[1:] + r[0]), WHITE @ (unit[1:] - unit[0])


def gain_of(H: Array, P: Array) -> tuple[Array, Array]:
    """Return the gain (6, 5), and H P (5, 6)."""
    HP = H @ P[:3]
    innovation = HP[:, :3] @ H.T
    innovation.flat[::6] += 1.0
    return np.linalg.solve(innovation, HP).T, HP


def filtered(name: str, z: Array) -> tuple[Array, Array]:
    """Return mean and covariance after the prediction and a scan by a filter in plain NumPy."""
    mean, P = F @ BEFORE.mean, F @ BEFORE.cov @ F.T + Q
    residual, H = linearised(mean, z)
    K, HP = gain_of(H, P)
    x = mean + K @ residual
    if name == "iekf":
        for _ in range(STEPS):
            residual, H = linearised(x, z)
            K, HP = gain_of(H, P)
            step = mean + K @ (residual - H @ (mean - x)[:3]) - x
            x = x + step
            if step @ np.linalg.solve(P, step) <= SMALL**2:
                break
    elif name == "mvekf":
        K, HP = gain_of(linearised(x, z)[1], P)
    elif name == "mgekf":
        along = [0.5 * w * linearised(mean + 0.5 * (1.0 + node) * (x - mean), z)[1] for node, w in NODES]
        left = np.eye(6)
        left[:, :3] -= K @ np.sum(along, axis=0)
        return x, left @ P @ left.T + K @ K.T
    return x, P - K @ HP


@cache
def scans() -> Array:
    """Return the measurements (N, 5) of the scans."""
    return Opponent(TDOA, shared_arrival(5, SIGMA)).draw(np.tile(T, (BATCH, 1)), generator("scan"))


def misfit(x: Array, z: Array) -> float:
    """Return the cost of a state after a scan: of the rows, and of the prediction."""
    mean, P = F @ BEFORE.mean, F @ BEFORE.cov @ F.T + Q
    residual, away = linearised(x, z)[0], x - mean
    return float(residual @ residual + away @ np.linalg.solve(P, away))


def prior_and_scan(name: str, z: Array) -> tuple[Array, Array]:
    """Return mean and covariance after the same by optloc."""
    done, _ = step(scan(z), 0, BEFORE, polynomial(1, ACCELERATION), filter_of(name))
    return done.mean, done.cov


def answers_of_states(status: list[str], mean: Array) -> Answers:
    cost = np.array([misfit(x, z) for x, z in zip(mean, scans(), strict=False)])
    return Answers(status, cost, np.linalg.norm(mean[:, :3] - T, axis=1))


def filter_case(name: str) -> Case:
    """Return the row of a filter: prediction and update."""
    rule, dynamics = filter_of(name), polynomial(1, ACCELERATION)
    many = State(0.0, np.tile(BEFORE.mean, (BATCH, 1)), np.tile(BEFORE.cov, (BATCH, 1, 1)))

    def ready(z: Array, state: State) -> Call:
        given = scan(z)
        return lambda: step(given, 0, state, dynamics, rule)

    def read(found: list[Any]) -> Answers:
        code = np.concatenate([np.atleast_1d(code) for _, code in found])
        return answers_of_states(labels(code), np.concatenate([np.atleast_2d(done.mean) for done, _ in found]))

    def read_opponent(found: list[Any]) -> Answers:
        return answers_of_states([], np.array([mean for mean, _ in found]))

    trials = scans()[:TRIALS]
    ways = {
        "solve": Way(lambda: [ready(z, BEFORE) for z in trials], read),
        "batch": Way(lambda: [ready(scans(), many)], read, BATCH),
        "opponent": Way(lambda: [lambda z=z: filtered(name, z) for z in trials], read_opponent),
    }
    return Case(f"scan of a tracker, {name}", ways, f"NumPy {name}")


# Registration: 200 pulses at unknown places and times, five stations in the plane, four unknown clocks.

SENSORS = 1e3 * np.array([[0.0, 0], [10, 1], [9, 9], [1, 10], [5, 4]])
OFFSETS, PULSES, ARRIVAL, RUNS = np.array([40.0, -25.0, 60.0, -80.0]), 200, 5.0, 10


@dataclass(frozen=True)
class Run:
    """A drawn run: truth of clocks and of each pulse (x, y, emission), and arrivals (k, 5), metres."""

    truth: Array
    z: Array


@cache
def runs() -> list[Run]:
    """Return the drawn runs."""
    rng, found = generator("registration"), []
    for _ in range(max(TRIALS, RUNS)):
        pulses = np.c_[rng.uniform(0.0, 10e3, (PULSES, 2)), rng.uniform(0.0, 1e5, PULSES)]
        r = np.linalg.norm(pulses[:, None, :2] - SENSORS, axis=2)
        z = r + pulses[:, 2:] + np.r_[0.0, OFFSETS] + ARRIVAL * rng.standard_normal(r.shape)
        found.append(Run(np.r_[OFFSETS, pulses.ravel()], z))
    return found


def registration(z: Array) -> Problem:
    """Return the run of arrivals (..., 200, 5)."""
    station, epoch = np.tile(np.arange(5), PULSES), np.repeat(np.arange(PULSES), 5)
    rows = measured("toa", z.reshape(*z.shape[:-2], -1), a=station, epoch=epoch, sigma=ARRIVAL)
    run = assemble(SENSORS, rows, motions=[Motion(0, "epoch")], times=np.arange(float(PULSES)))
    return with_bias(run, "clock", members=("S1", "S2", "S3", "S4"))


def sparse_solve(run: Run) -> Call:
    """Return a call of SciPy's sparse least squares, its pattern made before."""
    rows = np.arange(5 * PULSES).reshape(PULSES, 5)
    own = np.repeat(4 + 3 * np.arange(PULSES), 5).reshape(PULSES, 5)
    clocks = np.broadcast_to(np.arange(4), (PULSES, 4))
    i = np.concatenate([np.repeat(rows.ravel(), 3), rows[:, 1:].ravel()])
    j = np.concatenate([(own[..., None] + np.arange(3)).ravel(), clocks.ravel()])
    shape = (5 * PULSES, len(run.truth))

    def away(p: Array) -> tuple[Array, Array]:
        d = p[4:].reshape(PULSES, 1, 3)[..., :2] - SENSORS
        return d, np.sqrt((d**2).sum(-1))

    def residual(p: Array) -> Array:
        value = away(p)[1] + p[6::3, None]
        value[:, 1:] += p[:4]
        return (value - run.z).ravel() / ARRIVAL

    def jacobian(p: Array) -> Any:
        d, r = away(p)
        block = np.ones((PULSES, 5, 3))
        block[..., :2] = d / r[..., None]
        values = np.concatenate([block.ravel(), np.ones(4 * PULSES)]) / ARRIVAL
        return csr_matrix((values, (i, j)), shape=shape)

    return lambda: least_squares(residual, run.truth, jac=jacobian, method="trf", tr_solver="lsmr")


def registration_case() -> Case:
    """Return the row of registration."""
    trials, template = runs()[:TRIALS], registration(runs()[0].z)
    prepared = optloc.prepare(template, FAST)

    def pulses_of(p: Array) -> Array:
        return p[4:].reshape(PULSES, 3)[:, :2]

    def answers(status: list[str], cost: list[float], places: list[Array]) -> Answers:
        errors = [place - pulses_of(run.truth) for place, run in zip(places, runs(), strict=False)]
        return Answers(status, np.array(cost), np.array([np.sqrt((e**2).sum(1).mean()) for e in errors]))

    def read(fixes: list[Any]) -> Answers:
        each = [one for fix in fixes for one in (fix if fix.shape else [fix])]
        code = np.array([int(fix.code) for fix in each])
        return answers(labels(code), [float(fix.cost) for fix in each], [fix.position for fix in each])

    def read_opponent(found: list[Any]) -> Answers:
        return answers([], [2.0 * one.cost for one in found], [pulses_of(one.x) for one in found])

    def single(method: str) -> list[Call]:
        problems = [registration(run.z) for run in trials]
        return [lambda p=p: optloc.solve(p, method) for p in problems]

    def many() -> list[Call]:
        problem = registration(np.array([run.z for run in runs()[:RUNS]]))
        return [lambda: optloc.solve(problem, FAST)]

    flat = [run.z.ravel() for run in trials]
    ways = {
        "prepare": Way(lambda: [lambda z=z: prepared(z) for z in flat], read),
        "solve": Way(lambda: single(FAST), read),
        "auto": Way(lambda: single("auto"), read),
        "batch": Way(many, read, RUNS),
        "opponent": Way(lambda: [sparse_solve(run) for run in trials], read_opponent),
    }
    return Case("registration, 200 x 5", ways, "SciPy sparse trf from the truth")


# Calibration: six stations and 24 pulses, all places and emissions unknown.

HALLS, EARS, CLAPS, HEARD = 4, 6, 24, 0.03


@dataclass(frozen=True)
class Gauge:
    """A network in the frame of its first three stations: six coordinates are zero."""

    truth: Array
    z: Array

    @classmethod
    def of(cls, stations: Array, pulses: Array, emission: Array, z: Array) -> Gauge:
        """Return the unknowns of a network: 12 coordinates of stations, 72 of pulses, 24 emissions."""
        axes = np.linalg.qr((stations[1:3] - stations[0]).T, mode="complete")[0]
        turned, moved = (stations - stations[0]) @ axes, (pulses - stations[0]) @ axes
        return cls(np.concatenate([turned.ravel()[FREE], moved.ravel(), emission]), z)

    def parts(self, p: Array) -> tuple[Array, Array, Array]:
        """Return stations, pulses and emissions."""
        stations = np.zeros(3 * EARS)
        stations[FREE] = p[: len(FREE)]
        pulses = p[len(FREE) : len(FREE) + 3 * CLAPS].reshape(CLAPS, 3)
        return stations.reshape(EARS, 3), pulses, p[len(FREE) + 3 * CLAPS :]

    def residual(self, p: Array) -> Array:
        stations, pulses, emission = self.parts(p)
        r = np.sqrt(((pulses[:, None] - stations) ** 2).sum(-1))
        return (r + emission[:, None] - self.z).ravel() / HEARD

    def jacobian(self, p: Array) -> Array:
        stations, pulses, _ = self.parts(p)
        away = pulses[:, None] - stations
        unit = away / np.sqrt((away**2).sum(-1))[..., None]
        j, i = np.arange(CLAPS)[:, None], np.arange(EARS)
        by_station, by_pulse = np.zeros((CLAPS, EARS, EARS, 3)), np.zeros((CLAPS, EARS, CLAPS, 3))
        by_emission = np.zeros((CLAPS, EARS, CLAPS))
        by_station[j, i, i], by_pulse[j, i, j], by_emission[j, i, j] = -unit, unit, 1.0
        rows = CLAPS * EARS
        parts = by_station.reshape(rows, -1)[:, FREE], by_pulse.reshape(rows, -1), by_emission.reshape(rows, -1)
        return np.concatenate(parts, axis=1) / HEARD

    def ready(self) -> Call:
        return lambda: least_squares(self.residual, self.truth, jac=self.jacobian, method="lm")


# Coordinates that the frame leaves free: x of the second station, x and y of the third, all of the others.
FREE = np.r_[3, 6, 7, np.arange(9, 3 * EARS)]


def calibration_case() -> Case:
    """Return the row of calibration."""
    drawn = [hall(seed, EARS, CLAPS, HEARD) for seed in range(HALLS)]
    gauges = [Gauge.of(t.stations[0], t.pulses[0], t.emission[0], z) for t, z in drawn]

    def answers(status: list[str], cost: list[float], stations: list[Array]) -> Answers:
        pairs = zip(stations, drawn, strict=True)
        errors = [distances(found) - distances(truth.stations[0]) for found, (truth, _) in pairs]
        return Answers(status, np.array(cost), np.array([np.sqrt((e**2).mean()) for e in errors]))

    def read(found: list[Any]) -> Answers:
        return answers([c.status.label for c in found], [c.cost for c in found], [c.stations for c in found])

    def read_opponent(found: list[Any]) -> Answers:
        places = [gauge.parts(one.x)[0] for gauge, one in zip(gauges, found, strict=True)]
        return answers([], [2.0 * one.cost for one in found], places)

    def ready() -> list[Call]:
        networks = [network_of(z, HEARD) for _, z in drawn]
        return [lambda network=network: calibrate(network) for network in networks]

    ways = {
        "auto": Way(ready, read),
        "opponent": Way(lambda: [gauge.ready() for gauge in gauges], read_opponent),
    }
    return Case("calibration, 6 x 24", ways)


# A table of arrival times in, a table of fixes out.

EVENTS, CLOCK, LIGHT = 2_000, 10e-9, 299_792_458.0


def events() -> tuple[Array, Array]:
    """Return positions (N, 3) and arrival times (N, 6), seconds."""
    rng = generator("table")
    truth = rng.uniform([0.0, 0.0, 500.0], [10e3, 10e3, 4e3], (EVENTS, 3))
    flight = np.linalg.norm(truth[:, None] - S, axis=2) / LIGHT
    return truth, flight + 0.01 * np.arange(EVENTS)[:, None] + CLOCK * rng.standard_normal(flight.shape)


def read_table(path: Path) -> Iterator[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        yield from csv.DictReader(file)


def fix_by_scipy(table: Path, out: Path, truth: Array) -> Path:
    """Fix a table event by event from the truth and write a table."""
    opponent = Opponent(differences(S), shared_arrival(5, CLOCK * LIGHT))
    with out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["epoch", "x", "y", "z", "cost"])
        for row, start in zip(read_table(table), truth, strict=True):
            t = np.array([float(row[f"{name}_s"]) for name in "ABCDEF"])
            found = opponent.ready(LIGHT * (t[1:] - t[0]), start)()
            writer.writerow([row["event"], *found.x.tolist(), 2.0 * found.cost])
    return out


def table_case(folder: Path) -> Case:
    """Return the row of `optloc fix table.csv --out fixes.csv` in the same process, an event each."""
    (truth, times), number = events(), count()
    stations, table = folder / "stations.csv", folder / "table.csv"
    places = (f"{name},{x},{y},{z}\n" for name, (x, y, z) in zip("ABCDEF", S.tolist(), strict=True))
    stations.write_text("name,x,y,z\n" + "".join(places), encoding="utf-8")
    lines = (f"{i}," + ",".join(f"{value:.13f}" for value in row) + "\n" for i, row in enumerate(times))
    table.write_text("event," + ",".join(f"{name}_s" for name in "ABCDEF") + "\n" + "".join(lines), encoding="utf-8")
    options = ColumnHints(stations=stations, sigma=f"{1e9 * CLOCK:g} ns", what="arrivals")

    def ready(method: str) -> list[Call]:
        out = folder / f"{next(number)}.csv"

        def call() -> Path:
            run_fix(table, method, {}, out=out, quiet=True, table=options)
            return out

        return [call]

    def read(paths: list[Path]) -> Answers:
        rows = list(read_table(paths[0]))
        x = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
        cost = np.array([float(row["cost"]) for row in rows])
        return Answers([row["status"] for row in rows if "status" in row], cost, np.linalg.norm(x - truth, axis=1))

    def theirs() -> list[Call]:
        out = folder / f"{next(number)}.csv"
        return [lambda: fix_by_scipy(table, out, truth)]

    ways = {
        "solve": Way(lambda: ready(FAST), read, EVENTS),
        "auto": Way(lambda: ready("auto"), read, EVENTS),
        "opponent": Way(theirs, read, EVENTS),
    }
    return Case("CSV to CSV, an event", ways, "csv and SciPy LM from the truth")


def work(folder: Path) -> list[Callable[[], Case]]:
    """Return a function for each row."""
    filters = [lambda name=name: filter_case(name) for name in UPDATES]
    return [*filters, registration_case, calibration_case, lambda: table_case(folder)]
