"""Every method on the same data, with peers: `pytest -m full tests/benchmarks -k table`, in a quiet moment.

Peers that the interpreter of the tests lacks are looked for in those that OPTLOC_PEERS names.
"""

import csv
import os
import platform

import numpy as np
import pytest
from benchmarks import picture, scaling
from benchmarks.rounds import PEERS, product
from benchmarks.scenes import COUNT, SCENES, SIGMA, STATIONS
from benchmarks.table import HEADER, JUDGED, MANY, SCIPY, SUMMARY, cells, lines, save_csv, summary
from monte_carlo.tables import FOLDER, repeat, write

ROUNDS = 7
MILLION = 1_000_000
FASTER = 100.0


def machine() -> str:
    threads = os.process_cpu_count() if hasattr(os, "process_cpu_count") else os.cpu_count()
    return f"numpy {np.__version__}, Python {platform.python_version()}, {platform.machine()}, {threads} cores"


def test_the_harness_on_few_fixes(tmp_path):
    """All methods answer, and those that start at the truth or need no start reach the global minimum."""
    found, _ = lines(tmp_path, rounds=1, judged=40, scale=0.01)
    assert {line.scene for line in found} == set(SCENES)
    for line in found:
        sure = line.one.group == "optloc" or line.one.name == SCIPY
        assert not sure or line.verdict["global"] > 0.9, line.one.name
        assert line.times.microseconds > 0.0
    save_csv(found, tmp_path / "out.csv")
    with (tmp_path / "out.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(found)
    picture.methods(found, tmp_path / "out.png")
    assert (tmp_path / "out.png").stat().st_size > 10_000


@pytest.mark.full
def test_write_the_table(tmp_path):
    found, missing = lines(tmp_path, ROUNDS)
    absent = f"; not installed, also not in {PEERS}: {', '.join(missing)}" if missing else ""
    facts = (
        f"TDOA with {STATIONS} stations, {SIGMA:g} m; batches of {COUNT} where a method takes batches, "
        f"of {MANY} where it takes microseconds; medians of {ROUNDS} interleaved rounds on one core; accuracy over the "
        f"first {JUDGED} fixes; {machine()}{absent}"
    )
    write("benchmarks", HEADER, [row for scene in SCENES for row in cells(found, scene)], facts)
    repeat(write("peers", SUMMARY, summary(found), facts), FOLDER.parents[1] / "README.md")
    save_csv(found, FOLDER / "benchmarks.csv")
    picture.methods(found, FOLDER / "benchmarks.png")
    ours = {line.scene: line for line in found if line.one.name == "optloc, gtrs+lsr"}
    theirs = {line.scene: line.times.ratio for line in found if line.one.name == SCIPY}
    assert all(theirs[scene] > FASTER * line.times.ratio for scene, line in ours.items())
    for line in found:
        if line.one.group == "peer":
            assert ours[line.scene].times.ratio < line.times.ratio, line.one.name
            assert ours[line.scene].verdict["global"] >= line.verdict["global"], line.one.name


@pytest.mark.full
def test_write_the_growth_table():
    found = [*scaling.with_stations(3), *scaling.with_epochs(3), *scaling.with_batch(2)]
    rows = [
        [f"{curve.axis}: {at}, {curve.method}", f"{us:.3g}", f"{ratio:.2g}"]
        for curve in found
        for at, us, ratio in zip(curve.at, curve.microseconds, curve.products, strict=True)
    ]
    for method, inside in (("gtrs+lsr", 1.0), ("gtrs+lsr+value", 0.5), ("gtrs+lsr+certify", 0.5), ("auto", 0.5)):
        with scaling.threads(2):
            seconds, megabytes, proven = scaling.million(method, MILLION, inside)
        what = f"{MILLION:,} fixes of one call, {method}, two threads, {100 * inside:.0f} % inside: {seconds:.2f} s, "
        what += f"{megabytes:.0f} MB, {100 * proven:.1f} % proven global"
        rows.append([what, f"{1e6 * seconds / MILLION:.3g}", f"{seconds / MILLION / product():.2g}"])
    facts = f"TDOA, {SIGMA:g} m, emitters inside; one thread unless stated; quietest of the rounds; {machine()}"
    assert write("growth", ["where", "us a fix", "in products of order 200"], rows, facts).is_file()
    with (FOLDER / "growth.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["axis", "method", "at", "us", "products"])
        for curve in found:
            for numbers in zip(curve.at, curve.microseconds, curve.products, strict=True):
                writer.writerow([curve.axis, curve.method, *(f"{number:.4g}" for number in numbers)])
    picture.growth(found, FOLDER / "growth.png")
