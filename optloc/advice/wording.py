"""Words, numbers and lines of problem files for advice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from optloc.advice.change import MisfitCase, Wording
from optloc.base.types import Array
from optloc.base.units import SI_UNIT
from optloc.models import MODELS
from optloc.problem.forms import FORMS


def quoted(text: str) -> str:
    """Return a name as a TOML string."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def size_text(value: float, sigma: float, unit: str) -> str:
    """Return an estimate with its standard deviation and unit; angles in degrees, scales in percent."""
    factor, name = {"rad": (np.degrees(1.0), "deg"), "rad/s": (np.degrees(1.0), "deg/s"), "": (100.0, "%")}.get(
        unit, (1.0, unit)
    )
    return f"{factor * value:+.4g} ± {factor * sigma:.2g} {name}"


def unit_of(kind: str) -> str:
    """Return the SI unit of a kind."""
    return SI_UNIT[MODELS[kind].quantity]  # type: ignore[index]  # the table has known quantities only


def bias_lines(
    case: MisfitCase, form: str, per: str, kind: str, members: Sequence[str] = (), mean: str = "", sigma: str = ""
) -> str:
    """Return the lines of a problem file that model an error as a bias; empty if the file cannot have this bias."""
    if case.base.constraints and len(case.times) > 1:
        return ""  # a constraint of a target that is free in each epoch excludes unknowns that epochs share
    used = {bias.name for bias in case.base.biases}
    name = next(text for text in (form, *(f"{form} {i}" for i in range(2, 99))) if text not in used)
    lines = [f'name = "{name}"', f'form = "{form}"', f'per = "{per}"', f'kind = "{kind}"']
    lines += [f"members = [{', '.join(map(quoted, members))}]"] if members else []
    lines += [f'mean = "{mean}"', f'sigma = "{sigma}"'] if mean else []
    return "\n".join(["[[biases]]", *lines]) + "\n"


def station_lines(case: MisfitCase, places: Mapping[int, Array], sigma: float = 0.0) -> str:
    """Return the rows of stations at other places (d,), in the frame, as the file writes rows; empty if it is unknown.

    `sigma` is the standard deviation of the coordinates, m: digits far below it are left out.
    """
    written = case.base.written
    if written is None or not written.place_keys or not written.place_unit:
        return ""
    rows = []
    for station, place in places.items():
        values = np.asarray(place) / written.place_unit
        digits = np.full(len(values), _digits(sigma / written.place_unit))
        if "lat_deg" in written.place_keys:
            lat, lon, height = (float(np.ravel(part)[0]) for part in case.base.frame.to_geodetic(place))
            values = np.array([np.degrees(lat), np.degrees(lon), height / written.place_unit])
            digits[:2] = _digits(sigma / _DEGREE)
        parts = [
            f"{key} = {round(float(v), int(n))!r}" for key, v, n in zip(written.place_keys, values, digits, strict=True)
        ]
        rows.append(f"  {{ name = {quoted(case.names[station])}, {', '.join(parts)} }},\n")
    return f"[stations]\nrows = [\n{''.join(rows)}]\n"


# Length of one degree of latitude, m, and the number of digits of exact coordinates.
_DEGREE, _EXACT = 111e3, 12


def _digits(sigma: float) -> int:
    """Return the number of decimals of a number with a standard deviation: a thousandth of it."""
    return _EXACT if sigma <= 0.0 else int(np.clip(3.0 - np.floor(np.log10(sigma)), 0, _EXACT))


def row_name(case: MisfitCase, epoch: int, row: int) -> str:
    """Return a name of a row, such as "tdoa of S3 and S1 (row 4)"."""
    a, b = case.ends
    kinds = np.concatenate([np.full(rows.count, rows.kind) for rows in case.base.rows])
    ends = [case.names[i] for i in (a[row], b[row]) if i >= 0]
    when = f" at t = {case.times[epoch]:.6g} s" if len(case.times) > 1 and np.isfinite(case.times[epoch]) else ""
    return f"the {kinds[row]} of {' and '.join(ends)}{when} (row {case.number[epoch, row] + 1})"


def station_words(case: MisfitCase, form: str, kind: str, name: str, theta: Array, sigma: Array) -> Wording:
    """Return the text about an offset, scale or drift of one station."""
    of_form = FORMS[form]
    unit = "" if of_form.enters == "scales" else f"{unit_of(kind)}/s" if of_form.rate else unit_of(kind)
    size = size_text(theta[0], sigma[0], unit)
    rows = f" in its {kind} rows" if len(case.kinds) > 1 else ""
    seen = f"{of_form.noun} of station {name}{rows} of {size} would explain the misfit"
    return Wording(
        seen, "check this channel; until then, model the error", bias_lines(case, form, "station", kind, (name,))
    )


def no_words(theta: Array, sigma: Array) -> Wording:
    """Return no text, for a change that is compared and never reported."""
    return Wording("", "")
