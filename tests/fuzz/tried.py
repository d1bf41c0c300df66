"""The verdict on a drawn table: the rows that optloc reads against those of pandas, and its fixes against the truth.

By hand: ``python -m fuzz.tried SEED FIRST COUNT`` (with ``tests`` on the path) prints a line for each wrong table and
the counts; ``python -m fuzz.tried SEED NUMBER`` writes a table to the current folder and prints its command.
"""

import json
import math
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from contextlib import chdir
from fractions import Fraction
from pathlib import Path

import numpy as np
from fuzz import reading
from fuzz.harness import outcome
from fuzz.oracle import of_problem
from fuzz.plain import C
from fuzz.tables import made
from typer.testing import CliRunner

from optloc.cli import app
from optloc.files import read

# Relative: of a value, of a standard deviation that is written with nine digits, of a place.
VALUE, SPREAD, PLACE = 1e-12, 1e-8, 1e-12
# Metres by which places of satellites differ that are turned by pseudoranges or by the times of flight themselves.
FLIGHT = 3.0
# Standard deviations by which a fix of exact data may be off, and metres that rounding takes of coordinates on Earth.
SIGMAS, ROUNDING = 5.0, 1e-5
PAIRED = ("tdoa", "rss_difference")
# Seconds by which the mean time of the rows of a window is beside the first of them.
WINDOW = 0.1


def tried(table, folder):
    """Return a word for what became of a table, and behind a colon what it is about.

    refused: one sentence. wrong: another number, or a fix that is ok elsewhere. fault: anything else. same: the rows.
    same fix: and each fix that is ok is at the truth, and there is one.
    """
    for name, data in table.files.items():
        (folder / name).write_bytes(data)
    with chdir(folder):
        code, out, err, fault = ran("convert", *table.arguments, "--out", "p.toml")
        if fault:
            return f"fault: {fault}"
        if code == 2:
            return f"refused: {err.strip()}"
        own = reading.rows_of(folder, table.arguments)
        wrong = differences(own, read(Path("p.toml")))
        if wrong:
            return f"wrong: {wrong}"
        code, out, err, fault = ran("fix", *table.arguments, "--json")
        if fault or code == 2:
            return f"fault: {fault or 'convert reads it, fix does not: ' + err}"
        return of_fixes(table, json.loads(out))


