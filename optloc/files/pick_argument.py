"""P and S picks of `optloc.locate`: their speeds, and their rows with one origin time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from optloc.base.errors import InvalidProblem
from optloc.base.types import Array
from optloc.base.units import in_si
from optloc.files.by_station import ARGUMENTS, RowLabels, StationValues, station_values
from optloc.files.call_rows import Receivers, per_word, scale_of, since_first
from optloc.files.crust import Crust, crust_of
from optloc.files.table_import import ColumnHints
from optloc.files.wave_argument import Wave
from optloc.models.layers import Layers
from optloc.models.phase_layers import S_TOA, PhaseLayers
from optloc.problem.build import Measured, measured
from optloc.problem.phases import phases

PICKS = ("p", "s")
"""Arguments of `locate` with picks."""
_SPEEDS = ("vp", "vs")
# Convention of azimuths, which times do not use.
_AXES: Final = "east-counterclockwise"


class PickRows(NamedTuple):
    """Rows of picks, their joint covariance (m, m), square metres, and the labels of the epochs or None.

    The covariance is None if the rows have separate standard deviations.
    """

    rows: tuple[Measured, ...]
    covariance: Array | None
    labels: RowLabels | None


def wave_of_picks(vp: Any, vs: Any, wave: Wave, given: Mapping[str, Any]) -> Wave:
    """Return the wave of P and S picks; the same wave without picks.

    Parameters
    ----------
    vp, vs : float, str, Layers or None
        Arguments of `locate`.
    wave : Wave
        Wave of the other arguments; picks need a wave that is not stated.
    given : mapping
        Measurements by the name of their argument.

    Raises
    ------
    InvalidProblem
        For picks without speeds, speeds without picks, and picks together with other measurements.
    """
    picks = [word for word in given if word in PICKS]
    stated = [name for name, speed in zip(_SPEEDS, (vp, vs), strict=True) if speed is not None]
    if not picks:
        if stated:
            raise InvalidProblem("there are no picks", stated[0], "give p= and s=, or use wave_speed=")
        return wave
    other = next((word for word in given if word not in PICKS), None)
    if other is not None:
        advice = f"leave out {other}=, or write a problem file"
        raise InvalidProblem("picks and other measurements have no common origin time", other, advice)
    if wave.stated or wave.wind is not None:
        raise InvalidProblem("picks have the speeds vp and vs", "wave_speed", "give vp= and vs= instead")
    if vp is None:
        raise InvalidProblem("the speed of the P waves is unknown", "vp", "state it, such as vp='6 km/s'")
    if isinstance(vp, PhaseLayers):
        if vs is not None:
            raise InvalidProblem("the layers have the speeds of S waves", "vs", "remove this argument")
        return Wave(vp.unit_speed, medium=vp, crust=Crust(None, vp.unit_speed, s_speeds=vp.s_speed))
    if isinstance(vp, Layers):
        ratio = crust_of(ColumnHints(vp="1 m/s", vs=_vs_of_ratio(vs)), with_s=True).vp_vs if "s" in picks else None
        return Wave(vp.unit_speed, medium=vp, crust=Crust(ratio, vp.unit_speed))
    hints = ColumnHints(vp=_text(vp, "vp"), vs=None if vs is None else _text(vs, "vs"))
    try:
        crust = crust_of(hints, with_s="s" in picks)
    except InvalidProblem as error:
        where = (error.where or "vp").removeprefix("--")
        advice = (error.advice or "").replace("--vp ", "vp=").replace("--vs ", "vs=")
        raise InvalidProblem(error.what, where, advice) from None
    if crust.speed is None:
        return Wave(crust.layers(0.0).unit_speed, crust=crust)
    return Wave(crust.speed, crust=crust)


def _vs_of_ratio(vs: Any) -> str:
    """Return the speed of S waves for P waves of 1 m/s, as text; `vs` is a ratio such as "vp/1.73"."""
    head, sign, number = str(vs).replace(" ", "").partition("/")
    try:
        ratio = float(number) if sign and head == "vp" else 0.0
    except ValueError:
        ratio = 0.0
    if not 1.0 < ratio < np.inf:
        raise InvalidProblem(f"{vs!r} is not a ratio of P to S in layers", "vs", "write vs='vp/1.73'")
    return f"{1.0 / ratio!r} m/s"


def _text(given: Any, name: str) -> str:
    """Return a speed as text with its unit; a number is in metres per second."""
    if isinstance(given, str):
        return given
    return f"{float(in_si(given, 'speed', name))!r} m/s"


def pick_rows(given: Mapping[str, Any], sigma: Any, unit: Any, places: Receivers, wave: Wave) -> PickRows:
    """Return the rows of P and S picks.

    Parameters
    ----------
    given : mapping
        Picks by the name of their argument.
    sigma, unit : object
        Arguments of `locate`.
    places : Receivers
        Stations.
    wave : Wave
        Wave of the picks, with the ratio of the speeds.

    Raises
    ------
    InvalidProblem
        If an S wave is not after the P wave of its station. If events of a batch have picks at other stations.
    """
    found = {word: station_values(word, values, places.names, None) for word, values in given.items()}
    units = {word: per_word(unit, word, given, "unit") or found[word].unit or ARGUMENTS[word].unit for word in given}
    if len({*units.values()}) > 1:
        raise InvalidProblem("P and S picks have different units", "unit", "convert them to seconds")
    alone = not isinstance(sigma, Mapping)
    scales = {
        word: scale_of(word, units[word], sigma, [word] if alone else list(given), wave.speed, _AXES) for word in given
    }
    values = _joined(found)
    step = next(scale for scale, _ in scales.values())
    z = since_first(values, min(deviation for _, deviation in scales.values()), step)
    z = np.asarray((scale_of("p", "s", 1.0, ["p"], wave.speed, _AXES)[0] if _dated(values) else step).to_si(z))
    present = np.isfinite(z)
    kept = present.reshape(-1, present.shape[-1]).any(0)
    if not (present[..., kept]).all():
        advice = "locate one event in each call, or use optloc.from_table"
        raise InvalidProblem("the events have picks at different stations", next(iter(given)), advice)
    count = [len(one.keys) for one in found.values()]
    station = np.array([key[0] for one in found.values() for key in one.keys])[kept]
    is_s = np.repeat([word == "s" for word in given], count)[kept]
    deviation = np.repeat([deviation for _, deviation in scales.values()], count)[kept]
    _check_order(z[..., kept], station, is_s, places.names)
    ratio = None if wave.crust is None else wave.crust.vp_vs
    if wave.crust is not None and wave.crust.s_speeds:
        kinds = [(kind, np.flatnonzero(chosen)) for kind, chosen in (("toa", ~is_s), (S_TOA, is_s))]
        parts = [(kind, pick) for kind, pick in kinds if len(pick)]
        made = tuple(
            measured(kind, z[..., kept][..., pick], a=station[pick], sigma=deviation[pick]) for kind, pick in parts
        )
        return PickRows(made, None, next(iter(found.values())).labels)
    # without S waves, the ratio has no effect
    rows, joint = phases(z[..., kept], a=station, is_s=is_s, ratio=ratio or 2.0, sigma=deviation)
    return PickRows(rows, joint, next(iter(found.values())).labels)


def _dated(values: Array) -> bool:
    """Return whether values are dates, which become seconds."""
    return values.dtype.kind == "M"


def _joined(found: Mapping[str, StationValues]) -> Array:
    """Return the values (..., n) of all picks; raise InvalidProblem for unequal forms of P and S."""
    parts = [one.values for one in found.values()]
    if len({_dated(part) for part in parts}) > 1:
        raise InvalidProblem("some picks are dates, and others are numbers", "s", "give only dates or only numbers")
    if len({part.shape[:-1] for part in parts}) > 1:
        raise InvalidProblem("there are more events with P than with S picks, or fewer", "s", "give equal numbers")
    return np.concatenate(parts, axis=-1)


def _check_order(z: Array, station: Array, is_s: Array, names: tuple[str, ...]) -> None:
    """Raise InvalidProblem if an S wave is not after the P wave of its station; z (..., n) are the picks."""
    for late in np.flatnonzero(is_s):
        for early in np.flatnonzero(~is_s & (station == station[late])):
            if (z[..., late] <= z[..., early]).any():
                what = f"the S wave is not after the P wave of station {names[station[late]]!r}"
                raise InvalidProblem(what, "s", "correct the picks, or exchange p and s")
