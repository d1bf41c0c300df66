"""P and S picks of tables: a column of phases, or a column for each wave.

In the functions, `roles` has the table and the roles of its columns, and `hints` has the options. In shapes, m is the
number of picks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from decimal import Decimal

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.base.units import UNITS
from optloc.files.cell_text import Decimals, date_seconds, is_dated, numbers
from optloc.files.measurements import ESTIMATE
from optloc.files.phase_rows import wave_of
from optloc.files.pick_files import SHARE
from optloc.files.roles import Roles
from optloc.files.settings import Units
from optloc.files.table_import import ColumnHints, Readings, in_unit, sort_named, stated_sigma, unit_for
from optloc.files.words import objects

# Largest number of phase names in a message.
_SHOWN = 4
Pick = tuple[int, str, Decimal, int]
"""Row, wave, time in seconds, and number of the column of a pick."""


def read_picks(roles: Roles, hints: ColumnHints) -> Readings:
    """Return the arrivals of P and S waves, s; `Readings.phase` has the wave of each.

    Raise InvalidProblem if an S wave is not after the P wave of its station and event, or if there is no pick.
    """
    table, station = roles.table, roles.labels("station")
    picks, headers, notes = _picks(roles, hints)
    if not picks:
        raise InvalidProblem("there are no P and S picks", table.source, "state their columns with --column p=, s=")
    event = roles.labels("message").tolist() if roles.find("message") else [""] * table.count
    _check_order(picks, [*zip(event, station.tolist(), strict=True)], roles)
    rows = np.array([row for row, *_ in picks])
    waves = [wave for _, wave, *_ in picks]
    values = Decimals.of([time for _, _, time, _ in picks])
    column = np.array([number for *_, number in picks])
    found = Readings(sort_named("picks"), "s", values, rows, headers, column, station[rows], notes=notes)
    dated = all(is_dated(table, header) for header in headers)
    found = replace(found, phase=objects(waves), dated=dated)
    given = phase_sigmas(hints)
    if given is None:
        return _weighted(found, roles, stated_sigma(hints, "toa"))
    lacking = next((wave for wave in dict.fromkeys(waves) if wave not in given), None)
    if lacking is not None:
        raise InvalidProblem(f"{lacking} picks have no sigma", "--sigma", "write --sigma 'p=0.05 s,s=0.1 s'")
    return replace(found, sigma=np.array([given[wave] for wave in waves]) / np.sqrt(_shares(roles)[rows]))


def _shares(roles: Roles) -> Array:
    """Return the share of the full weight of each row of a table of picks; 1 without weights."""
    return roles.table.numbers(SHARE) if roles.table.has(SHARE) else np.ones(roles.table.count)


def _weighted(found: Readings, roles: Roles, sigma: str | None) -> Readings:
    """Return picks with standard deviations that follow from a stated `sigma` and from weights of picks, if any."""
    if sigma in (None, ESTIMATE) or not roles.table.has(SHARE):
        return found
    return replace(found, sigma=Units("time").plain(str(sigma), "s", "--sigma") / np.sqrt(_shares(roles)[found.row]))


def phase_sigmas(hints: ColumnHints) -> Mapping[str, float] | None:
    """Return the standard deviation, s, that --sigma states for "P" and "S"; None if it states none for a wave."""
    parts = [part.partition("=") for part in (hints.sigma or "").split(",")]
    if not parts or not all(sign and word.strip().upper() in ("P", "S") for word, sign, _ in parts):
        return None
    return {word.strip().upper(): Units("time").plain(amount.strip(), "s", "--sigma") for word, _, amount in parts}


def differences(roles: Roles, hints: ColumnHints) -> Readings:
    """Return S minus P times, s, of the stations with both picks; raise InvalidProblem if no station has both."""
    found = read_picks(roles, replace(hints, sigma=None))
    event = roles.labels("message").tolist() if roles.find("message") else [""] * roles.table.count
    times = found.values.tolist()
    keys = [(event[row], name) for row, name in zip(found.row.tolist(), found.a.tolist(), strict=True)]
    waves = [] if found.phase is None else found.phase.tolist()
    p, s = ({key: i for i, key in enumerate(keys) if waves[i] == wave} for wave in ("P", "S"))
    both = [(p[key], s[key]) for key in p if key in s]
    if not both:
        raise InvalidProblem("no station has both P and S", roles.table.source, "leave --as sp out")
    n_without_pair = len({name for _, name in keys}) - len({keys[i][1] for i, _ in both})
    notes = (
        (f"{n_without_pair} stations without both P and S are left out; remove --as sp to use them",)
        if n_without_pair
        else ()
    )
    pairs = found.take(np.array([i for i, _ in both]))
    last = np.full(len(both), len(found.headers) - 1)
    # The stated sigma is of a difference of two picks of full weight.
    inverse = 1.0 / _shares(roles)[found.row]
    ratio = np.sqrt([(inverse[i] + inverse[j]) / 2.0 for i, j in both])
    stated = stated_sigma(hints, "range")
    weighted = roles.table.has(SHARE) and stated not in (None, ESTIMATE)
    sigma = Units("time").plain(str(stated), "s", "--sigma") * ratio if weighted else None
    values = Decimals.of([times[j] - times[i] for i, j in both])
    return replace(
        pairs, form=sort_named("sp"), values=values, headers=found.headers, column=last, phase=None, sigma=sigma,
        notes=(*found.notes, *notes),
    )  # fmt: skip


def _picks(roles: Roles, hints: ColumnHints) -> tuple[list[Pick], tuple[str, ...], tuple[str, ...]]:
    """Return the picks in the order of the rows, the columns of their times, and notes."""
    if roles.find("p") and roles.find("s"):
        headers = (roles.column("p"), roles.column("s"))
        pairs = [
            (row, wave, time, number)
            for number, (role, wave) in enumerate((("p", "P"), ("s", "S")))
            for row, time in _times(roles, hints, role)
        ]
        return sorted(pairs, key=lambda pick: (pick[0], pick[3])), headers, ()
    phase = roles.labels("phase").tolist()
    waves = [wave_of(str(word)) for word in phase]
    picks = [(row, wave, time, 0) for row, time in _times(roles, hints, "time") if (wave := waves[row]) is not None]
    other = [str(word) for word, wave in zip(phase, waves, strict=True) if wave is None]
    names = ", ".join([*dict.fromkeys(other)][:_SHOWN])
    note = f"picks of other phases than P and S are left out: {len(other)} ({names}); rename them if they are P or S"
    return picks, (roles.column("time"),), (note,) if other else ()


def _times(roles: Roles, hints: ColumnHints, role: str) -> Iterator[tuple[int, Decimal]]:
    """Yield row and time, s, of the cells in the column of a role that are not empty."""
    table, column, unit = roles.table, roles.column(role), "s"
    dated = is_dated(table, column)
    cells = date_seconds(table, column, hints.zone) if dated else numbers(table, column)
    form = sort_named("picks")
    if not dated:
        stated = hints.time_unit if role == "time" else None
        unit = stated or unit_for(column, form, hints, cells.values, table.source)[0]
    if unit not in UNITS["time"]:
        raise InvalidProblem(f"picks are times, but the unit is {unit}", table.where(column), "state --unit s")
    for row, value in zip(cells.row.tolist(), cells.values.tolist(), strict=True):
        yield row, in_unit(value, unit, "s", form)


def _check_order(picks: list[Pick], keys: list[tuple[str, str]], roles: Roles) -> None:
    """Raise InvalidProblem if an S wave is not after a P wave; `keys` has event and station of each row."""
    first: dict[tuple[str, str], Decimal] = {}
    for row, wave, time, _ in picks:
        if wave == "P":
            first[keys[row]] = min(time, first.get(keys[row], time))
    early = next((row for row, wave, time, _ in picks if wave == "S" and time <= first.get(keys[row], time - 1)), None)
    if early is not None:
        what = f"the S wave is not after the P wave of station {keys[early][1]!r}"
        advice = "correct the picks, or state the column of events with --column message=NAME"
        raise InvalidProblem(what, roles.table.at(early), advice)


def waves_of(found: Readings) -> Array | None:
    """Return the waves (m,) of picks for the column `phase` of a problem file; None without S waves."""
    return found.phase if found.phase is not None and (found.phase == "S").any() else None
