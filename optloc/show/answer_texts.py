"""Numbers and states of fixes as text: coordinates, standard deviations, 95 % figures and intervals."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from optloc.base.types import Array, Status
from optloc.problem.chart import AXES, CARTESIAN, INVERSE_RANGE, NAMES
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Active
from optloc.show.columns import Columns, level_covariance
from optloc.show.fix_answer import Row
from optloc.show.origin_time import origin_text

# If an equality fixes a coordinate, its computed sigma is rounding error: below this share of the coordinate.
_HELD = 1e-12
_EARTH = 6.4e6
# Decimals of a degree that show a metre: 1e-5 degrees of latitude are 1.1 m.
_METRE = 5
# Without a standard deviation, lengths in metres show decimetres.
_DECIMETRE = 1
# A length below this share of the largest length is rounding error, for instance the sigma of a fixed height.
_NOTHING = 1e-6
# p-value below which the text warns of large residuals: by chance this happens in one of 1000 correct fixes.
_UNLIKELY = 1e-3
_RATES = (("v", "velocity", "m/s"), ("a", "acceleration", "m/s²"))

# The radius is the size of one minimum. If another position is not excluded, it says nothing about the choice.
# "started" is the label of the first scan of a track, whose state is a fix with status `ok`.
_CONFIRMED = {Status.OK.label, Status.CURVED.label, "started"}
_CONDITION = ", if this position is correct"
_REFUTED = "not valid: the residuals are larger than the stated noise allows"

CURVED_ROW = ("95 % region", "curved: the ± values are not valid; use optloc.uncertainty.likelihood_region")
"""Row of a fix whose error is Gaussian in no known coordinates."""

NOT_DETERMINED = "not determined"
"""Text of an entry that the data do not determine; see `optloc.Fix.undetermined`."""


def with_sigma(value: float, sigma: float, unit: str) -> str:
    """Return a number with its standard deviation, both rounded to two digits of the standard deviation.

    If a constraint fixes the number, "(held)" replaces the standard deviation. `value` and `sigma` are in the unit
    `unit`. An infinite or NaN `sigma` is omitted.
    """
    unit = unit if unit != "1" else ""
    if sigma <= _HELD * (1.0 + abs(value)):
        return f"{f'{value:.10g} {unit}'.rstrip()} (held)"
    if not np.isfinite(sigma):
        return f"{value:.6g} {unit}"
    # Print two digits of the standard deviation, and no decimals if it is 10 or more.
    digits = decimals(sigma)
    return f"{rounded(value, digits)} ± {sigma:.{digits}f} {unit}"


def decimals(sigma: float) -> int:
    """Return the number of decimals that shows two digits of a standard deviation; 0 if it is 10 or more."""
    return int(max(0, 1 - np.floor(np.log10(sigma))))


def latlon_texts(lat: float, lon: float, sigmas: Sequence[float] = ()) -> list[str]:
    """Return latitude and longitude, degrees, as numbers with equally many decimals.

    They have two digits of the smallest standard deviation in `sigmas`, m, and at least a metre. Standard deviations
    that are not finite, or only rounding error, do not count.
    """
    known = [sigma for sigma in sigmas if _HELD * _EARTH < sigma < np.inf]
    digits = _METRE + (decimals(min(known)) if known else _DECIMETRE)
    return [f"{lat:.{digits}f}", f"{lon:.{digits}f}"]


def height_text(height: float, sigma: float = np.nan) -> str:
    """Return a height, m, as a number with two digits of its standard deviation, m; "(held)" marks a given height."""
    if sigma <= _HELD * _EARTH:
        # The conversion of frames leaves rounding error, which is no digit of the given height.
        return f"{float(rounded(height, 4)):.10g} m (held)"
    return f"{length_text(height, sigma)} m"


def length_text(value: float, sigma: float = np.nan) -> str:
    """Return a coordinate, m, as a number with two digits of its standard deviation, m; all digits if it is held."""
    if sigma <= _HELD * (1.0 + abs(value)):
        return f"{value:.10g}"
    return rounded(value, decimals(sigma) if np.isfinite(sigma) else _DECIMETRE)


def level_sigmas(columns: Columns, i: int) -> list[float]:
    """Return the standard deviations, m, of row `i` along east, north and up; NaN if unknown, 0 for rounding error."""
    variances = [float(columns[f"cov_{2 * axis}"][i]) if f"cov_{2 * axis}" in columns else np.nan for axis in "enu"]
    return [float(v) for v in np.sqrt(np.maximum(variances, 0.0))]


def rounded(value: float, digits: int) -> str:
    """Return a number with a number of decimals, and without a minus sign before zero."""
    text = f"{value:.{digits}f}"
    return text if text.strip("-0.") else text.lstrip("-")


def as_p(value: float) -> str:
    """Return the text of a p-value with two digits; "-" for NaN."""
    return "-" if np.isnan(value) else f"{value:.2g}"


# The state in a row of the table of a fix.


def place_rows(columns: Columns, i: int) -> list[Row]:
    """Return labels and texts of the position in row `i`: on Earth latitude, longitude and height; else x, y, z.

    A row without a position has no lines. `columns` is the table of the fix.
    """
    if "lat_deg" not in columns or not np.isfinite(columns["x"][i]):
        return frame_rows(columns, i)
    undetermined, (east, north, up) = undetermined_names(columns, i), level_sigmas(columns, i)
    lat, lon = latlon_texts(columns["lat_deg"][i], columns["lon_deg"][i], (east, north))
    return [
        ("latitude", NOT_DETERMINED if "north" in undetermined else f"{lat} deg"),
        ("longitude", NOT_DETERMINED if "east" in undetermined else f"{lon} deg"),
        ("height", NOT_DETERMINED if "up" in undetermined else height_text(columns["height"][i], up)),
    ]


def frame_rows(columns: Columns, i: int) -> list[Row]:
    """Return labels and texts of the coordinates in the frame in row `i`, with standard deviations."""
    if not np.isfinite(columns["x"][i]):
        return []
    axes, undetermined = [axis for axis in "xyz" if axis in columns], undetermined_names(columns, i)
    numbers = [with_sigma(columns[axis][i], sigma_of(columns, axis, i), "m") for axis in axes]
    return [(a, NOT_DETERMINED if a in undetermined else text) for a, text in zip(axes, numbers, strict=True)]


def sigma_of(columns: Columns, name: str, i: int) -> float:
    """Return the standard deviation of a column in row `i`; NaN if the table has none."""
    return float(columns[f"sigma_{name}"][i]) if f"sigma_{name}" in columns else np.nan


def motion_rows(columns: Columns, i: int) -> list[Row]:
    """Return labels and texts of velocity and acceleration in row `i`; empty for a target at rest."""
    undetermined, rows = undetermined_names(columns, i), []
    for letter, word, unit in _RATES:
        for axis in (axis for axis in "xyz" if f"{letter}{axis}" in columns):
            value, sigma = columns[f"{letter}{axis}"][i], sigma_of(columns, f"{letter}{axis}", i)
            if np.isfinite(value):
                text = NOT_DETERMINED if f"{letter}{axis}" in undetermined else with_sigma(value, sigma, unit)
                rows.append((f"velocity {axis}" if word == "velocity" else f"{word} {axis}", text))
    return rows


def sure_rows(columns: Columns, i: int) -> list[Row]:
    """Return labels and texts of the accuracy in row `i`: standard deviations, and the 95 % radius if it is valid."""
    level, words = "cov_ee" in columns, ("east", "north", "up") if "cov_ee" in columns else ("x", "y", "z")
    pairs = ("ee", "nn", "uu") if level else ("xx", "yy", "zz")
    undetermined = undetermined_names(columns, i)
    found = [
        (word, columns[f"cov_{pair}"][i]) for word, pair in zip(words, pairs, strict=True) if f"cov_{pair}" in columns
    ]
    shown = [(word, value) for word, value in found if word not in undetermined and np.isfinite(value)]
    if not shown or not np.isfinite(columns["x"][i]):
        return []
    sizes = lengths(np.sqrt(np.maximum([value for _, value in shown], 0.0)))
    rows = [(f"sigma {', '.join(word for word, _ in shown)}", f"{', '.join(sizes)} m")]
    return rows + (_radius_rows(columns, i) if is_gaussian(columns, i) else [])


def is_gaussian(columns: Columns, i: int) -> bool:
    """Return whether the ellipse of row `i` is valid: it is finite, and the error is Gaussian in metres."""
    chart = columns["chart"][i] if "chart" in columns else ""
    return bool(np.isfinite(level_covariance(columns, i)).all()) and chart in {"", NAMES[CARTESIAN]}


def _radius_rows(columns: Columns, i: int) -> list[Row]:
    """Return the radius that contains the target with a probability of 95 %; on Earth with its vertical part."""
    from optloc.uncertainty.radii import accuracy

    if columns["status"][i] == Status.MISFIT.label:
        return [("95 % radius", _REFUTED)]
    condition = "" if columns["status"][i] in _CONFIRMED else _CONDITION
    covariance = level_covariance(columns, i)
    radii = accuracy(covariance)
    if len(covariance) == 2:
        return [("95 % radius", f"{radii.cep95:.3g} m{condition}")]
    vertical = _vertical(radii.cep95, radii.vertical95)
    # A held height has no error, so that all of the radius is horizontal.
    level = "cov_ee" in columns and vertical != "0"
    parts = f" (horizontal {radii.cep95:.3g} m, vertical ± {vertical} m)" if level else ""
    return [("95 % radius", f"{radii.sep95:.3g} m{parts}{condition}")]


def _vertical(across: Array, along: Array) -> str:
    """Return the text of a vertical half-width, 0 if it is rounding error compared with the horizontal radius."""
    return lengths([float(across), float(along)])[1]


def region_rows(columns: Columns, i: int) -> list[Row]:
    """Return labels and texts of the ellipse in row `i`, and of the radii that data sheets state, for the details."""
    from optloc.uncertainty.radii import accuracy

    if not np.isfinite(columns["x"][i]) or not is_gaussian(columns, i):
        return []
    semi = [columns[name][i] for name in ("ellipse95_1", "ellipse95_2", "ellipse95_3") if name in columns]
    name = "95 % ellipse" if len(semi) == 2 else "95 % ellipsoid"
    rows = [(name, " x ".join(lengths(semi)) + " m (semi-axes)")]
    radii = accuracy(level_covariance(columns, i))
    rows.append(("CEP50, CEP95", f"{radii.cep50:.3g}, {radii.cep95:.3g} m (circles)"))
    if len(semi) == 3:
        rows.append(("SEP50, SEP95", f"{radii.sep50:.3g}, {radii.sep95:.3g} m (spheres)"))
        rows.append(("vertical 95 %", f"± {_vertical(radii.cep95, radii.vertical95)} m"))
    return rows


def undetermined_names(columns: Columns, i: int) -> set[str]:
    """Return the names of the undetermined entries of row `i`: coordinates, rates, and axes east, north, up."""
    names = columns["undetermined"][i] if "undetermined" in columns else ""
    return set(names.split("; ")) if isinstance(names, str) else set()


def lengths(values: Iterable[float]) -> list[str]:
    """Return lengths as text; a length that is only rounding error compared with the largest length is 0."""
    known = list(values)
    return [f"{v if v > _NOTHING * max(known) else 0.0:.3g}" for v in known]


# Texts of a single fix.


def extent_rows(fix: Fix) -> list[Row]:
    """Return labels and texts of valid 95 % intervals for fixes whose ellipsoid in metres is not valid."""
    if fix.chart is None or not fix.answered:
        return []
    if fix.chart.kind == CARTESIAN:
        return _coordinate_rows(fix) if fix.chart.cut_off else []
    if fix.chart.kind != INVERSE_RANGE:
        return [CURVED_ROW]
    low, high = (float(end) for end in fix.interval("range"))
    far = f"to {high:.4g} m" if np.isfinite(high) else "or more, to infinity"
    lines = [("95 % range", f"{low:.4g} m {far}, from the middle of the stations")]
    if not fix.frame.geodetic:
        low, high = (float(np.degrees(end)) for end in fix.interval("bearing"))
        lines.append(("95 % bearing", f"{low:.4g} to {high:.4g} deg from the first axis towards the second"))
    return lines


def _coordinate_rows(fix: Fix) -> list[Row]:
    """Return labels and texts of 95 % intervals of the coordinates if bounds cut off the distribution of the position.

    The position is then not in the middle of the intervals.
    """
    lines = []
    for axis in AXES[: fix.position.shape[-1]]:
        low, high = (float(end) for end in fix.interval(axis))
        lines.append((f"95 % {axis}", f"{low:.6g} to {high:.6g} m, within the bounds"))
    return lines


def chi_square_text(fix: Fix) -> str:
    """Return the cost, the degrees of freedom and the p-value as text, with a warning if the p-value is small.

    Without redundancy or without a finite cost, the text states why there is no test.
    """
    # a fix that failed before its rows were counted has zero degrees of freedom
    if not np.isfinite(fix.cost) and int(fix.dof) >= 0:
        return "not computed: there is no refined answer"
    if int(fix.dof) <= 0:
        return "no redundancy: nothing to test"
    p = float(fix.p_value)
    warning = "; the residuals are larger than the stated noise allows" if p < _UNLIKELY else ""
    return f"{float(fix.cost):.4g} with {int(fix.dof)} degrees of freedom, p = {p:.3g}{warning}"


def constraint_text(active: Active) -> str:
    """Return the text of an active constraint."""
    if active.name.endswith(" equal"):
        return f"{active.name.removesuffix(' equal')} held as given"
    gain = f"relaxing it lowers the cost by {abs(active.multiplier):.4g} per SI unit"
    return f"{active.name} bound reached; {gain}"


def origin_rows(columns: Columns, i: int) -> list[Row]:
    """Return the emission time in row `i` of the table of a fix, with its standard deviation; empty without one."""
    text = origin_text(columns, i)
    return [("emission time", text)] if text else []


def epoch_error_rows(fix: Fix, known: Collection[str] = ()) -> list[Row]:
    """Return the root mean square of each error that single epochs have, such as clock errors: too many to list.

    `known` are names of errors that other rows have.
    """
    rows = []
    for name, values in fix.bias.items():
        if name in known:
            continue
        slot, shared = fix.layout.find(name)
        if not shared and np.isfinite(values).any():
            spread = np.sqrt(np.nanmean(values**2))
            rows.append((name, f"{values.size} values, root mean square {spread:.4g} {slot.unit}".strip()))
    return rows


def finite(values: Array) -> Array:
    """Return the finite values (n,) of an array."""
    return values[np.isfinite(values)]
