"""Whether a file that still reads says what a plain re-reading of it says, and its fix is that of the plain numbers."""

import json
import math

import numpy as np
from fuzz import plain

import optloc

# Epochs that are solved again: each by itself, which is slower than all at once.
EPOCHS = 12
# Of what is the same sum in another order, relative to the largest number in it.
ROUNDING = 1e-9


def judge(path, arguments, code, answer):
    """Return a word, and behind a colon what it is about.

    unread: the file is refused. not judged: the plain reading lacks something. mismatch. same: rows and stations are.
    same fix: and so are status and position of every epoch.
    """
    from optloc.base.inputs import access
    from optloc.files.reader import read

    try:
        with access(anew=True):
            problem = read(path).problem
    except optloc.InvalidProblem:
        return "unread"
    try:
        own = plain.read(path)
    except plain.Uncovered as lack:
        return f"not judged: {lack}"
    except Exception as error:  # noqa: BLE001  (what cannot be read plainly should not have been read)
        return f"mismatch: the plain reading fails: {error!r:.200}"
    wrong = differences(own, problem)
    if wrong:
        return f"mismatch: {wrong}"
    # Options of the command line would change the fix.
    if arguments[0] != "fix" or arguments[2:] != ("--json",) or code not in (0, 1) or not answer:
        return "same"
    return of_fixes(own, problem, json.loads(answer))


def differences(own, problem):
    """Return the first thing in which a plain reading and a problem differ, or nothing."""
    if tuple(own.names) != problem.stations.names:
        return f"stations {own.names} and {problem.stations.names}"
    place = problem.stations.position
    if len(own.place) > 1 or len(place) > 1:
        place = np.broadcast_to(place, (own.count, *place.shape[1:]))
    for epoch, here in enumerate(own.place):
        for station, at in enumerate(here):
            if at is not None and not close(at, place[epoch, station], np.abs(at).max() + 1e7):
                return f"station {own.names[station]} at epoch {epoch}: {at} and {place[epoch, station]}"
    moves = problem.stations.velocity
    if (own.velocity is None) != (moves is None):
        return f"velocities {own.velocity} and {moves}"
    for epoch, here in enumerate(own.velocity or []):
        for station, rate in enumerate(here):
            if rate is not None and not close(rate, moves[epoch, station], np.abs(rate).max()):
                return f"velocity of {own.names[station]} at epoch {epoch}: {rate} and {moves[epoch, station]}"
    found = of_problem(problem)
    if len(found) != len(own.rows) or problem.epochs != own.count:
        return f"{len(own.rows)} rows in {own.count} epochs and {len(found)} in {problem.epochs}"
    for number, (row, epoch, other) in enumerate(zip(own.rows, own.epochs, found, strict=True)):
        mine = (row.kind, own.names.index(row.a) if row.a else -1, own.names.index(row.b) if row.b else -1, epoch)
        if mine != other[:4]:
            return f"row {number}: {mine} and {other[:4]}"
        variance = None if row.sigma is None else row.sigma**2
        if row.arrival is not None:
            variance = row.arrival[0] ** 2 + row.arrival[1] ** 2
        for name, one, two in zip(
            ("z", "weight", "correction", "variance"),
            (row.z, row.weight, row.correction, variance),
            other[4:],
            strict=True,
        ):
            if one is not None and not close(one, two, max(abs(one), abs(two)) + 4.0 * (name == "z")):
                return f"row {number}: {name} {one} and {two}"
    return ""


def of_problem(problem):
    """Return (kind, a, b, epoch, z, weight, correction, variance) of each row."""
    variance = np.zeros(problem.count)
    for block in problem.noise.blocks:
        diagonal = np.diagonal(block.covariance, axis1=-2, axis2=-1)
        variance[block.row] = np.broadcast_to(diagonal, block.row.shape)
    found = []
    for rows in problem.rows:
        columns = (rows.a, rows.b, rows.epoch, rows.z, rows.weight, rows.correction)
        found += [(rows.kind, *(value.item() for value in each)) for each in zip(*columns, strict=True)]
    return [(*each, v) for each, v in zip(found, variance.tolist(), strict=True)]


