"""Words, numbers and lines of problem files for advice."""

from __future__ import annotations

from collections.abc import Sequence

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
    """Return the lines of a problem file that model an error as a bias."""
    used = {bias.name for bias in case.base.biases}
    name = next(text for text in (form, *(f"{form} {i}" for i in range(2, 99))) if text not in used)
    lines = [f'name = "{name}"', f'form = "{form}"', f'per = "{per}"', f'kind = "{kind}"']
    lines += [f"members = [{', '.join(map(quoted, members))}]"] if members else []
    lines += [f'mean = "{mean}"', f'sigma = "{sigma}"'] if mean else []
    return "\n".join(["[[biases]]", *lines]) + "\n"


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
