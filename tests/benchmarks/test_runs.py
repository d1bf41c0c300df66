"""Time and memory of long runs: the one grows with the epochs, the other does not. Run it in a quiet moment."""

import os
import platform

import numpy as np
import pytest
from benchmarks.growth import BATCH, CHUNK, EPOCHS, TRIALS, Growth, batched, flight, general, growth
from monte_carlo.layouts import SEED
from monte_carlo.tables import FOLDER, write

from optloc import solve
from optloc.show.pictures import save
from optloc.show.pictures.style import BLUE, GREY, ORANGE, figure_class

PICTURE = FOLDER / "runs.png"
HEADER = ["what", "seconds", "working memory, MB", "the problem itself, MB", "update by one epoch, ms"]
# From 5000 to 10 000 epochs: twice the time and no more memory, with room for the scatter of both.
STEEP, FLAT = 3.0, 1.25


@pytest.mark.parametrize("epochs", EPOCHS)
def test_one_run(benchmark, epochs):
    benchmark.group = "one run of five stations over 600 s"
    problem = flight(epochs)
    fix = benchmark.pedantic(solve, (problem,), rounds=3, warmup_rounds=1)
    assert fix.answered.all()


def test_time_is_linear_and_memory_flat():
    few, many = growth(EPOCHS[-2], rounds=2), growth(EPOCHS[-1], rounds=2)
    assert many.seconds < STEEP * few.seconds
    assert many.working < FLAT * few.working


@pytest.mark.full
def test_write_the_table_and_the_picture():
    weighed = [growth(epochs) for epochs in EPOCHS]
    eliminated = [growth(epochs, eliminated=True, rounds=1) for epochs in EPOCHS]
    rows = [
        [f"{one.epochs} epochs, station errors {how}", *figures(one)]
        for how, found in (("weighed", weighed), ("eliminated", eliminated))
        for one in found
    ]
    theirs = general()
    for method in ("auto", "gtrs+lsr"):
        seconds = batched(method)
        each = f"{1e3 * seconds / TRIALS:.1f} ms each, {seconds / TRIALS / theirs:.1f} times scipy from the truth"
        rows.append(
            [f"{TRIALS} runs of {BATCH} epochs, {method}, chunks of {CHUNK}: {each}", f"{seconds:.1f}", *[""] * 3]
        )
    rows.append([f"one run of {BATCH} epochs, scipy least_squares from the truth", f"{theirs:.4f}", *[""] * 3])
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "not set")
    facts = (
        f"five stations, one fixed target, four biases, a flight of 600 s, seed {SEED}; numpy {np.__version__}, "
        f"Python {platform.python_version()}, OPENBLAS_NUM_THREADS {threads}"
    )
    assert write("runs", HEADER, rows, facts).is_file()
    draw(weighed, eliminated)
    assert PICTURE.is_file()


def figures(one: Growth) -> list[str]:
    return [f"{one.seconds:.3f}", f"{one.working:.1f}", f"{one.stored:.1f}", f"{1e3 * one.update:.1f}"]


def draw(weighed: list[Growth], eliminated: list[Growth]) -> None:
    """Write the picture of time and working memory against epochs."""
    figure = figure_class()(figsize=(9.6, 4.0), layout="constrained")
    time, memory = figure.subplots(1, 2)
    for found, colour, label in ((weighed, BLUE, "weighed"), (eliminated, ORANGE, "eliminated")):
        epochs = [one.epochs for one in found]
        time.plot(epochs, [one.seconds for one in found], "o-", color=colour, label=f"station errors {label}")
        memory.plot(epochs, [one.working for one in found], "o-", color=colour, label=f"station errors {label}")
    memory.plot(EPOCHS, [one.stored for one in weighed], "--", color=GREY, label="the problem itself")
    for panel, what in ((time, "seconds of a fix"), (memory, "working memory (MB)")):
        panel.set_xlabel("epochs")
        panel.set_ylabel(what)
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.grid(which="both", color=GREY, alpha=0.3, linewidth=0.6)
        panel.legend(frameon=False)
    save(figure, PICTURE)