def close(one, two, size):
    """Return whether numbers are equal but for rounding, NaN being equal to itself."""
    one, two = np.asarray(one, dtype=float), np.asarray(two, dtype=float)
    return bool(np.all((np.abs(one - two) <= ROUNDING * size) | (np.isnan(one) & np.isnan(two))))


def of_fixes(own, problem, told):
    """Compare what the command line says of each epoch with the fix of the plain numbers of that epoch."""
    angles = any(row.kind in ("azimuth", "elevation") for row in own.rows)
    lacks = [*own.beyond, *(["axes on Earth"] if angles and own.frame[0] in ("geodetic", "ecef", "enu") else [])]
    if lacks or own.count > EPOCHS:
        return f"same: its fix is not judged: {', '.join(lacks) or 'many epochs'}"
    for epoch, said in enumerate(told["fixes"]):
        fix = optloc.solve(problem_of(own, epoch))
        # Which refusal it is may hang on the last digit; what is claimed may not.
        if fix.status.label != said["status"] and "ok" in (fix.status.label, said["status"]):
            return f"mismatch: epoch {epoch} is {said['status']}, of the plain numbers {fix.status.label}"
        # An answer that must not be used may be any of several, as rounding has it.
        if fix.status != optloc.Status.OK:
            continue
        there = np.array([said[axis] for axis in "xyz"[: len(fix.position)]], dtype=float)
        spread = math.sqrt(np.trace(np.atleast_2d(fix.cov[: len(there), : len(there)])))
        if np.abs(there - fix.position).max() > 1e-3 * spread + 1e-7 * np.abs(there).max():
            return f"mismatch: epoch {epoch} is at {there}, of the plain numbers at {fix.position}"
    return "same fix"


def problem_of(own, epoch):
    """Return the problem of one epoch of a plain reading."""
    here = own.place[epoch if len(own.place) > 1 else 0]
    known = next(at for at in here if at is not None)
    place = np.array([[known if at is None else at for at in here]])
    velocity = None
    if own.velocity is not None:
        moves = own.velocity[epoch if len(own.velocity) > 1 else 0]
        velocity = np.array([[[0.0] * place.shape[-1] if rate is None else rate for rate in moves]])
    kind, origin = own.frame
    frame = optloc.problem.CARTESIAN if kind == "cartesian" else optloc.problem.ECEF
    if kind == "enu":
        frame = optloc.Frame.enu(lat_deg=origin[0], lon_deg=origin[1], height=origin[2])
    parts = []
    rows = [row for row, at in zip(own.rows, own.epochs, strict=True) if at == epoch]
    for kind in dict.fromkeys(row.kind for row in rows):
        same = [row for row in rows if row.kind == kind]
        index = {name: i for i, name in enumerate(own.names)}
        given = {"a": [index[row.a] for row in same]} if same[0].a else {}
        given |= {"b": [index[row.b] for row in same]} if same[0].b else {}
        noise = covariance(same, epoch)
        parts.append(
            optloc.measured(
                kind, [row.z for row in same], covariance=noise, weight=[row.weight for row in same],
                correction=[row.correction for row in same], **given,
            )
        )  # fmt: skip
    return optloc.assemble(optloc.Stations(place, tuple(own.names), velocity), *parts, frame=frame)


def covariance(rows, epoch):
    """Return the covariance of rows of one kind: independent, or of arrivals that they share."""
    out = np.diag([0.0 if row.sigma is None else row.sigma**2 for row in rows])
    for i, one in enumerate(rows):
        for j, two in enumerate(rows):
            if one.arrival is None or two.arrival is None:
                continue
            signs = plain.SIGNS[one.kind]
            for name, s, size in zip((one.a, one.b), signs, one.arrival, strict=True):
                for other, t in zip((two.a, two.b), signs, strict=True):
                    out[i, j] += s * t * size**2 * (name == other and name is not None)
    return out