def ran(*arguments):
    """Return exit code and texts of a command, and what is wrong with them."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", RuntimeWarning)
        result = CliRunner().invoke(app, list(arguments))
    err = result.stderr
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        err += "".join(traceback.format_exception(result.exception))
    # Progress is written over; what stays is the last of a line.
    faults = outcome(result.exit_code, err)
    faults += [f"warning: {one.message}" for one in warned if issubclass(one.category, RuntimeWarning)]
    return result.exit_code, result.stdout, err, "; ".join(faults)


def differences(own, loaded):
    """Return the first thing in which a reading of its own and a problem differ, or nothing."""
    problem = loaded.problem
    rows, names = of_problem(problem), problem.stations.names
    target = np.concatenate([one.target for one in problem.rows])
    if len(rows) != len(own):
        return f"{len(own)} rows, and {len(rows)} are read"
    mine = keyed([(r.kind, epoch_of(r, loaded), r.target or "", r) for r in own], problem)
    if isinstance(mine, str):
        return mine
    theirs = {}
    for (kind, a, b, epoch, z, weight, _, variance), t in zip(rows, target, strict=True):
        label = loaded.targets[epoch if loaded.own_epochs else t] if loaded.targets else ""
        label = "" if label == "target" else label
        ends = [first_alike(problem, epoch, end) for end in (a, b)]
        if weight > 0.0:
            theirs[kind, epoch, label, *turned_round(kind, *ends)] = (
                -z if is_turned(kind, *ends) else z,
                math.sqrt(variance),
            )
    if mine.keys() != theirs.keys():
        lacking, more = sorted(mine.keys() - theirs.keys()), sorted(theirs.keys() - mine.keys())
        return f"rows {lacking[:2]} are not read, {more[:2]} are, of stations {names}"
    size = {key: 0.0 if isinstance(z, Fraction) else abs(z) for key, (z, _) in mine.items()}
    mine, theirs = from_first(mine), from_first(theirs)
    for key, (z, sigma) in mine.items():
        other, spread = theirs[key]
        off = abs(math.remainder(z - other, math.tau)) if key[0] == "azimuth" else abs(z - other)
        # A difference of floats is as exact as its terms.
        if off > VALUE * max(size[key], abs(z), 1.0):
            return f"{key}: {z!r} is read as {other!r}"
        if abs(sigma - spread) > SPREAD * sigma:
            return f"sigma of {key}: {sigma!r} is read as {spread!r}"
    return ""


def from_first(rows):
    """Return rows whose arrivals are metres behind the first arrival of their epoch and target."""
    least = {}
    for (kind, *group, _, _), (z, _) in rows.items():
        if kind == "toa":
            least[tuple(group)] = min(z, least.get(tuple(group), z))

    def metres(key, z):
        behind = z - least[key[1:3]]
        return float(behind) * (C if isinstance(z, Fraction) else 1.0)

    return {key: (metres(key, z) if key[0] == "toa" else z, sigma) for key, (z, sigma) in rows.items()}


def keyed(rows, problem):
    """Return value and standard deviation by kind, epoch, target and stations, which are found by their places."""
    found = {}
    place = np.broadcast_to(problem.stations.position, (problem.epochs, *problem.stations.position.shape[1:]))
    for kind, epoch, target, row in rows:
        if epoch is None:
            return f"epoch {row.epoch!r} is not there"
        ends = []
        for spot in (row.a, row.b):
            if spot is None:
                ends.append(-1)
                continue
            if len(spot) != place.shape[-1]:
                return f"stations of {place.shape[-1]} coordinates, not {len(spot)}"
            off = np.linalg.norm(place[epoch] - np.array(spot), axis=-1)
            near = int(np.argmin(np.where(np.isnan(off), np.inf, off)))
            satellite = np.linalg.norm(spot) > 1e7
            if off[near] > (FLIGHT if satellite else PLACE * max(np.linalg.norm(spot), 1.0)):
                return f"a station at {spot} is {off[near]:.3g} m off"
            ends.append(near)
        found[kind, epoch, target, *turned_round(kind, *ends)] = (
            -row.z if is_turned(kind, *ends) else row.z,
            row.sigma,
        )
    return found


def first_alike(problem, epoch, station):
    """Return the first station at the place of one: a table may have one twice, by other names."""
    place = problem.stations.position
    here = place[epoch if len(place) > 1 else 0]
    return station if station < 0 else int(np.argmax(np.all(here == here[station], axis=-1)))


def is_turned(kind, a, b):
    """Return whether the stations of a pair stand the other way round."""
    return kind in PAIRED and a > b


def turned_round(kind, a, b):
    """Return the stations of a row, the lower number first."""
    return (b, a) if is_turned(kind, a, b) else (a, b)


def epoch_of(row, loaded):
    """Return the number of the epoch of a row, None where there is no such."""
    known = [
        k for k in range(len(loaded.epochs)) if not loaded.own_epochs or loaded.targets[k] == (row.target or "target")
    ]
    if isinstance(row.epoch, str):
        return next((k for k in known if plainly(loaded.epochs[k]) == plainly(row.epoch)), None)
    if row.epoch is None:
        return known[0] if len(known) == 1 else None
    # Times of a window are the means of their rows.
    return next((k for k in known if near(row.epoch, loaded.times[k])), None)


def plainly(label):
    """Return a label as a whole number spells it."""
    return label.removesuffix(".0")


def of_fixes(table, told):
    """Return whether fixes that are ok are at the truth."""
    judged = 0
    if not table.exact:
        return "same"
    for fix in told["fixes"]:
        if fix["status"] != "ok":
            continue
        spot = truth_of(table, fix)
        if spot is None:
            return f"wrong: there is a fix of epoch {fix['epoch']}, target {fix['target']}"
        judged += 1
        for axis, true in zip("xyz", spot, strict=False):
            off = abs(fix[axis] - true)
            if off > SIGMAS * fix[f"sigma_{axis}"] + ROUNDING:
                return f"wrong: ok at {axis} = {fix[axis]}, {off:.4g} m off, sigma {fix[f'sigma_{axis}']:.3g} m"
    return "same fix" if judged else "same"


def truth_of(table, fix):
    """Return the place of the target of a fix, None where the table has no such epoch or target."""
    label = plainly(fix["epoch"])
    for (epoch, target), spot in table.truth.items():
        if target not in (None, fix["target"]):
            continue
        if epoch is None or epoch == label or (isinstance(epoch, float) and near(epoch, fix["time"], label)):
            return spot
    return None


def near(epoch, time, label=""):
    """Return whether an epoch in seconds is the one of a time, or of a label where an epoch has no time."""
    try:
        return abs(epoch - float(label if time is None else time)) < WINDOW
    except ValueError:
        return False


def run_part(seed, first, count):
    """Return the faults of some tables, and counts of what became of all."""
    counts, faults, refused = Counter(), [], []
    for number in range(first, first + count):
        table = made(seed, number)
        with tempfile.TemporaryDirectory() as folder:
            try:
                said = tried(table, Path(folder))
            except Exception as error:  # noqa: BLE001  (the reading of its own has no rule for it)
                said = f"unjudged: {error!r} {traceback.extract_tb(error.__traceback__)[-1]}"
        word = said.partition(":")[0]
        counts[word] += 1
        if word in ("wrong", "fault", "unjudged"):
            faults.append(f"{table.name}: {said}")
            sys.stderr.write(f"{faults[-1]}\n")
            sys.stderr.flush()
        refused += [f"{table.name}: {said}"] if word == "refused" else []
    return faults, counts, refused


def main():
    """Run, or write, the tables that the command line names."""
    seed, first, *more = sys.argv[1:]
    if not more:
        table = made(int(seed), int(first))
        for name, data in table.files.items():
            Path(name).write_bytes(data)
        sys.stdout.write(f"optloc fix {' '.join(map(repr, table.arguments))}\n{table.about}\n")
        return
    faults, counts, refused = run_part(int(seed), int(first), int(more[0]))
    sys.stdout.write(json.dumps({"faults": faults, "counts": counts, "refused": refused}) + "\n")


if __name__ == "__main__":
    main()
