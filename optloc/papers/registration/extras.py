"""Tables that the paper lacks: how to read its noise, its second minimum, and a scene that is not degenerate."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np

from optloc.bounds import crlb
from optloc.papers.registration import printed
from optloc.papers.registration.minima import ghost
from optloc.papers.registration.scenario import NANOSECOND, PRINTED, SPATIAL, Scenario, Shape, problem, truth
from optloc.papers.registration.tables import Case, metres, percent
from optloc.papers.registration.trials import one_shot, rms
from optloc.papers.report import Table
from optloc.types import Array


def readings() -> Table:
    """Return the bounds of the fixed target under each reading of the noise, metres."""
    shapes: dict[Shape, str] = {"full": "I + 11'", "half": "(I + 11') / 2", "diag": "I"}
    header = ("covariance", "σ", "600 s, no station error", "600 s, 1 m", "600 s, 5 m", "700 s, 1 m", "sigma0, 1 m")
    lines: list[tuple[str, ...]] = [
        ("printed", "", "", "39", "75", "36.7", ", ".join(f"{v:.0f}" for v in printed.SIGMA0))
    ]
    for (shape, name), delay in product(shapes.items(), (10, 20)):
        sigma = delay * NANOSECOND
        bounds = [
            _bound(epochs, sigma, errors, shape) for epochs, errors in ((600, 0.0), (600, 1.0), (600, 5.0), (700, 1.0))
        ]
        shot = ", ".join(f"{v:.1f}" for v in one_shot(sigma=sigma, shape=shape))
        lines.append((name, f"{delay} ns", *(f"{v:.2f}" for v in bounds), shot))
    note = (
        "Bounds of the position in metres. The printed 39 and 75 m are errors of the simulation; 36.7 m is the printed "
        "bound, which no reading gives at either time."
    )
    return Table("readings", "Which noise the paper used", header, tuple(lines), note)


def _bound(epochs: int, sigma: float, station_sigma: float, shape: Shape) -> float:
    made = problem(PRINTED, epochs, sigma=sigma, station_sigma=station_sigma, shape=shape)
    return rms(crlb(made, truth(PRINTED, made)))


def minima() -> Table:
    """Return the second minimum of the printed scene with a fixed target."""
    header = (
        "seconds", "image, km", "offset of its biases 4 and 5, m", "cost gap",
        "taken for the truth, 10 ns", "taken for the truth, 40 ns",
    )  # fmt: skip
    lines = []
    for epochs in (40, 100, 200, 300, 600, 700):
        found, noisy = ghost(PRINTED, epochs), ghost(PRINTED, epochs, sigma=40.0 * NANOSECOND)
        if found is None or noisy is None:
            continue
        offset = np.abs(found.x[5:7] - PRINTED.delays[2:]).mean()
        place = " ".join(f"{v:.1f}" for v in 1e-3 * found.x[:3])
        lines.append(
            (str(epochs), place, f"{offset:.0f}", metres(found.gap), _chance(found.doubt), _chance(noisy.doubt))
        )
    note = (
        "Noise-free data, 1 m station error, 10 ns. The gap is the cost of the image, a weighted sum of squares; half "
        "its root is how many standard deviations of noise turn the choice. The image needs biases of hundreds of "
        "metres: a prior of 200 m removes it."
    )
    return Table("minima", "The image in the plane of the stations", header, tuple(lines), note)


def _chance(share: float) -> str:
    return f"{share:.2g}" if share >= 1e-9 else "< 1e-9"


def gains() -> Table:
    """Return what gain ratios of growing accuracy add to the bound of the fixed target."""
    lines = []
    for sigma in (None, 0.03, 3e-3, 3e-4, 3e-5):
        made = problem(PRINTED, 600, gain_sigma=sigma)
        bound = rms(crlb(made, truth(PRINTED, made)))
        lines.append(("none" if sigma is None else f"{sigma:g}", f"{bound:.4f}"))
    note = (
        "Bound of the position after 600 epochs with 1 m station error. The paper has 0.03 and reports a gain of 3 m."
    )
    return Table("gains", "What gain ratios add", ("standard deviation of a ratio", "bound, m"), tuple(lines), note)


def scenes(cases: Mapping[str, Case]) -> Table:
    """Return what the printed stations and those that span space make of the same target."""
    header = (
        "stations", "out of plane, m", "closest pair, m", "bound, m", "recursion, m", "optloc, m",
        "recursion lost", "optloc lost", "cost gap of the image",
    )  # fmt: skip
    lines = []
    for (name, case), scenario in zip(cases.items(), (PRINTED, SPATIAL), strict=True):
        flat, close = flatness(scenario, 700), separation(scenario, 700)
        image = ghost(scenario, 600)
        lengths = (metres(v) for v in (flat, close, case.bound, case.plain.rmse, case.found.rmse))
        lost = (percent(case.plain.share), percent(case.found.share))
        lines.append((name, *lengths, *lost, "no image" if image is None else metres(image.gap)))
    epochs = next(iter(cases.values())).epochs
    note = f"The spatial stations are those of `optloc demo registration`. {epochs} epochs; starts 20 sigma0 wide."
    return Table("scenes", "Stations that span space", header, tuple(lines), note)


def flatness(scenario: Scenario, epochs: int) -> float:
    """Return the least root mean square distance of the stations from their best plane over a run, metres."""
    track = scenario.track(epochs)
    values = np.linalg.svd(track - track.mean(1, keepdims=True), compute_uv=False)
    return float(values[:, -1].min() / np.sqrt(track.shape[1]))


def separation(scenario: Scenario, epochs: int) -> float:
    """Return the least distance of two stations over a run, metres."""
    track: Array = scenario.track(epochs)
    first, second = np.triu_indices(track.shape[1], 1)
    return float(np.linalg.norm(track[:, first] - track[:, second], axis=-1).min())
