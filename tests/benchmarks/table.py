"""The table of methods: speed and accuracy on the same data in the same run."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarks.rounds import Contender, Times, Worker, interpreter, timed
from benchmarks.scenes import COUNT, SCENES, SIGMA, STATIONS, Scene
from monte_carlo import layouts
from monte_carlo.reference import global_minimum

Array = np.ndarray
JUDGED = 500
# Emitters in a call of methods that take a microsecond each: the data, again and again.
MANY = 100_000
SCIPY = "SciPy least_squares from the truth"
# A fix is the global minimum if its cost is that of the best of 21 refined starts but for rounding.
SAME = 1e-3
# Squared distance from the truth within which an error counts as that of the right minimum: 5 sigma.
NEAR = 25.0


def draw(name: str) -> Scene:
    """Return a scene: an array for each emitter, in a box of 10 x 10 x 6 km, the emitter in it or 10 to 30 km away."""
    rng, kind = np.random.default_rng([layouts.SEED, SCENES.index(name)]), layouts.KINDS["tdoa"]
    stations = layouts.anywhere(STATIONS, rng, COUNT)
    truth = {"inside": layouts.inside, "outside": layouts.outside}[name](rng, COUNT)
    covariance = kind.covariance(STATIONS - 1, SIGMA)
    noise = rng.standard_normal((COUNT, STATIONS - 1)) @ np.linalg.cholesky(covariance).T
    return Scene(stations, layouts.model(kind, stations, SIGMA).exact(truth) + noise, truth, covariance)


@dataclass(frozen=True)
class Judge:
    """What the first emitters of a scene are compared with.

    Parameters
    ----------
    scene : Scene
        Of the emitters judged.
    best : array (N,)
        Cost of the best minimum that many starts find, one of them the truth.
    exists : bool array (N,)
        Whether that minimum is finite: the likelihood does not keep rising towards infinity.
    """

    scene: Scene
    best: Array
    exists: Array

    @classmethod
    def of(cls, name: str, scene: Scene, judged: int) -> Judge:
        first = scene.first(judged)
        model = layouts.model(layouts.KINDS["tdoa"], first.stations, SIGMA)
        seed = np.random.SeedSequence([layouts.SEED, SCENES.index(name), 1])
        found = global_minimum(model, first.z, first.truth, seed)
        return cls(first, found.cost, ~found.at_infinity)

    def verdict(self, position: Array) -> dict[str, float]:
        """Return shares of global minima and of errors within 5 sigma, and the size of those against the bound."""
        scene = self.scene
        model = layouts.model(layouts.KINDS["tdoa"], scene.stations, SIGMA)
        cost = model.cost(np.nan_to_num(position, nan=np.inf), scene.z)
        jacobian = model.residual(scene.truth, scene.z, np.arange(len(scene.z)))[1]
        error = np.nan_to_num((position - scene.truth), nan=1e12)[..., None]
        squared = ((jacobian @ error)[..., 0] ** 2).sum(-1)
        near = (squared <= NEAR) & self.exists
        return {
            "global": float(np.mean((cost <= self.best + SAME)[self.exists])),
            "near": float(near.sum() / self.exists.sum()),
            "error": float(np.sqrt(squared[near].mean() / 3.0)) if near.any() else np.nan,
        }


@dataclass(frozen=True)
class Line:
    """What one method does on one scene."""

    scene: str
    one: Contender
    times: Times
    verdict: dict[str, float]


# Module, what it needs, more settings of its process, group, and the fixes of a round of each of its methods.
SQUADS: tuple[tuple[str, str, dict[str, str], str, dict[str, int]], ...] = (
    (
        "with_optloc",
        "optloc",
        {},
        "optloc",
        {
            "gtrs+lsr": MANY,
            "gtrs+lsr+value": COUNT,
            "gtrs+lsr+certify": COUNT,
            "auto": COUNT,
            "gtrs+lsr, one by one": 300,
            "gtrs+nlp": 100,
            "sdp+lsr": 200,
            "socp+lsr": 200,
        },
    ),
    ("with_optloc", "optloc", {"NUMBA_DISABLE_JIT": "1"}, "optloc", {"gtrs+lsr": COUNT}),
    (
        "with_general",
        "optloc",
        {},
        "general",
        {
            SCIPY: 300,
            "CasADi, mapped Gauss-Newton from the truth": MANY,
            "CasADi + IPOPT from the truth": 100,
            "cvxpy, order-1 SDP, solved again": 50,
            "cvxpy, order-1 SDP, cold": 20,
        },
    ),
    ("with_jax", "jax", {}, "general", {"JAX, Gauss-Newton from the truth": MANY}),
    (
        "with_stonesoup",
        "stonesoup",
        {},
        "peer",
        {
            "Stone Soup, extended Kalman update of a wide prior": 100,
            "Stone Soup, iterated Kalman update of a wide prior": 100,
            "Stone Soup, unscented Kalman update of a wide prior": 100,
        },
    ),
    (
        "with_ewgeo",
        "ewgeo",
        {},
        "peer",
        {
            "ewgeo, Chan-Ho": 100,
            "ewgeo, least squares from the middle": 100,
            "ewgeo, Chan-Ho, then least squares": 100,
        },
    ),
)


@contextmanager
def contenders(files: list[Path], scale: float = 1.0) -> Iterator[tuple[list[Contender], list[str]]]:
    """Yield the methods that this machine has, with their processes running, and the libraries that it lacks."""
    found: list[Contender] = []
    missing: list[str] = []
    workers: list[Worker] = []
    try:
        for module, library, settings, group, methods in SQUADS:
            python = interpreter(library)
            if python is None:
                missing.append(library)
                continue
            workers.append(Worker(module, files, python, settings))
            note = " (without compiled kernels)" if settings else ""
            own = "optloc, " if group == "optloc" else ""
            for method, count in methods.items():
                found.append(Contender(own + method + note, workers[-1], method, max(1, int(scale * count)), group))
        yield found, missing
    finally:
        for worker in workers:
            worker.close()


def lines(folder: Path, rounds: int, judged: int = JUDGED, scale: float = 1.0) -> tuple[list[Line], list[str]]:
    """Return what every method does on every scene, and the libraries that are missing."""
    scenes = {name: draw(name) for name in SCENES}
    files = [folder / f"{name}.npz" for name in SCENES]
    for name, file in zip(SCENES, files, strict=True):
        scenes[name].save(file)
    out: list[Line] = []
    with contenders(files, scale) as (everyone, missing):
        for name, scene in scenes.items():
            judge = Judge.of(name, scene, judged)
            verdicts = {}
            for one in everyone:
                reply = one.worker.ask(one.method, name, judged, folder / "positions.npy")
                if "error" in reply:
                    raise RuntimeError(f"{one.name}: {reply['error']}")
                verdicts[one.name] = judge.verdict(np.load(folder / "positions.npy")) | reply["facts"]
            times = timed(everyone, name, rounds)
            out += [Line(name, one, times[one.name], verdicts[one.name]) for one in everyone]
    return out, missing


HEADER = (
    "method",
    "us a fix",
    "in products of order 200",
    "times faster than SciPy",
    "global minimum",
    "within 5 sigma",
    "error / bound",
    "proven global",
)


def cells(found: list[Line], scene: str) -> list[list[str]]:
    """Return the rows of one scene for reading, the quickest first."""
    mine = sorted((line for line in found if line.scene == scene), key=lambda line: line.times.microseconds)
    (theirs,) = (line.times.ratio for line in mine if line.one.name == SCIPY)
    return [
        [
            f"{scene}: {line.one.name}",
            f"{line.times.microseconds:.3g}",
            f"{line.times.ratio:.2g}",
            f"{theirs / line.times.ratio:.3g}",
            f"{100 * line.verdict['global']:.1f} %",
            f"{100 * line.verdict['near']:.1f} %",
            f"{line.verdict['error']:.2f}",
            f"{100 * line.verdict['proven']:.1f} %" if line.verdict.get("proven") else "",
        ]
        for line in mine
    ]


SHOWN = (
    "optloc, gtrs+lsr",
    "optloc, auto",
    SCIPY,
    "CasADi + IPOPT from the truth",
    "cvxpy, order-1 SDP, solved again",
    "ewgeo, Chan-Ho",
    "ewgeo, least squares from the middle",
    "ewgeo, Chan-Ho, then least squares",
    "Stone Soup, extended Kalman update of a wide prior",
    "Stone Soup, iterated Kalman update of a wide prior",
)
SUMMARY = ("method", "us a fix", "global minimum", "within 5 sigma", "error / bound", "proven global")


def summary(found: list[Line]) -> list[list[str]]:
    """Return a row for each of the methods that are compared at a glance: inside / outside."""
    rows = []
    for name in SHOWN:
        lines = [line for scene in SCENES for line in found if (line.scene, line.one.name) == (scene, name)]
        if lines:
            shares = [[f"{100 * line.verdict[key]:.1f}" for line in lines] for key in ("global", "near")]
            proven = [f"{100 * line.verdict['proven']:.1f}" for line in lines if line.verdict.get("proven")]
            times, errors = [f"{x.times.microseconds:.3g}" for x in lines], [f"{x.verdict['error']:.2f}" for x in lines]
            cells = [times, *([f"{a} %" for a in share] for share in shares), errors, [f"{a} %" for a in proven]]
            rows.append([name, *(" / ".join(cell).replace("nan", "-") for cell in cells)])
    return rows


def save_csv(found: list[Line], path: Path) -> None:
    """Write all numbers, one line for each method and scene."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = ["global", "near", "error", "proven"]
        writer.writerow(
            ["scene", "method", "group", "fixes_a_round", "rounds", "us_median", "us_min", "products", *names]
        )
        for line in found:
            times = line.times
            quickest = 1e6 * min(times.seconds) / times.count
            numbers = [line.verdict.get(name, "") for name in names]
            writer.writerow(
                [
                    line.scene,
                    line.one.name,
                    line.one.group,
                    times.count,
                    len(times.seconds),
                    f"{times.microseconds:.4g}",
                    f"{quickest:.4g}",
                    f"{times.ratio:.4g}",
                    *(number if number == "" else f"{number:.4g}" for number in numbers),
                ]
            )
