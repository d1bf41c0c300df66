"""Explanations by one wrong station: offset, sign, scale, drift, period, exchanged names, a wrong position."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np

from optloc.advice.change import Change, ErrorColumn, MisfitCase, Wording
from optloc.advice.suspects import Suspects
from optloc.advice.wording import bias_lines, quoted, size_text, station_lines, station_words, unit_of
from optloc.base.types import Array, CompassRows
from optloc.base.units import SPEED_OF_LIGHT
from optloc.models import MODELS
from optloc.problem.bias import family
from optloc.problem.forms import FORMS

# Stations whose other errors are tried: the best few without whose rows the cost is least.
_TRIED = 5
# Largest number of stations of which all pairs are tried.
_PAIRS = 8
# Periods of codes and clocks, s: GPS C/A code, GPS data bit, second. Their multiples up to the third are tried.
_PERIODS = {"1 ms, the period of a code": 1e-3, "20 ms": 2e-2, "1 s": 1.0}
_MULTIPLES = 3
# For steps: least number of times of a run, number of times at which a step may start, and number of stations tried.
_STEP_TIMES, _CUTS, _STEPPED = 6, 12, 2
# Number of angles of a rotation in space.
_ANGLES = 3


def offsets(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield the offsets of each station, and of all rows of a kind that has one station."""
    yield from suspects.offsets
    for kind in case.kinds:
        if MODELS[kind].stations == 1 and not MODELS[kind].emission and kind != "azimuth":
            column = np.broadcast_to(case.coefficients("kind", "offset", kind), case.present.shape)
            words = partial(_words_of_kind, case, kind)
            yield Change("offset", words, columns=(ErrorColumn("adds", column),), starts=((0.0,),))


def _words_of_kind(case: MisfitCase, kind: str, theta: Array, sigma: Array) -> Wording:
    size = size_text(theta[0], sigma[0], unit_of(kind))
    seen = f"an offset of all {kind} rows of {size} would explain the misfit"
    return Wording(
        seen,
        "check the clock and the zero of the instrument; until then, model the error",
        bias_lines(case, "offset", "kind", kind),
    )


def scales(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield the scales of the values of single stations."""
    yield from _of_form(case, suspects, "scale", "scales")


def drifts(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield drifts of single stations, for at least three times."""
    if len(np.unique(case.when[case.present])) > 2:
        yield from _of_form(case, suspects, "drift", "adds")


def steps(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield offsets of single stations that start within a run."""
    times = np.unique(case.when[case.present])
    if len(times) < _STEP_TIMES:
        return
    cuts = times[np.unique(np.linspace(1, len(times) - 1, min(len(times) - 1, _CUTS)).round().astype(int))]
    for station, kind, x, least in suspects.possible(_STEPPED):
        own = case.coefficients("station", "offset", kind, case.names[station])
        for cut in cuts.tolist():
            column = own * (case.when >= cut)
            words = partial(_step_words, case, kind, case.names[station], cut)
            yield Change(
                "step",
                words,
                (case.names[station],),
                columns=(ErrorColumn("adds", column),),
                starts=((0.0,),),
                x=x,
                alternatives=suspects.count * len(cuts),
                kind=kind,
                least=least,
            )


def _step_words(case: MisfitCase, kind: str, name: str, cut: float, theta: Array, sigma: Array) -> Wording:
    size = size_text(theta[0], sigma[0], unit_of(kind))
    when = f"from t = {case.origin + cut:.6g} s on"
    seen = f"an offset of station {name} of {size}, {when}, would explain the misfit"
    return Wording(seen, "split the run there, or give the later rows another station name")


def rotations(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield turns of the axes of single stations in space, for a run of shared unknowns or one epoch."""
    base = case.base
    if base.dimension != 3 or len(case.times) > 1:
        return
    angles = np.any(
        [case.rows_of(kind) for kind in case.kinds if MODELS[kind].axes] or [case.present[0] & False], axis=0
    )
    for station in case.stations:
        # three angles need at least four rows
        if int(case.present[:, case.rows_at(station) & angles].sum()) > _ANGLES:
            name = case.names[station]
            bias = family(base.rows, case.names, "rotation that is tested", form="rotation", members=(name,))
            words = partial(_rotation_words, case, name)
            other = replace(base, biases=(*base.biases, bias))
            yield Change("rotation", words, (name,), base=other, extra=_ANGLES, alternatives=len(case.stations))


def _rotation_words(case: MisfitCase, name: str, theta: Array, sigma: Array) -> Wording:
    lines = f'[[biases]]\nname = "rotation"\nform = "rotation"\nper = "station"\nmembers = [{quoted(name)}]\n'
    seen = f"a rotation of the axes of station {name} would explain the misfit"
    return Wording(seen, "check its orientation; until then, model the error", lines)


def _of_form(case: MisfitCase, suspects: Suspects, form: str, enters: str) -> Iterator[Change]:
    for station, kind, x, least in suspects.possible(_TRIED):
        if FORMS[form].enters == "scales" and MODELS[kind].period is not None:
            continue
        own = case.coefficients("station", form, kind, case.names[station])  # type: ignore[arg-type]
        if FORMS[form].enters == "scales" and (own != 0.0).all():
            continue  # a scale of all rows is another speed of the wave
        column = own * (case.when if FORMS[form].rate else np.ones_like(case.when))
        words = partial(station_words, case, form, kind, case.names[station])
        yield Change(
            form,
            words,
            (case.names[station],),
            columns=(ErrorColumn(enters, column),),  # type: ignore[arg-type]
            x=x,
            alternatives=suspects.count,
            least=least,
        )


def signs(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield the opposite sign of the values of single stations."""
    for station, kind, x, least in suspects.possible(_TRIED):
        rows = case.rows_at(station) & case.rows_of(kind)
        if MODELS[kind].ranges != (1, -1) and not MODELS[kind].emission and MODELS[kind].period is None:
            continue
        if rows.sum() == case.rows_of(kind).sum():
            continue  # the sign of all rows is another explanation
        words = partial(_sign_words, case, case.names[station], kind)
        yield Change(
            "sign-station",
            words,
            (case.names[station],),
            factor=np.where(rows, -1.0, 1.0),
            shift=_turned_back(case, rows),
            x=x,
            alternatives=suspects.count,
            least=least,
        )


def _turned_back(case: MisfitCase, rows: Array) -> Array:
    """Return the shift (m,) of values with the opposite sign: compass readings turn about north."""
    out = np.zeros(len(rows))
    for i, block in enumerate(case.base.rows):
        if isinstance(block, CompassRows):
            out[case.part(i)] = np.where(rows[case.part(i)], np.pi, 0.0)
    return out


def _sign_words(case: MisfitCase, name: str, kind: str, theta: Array, sigma: Array) -> Wording:
    seen = f"the {kind} values of station {name} fit with the opposite sign"
    return Wording(seen, "change the sign of these values, and check the cables of this station")


def periods(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield errors of single stations that are a whole number of periods of a code or a clock, or half a turn."""
    for change, value, sigma in suspects.estimates(_TRIED):
        kind = change.kind
        column = change.columns[0].coefficient
        if MODELS[kind].quantity == "length":
            written = case.base.written
            speed = written.speed if written is not None and written.speed else SPEED_OF_LIGHT
            table = {name: seconds * speed for name, seconds in _PERIODS.items()}
        elif kind == "azimuth":
            table = {"half a turn": np.pi}
        else:
            continue
        for name, length in table.items():
            count = round(value / length)
            if count and abs(count) <= _MULTIPLES and abs(value - count * length) < 6.0 * sigma + 1e-9 * abs(value):
                words = partial(_period_words, case, change.station[0], kind, count, name, count * length)
                choices = suspects.count * len(table) * (2 * _MULTIPLES if MODELS[kind].quantity == "length" else 1)
                shift = -count * length * column
                yield replace(
                    change, cause="period", words=words, shift=shift, columns=(), starts=(), alternatives=choices
                )


def _period_words(
    case: MisfitCase, name: str, kind: str, count: int, period: str, size: float, theta: Array, sigma: Array
) -> Wording:
    times = "" if abs(count) == 1 else f"{abs(count)} times "
    seen = f"the {kind} values of station {name} are {'larger' if count > 0 else 'smaller'} by {times}{period}"
    mean = f"{np.degrees(size):.6f} deg" if unit_of(kind) == "rad" else f"{size:.9g} m"
    small = "1e-9 deg" if unit_of(kind) == "rad" else "1e-6 m"
    lines = bias_lines(case, "offset", "station", kind, (name,), mean, small)
    return Wording(seen, "check the clock of this station; until then, correct the values", lines)


def exchanges(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield pairs of stations with exchanged names."""
    place = case.base.stations.position
    if place.ndim > 3 or place.shape[-3] > 1 or len(case.stations) < 3:
        return
    chosen = case.stations if len(case.stations) <= _PAIRS else [s for s, _ in suspects.first(_PAIRS)]
    pairs = list(combinations(sorted(set(chosen)), 2))
    choices = len(case.stations) * (len(case.stations) - 1) / 2
    for i, j in pairs:
        order = np.arange(case.base.stations.count)
        order[[i, j]] = j, i
        names = (case.names[i], case.names[j])
        yield Change(
            "swapped", partial(_exchange_words, case, (i, j)), names, position=place[:, order], alternatives=choices
        )


def _exchange_words(case: MisfitCase, pair: tuple[int, int], theta: Array, sigma: Array) -> Wording:
    place, names = case.base.stations.places, [case.names[i] for i in pair]
    lines = station_lines(case, {one: place[other] for one, other in zip(pair, pair[::-1], strict=True)})
    seen = f"the values fit if the stations {names[0]} and {names[1]} are exchanged"
    advice = f"exchange the positions of {names[0]} and {names[1]}, or their names in the measurements"
    return Wording(seen, advice, lines)


def references(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield other reference stations of differences that all have the same second station."""
    place = case.base.stations.position
    _, b = case.ends
    used = case.present.any(0)
    if not used.all() or len(set(b[used].tolist())) != 1 or b[used][0] < 0 or place.ndim > 3 or place.shape[-3] > 1:
        return
    stated = int(b[used][0])
    others = [i for i in case.stations if i != stated]
    for i in others:
        moved = place.copy()
        moved[:, stated] = place[:, i]
        names = (case.names[i],)
        words = partial(_reference_words, case.names[i], case.names[stated])
        yield Change("reference", words, names, position=moved, alternatives=len(others))


def _reference_words(name: str, stated: str, theta: Array, sigma: Array) -> Wording:
    seen = f"the differences fit with the reference station {name} instead of {stated}"
    return Wording(seen, f'state b = "{name}" in these rows, and remove the row of {name}')


def moves(case: MisfitCase, suspects: Suspects) -> Iterator[Change]:
    """Yield wrong positions of single stations, if a station has more rows than coordinates."""
    place = case.base.stations.position
    if place.ndim > 3 or place.shape[-3] > 1:
        return
    for station, kind in {s: (s, kind) for s, kind in reversed(suspects.first(_TRIED))}.values():
        if int(case.present[:, case.rows_at(station)].sum()) < case.base.dimension + 1:
            continue
        words = partial(_move_words, case, station)
        steps = case.extent * np.eye(case.base.dimension)
        aside = np.concatenate([np.zeros((1, case.base.dimension)), steps, -steps])
        start = tuple(tuple(each) for each in aside.tolist())
        yield Change(
            "moved",
            words,
            (case.names[station],),
            moved=station,
            starts=start,
            x=suspects.start(station, kind),
            alternatives=len(case.stations),
            least=suspects.least_of(station),
        )


def _move_words(case: MisfitCase, station: int, theta: Array, sigma: Array) -> Wording:
    place = case.base.stations.position.reshape(-1, case.base.dimension)[station] + theta
    text = ", ".join(f"{v:.6g}" for v in place)
    away = f"{np.linalg.norm(theta):.4g} m away from its stated position"
    seen = f"the values fit if station {case.names[station]} is {away}"
    advice = f"check its coordinates; the values give ({text}) m, in the axes of the problem"
    return Wording(seen, advice, station_lines(case, {station: place}, float(sigma.min())))
