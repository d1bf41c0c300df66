"""An independent score of explanations: own formulas and own least squares, apart from the package.

The score of an explanation is -2 log likelihood at its best positions and parameters, relative to the file as it
stands, plus a price. The price is 9.2 for a cause (prior odds 100:1), 2 log of the number of its discrete choices, and
7.4 for a free parameter (a prior as wide as a hundred standard deviations, 2 log(100 / sqrt(2 pi))).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from advice.likelihood import Change, Fit, best_epochs, starts_of
from advice.planted import PERIODS, Draw
from advice.scene import LENGTHS, LIGHT, Array, Data, ecef
from scipy.special import log_ndtr

ODDS, PARAMETER = 9.2, 7.4
# Noise is understated more often than a station is wrong: prior odds 10:1.
NOISE = 4.6 + PARAMETER
LEAD = 16.0
"""Lead of the score of the planted cause over every other cause at which it is identifiable: the price of a row."""
# Largest relative error of the speed of a wave: above, the unit is wrong.
_SPEED = 0.35
# Rows and stations that are fitted after a linear test has ranked them.
_RANKED = 8
# Excess of the cost over twice the redundancy from which explanations other than the noise are tried.
_FITS = 4.0


@dataclass(frozen=True)
class Scored:
    """An explanation with its score, and its cost without the price."""

    cause: str
    stations: tuple[int, ...]
    score: float
    cost: float


@dataclass(frozen=True)
class Verdict:
    """The scores of all explanations of a draw, best first, and the lead of the planted one.

    - planted: the score of the planted cause; `lead`: of the best other explanation, less `planted`.
    - rival: that explanation.
    """

    scores: tuple[Scored, ...]
    planted: float
    lead: float
    rival: Scored | None = field(default=None)

    @property
    def identifiable(self) -> bool:
        """Return whether the planted cause leads by the price of a row."""
        return self.lead >= LEAD


# The explanations.


def _readings(data: Data) -> list[Change]:
    """Return the explanations without free parameters."""
    out = [Change("none", (), data, 0.0)]
    n, mine = data.stations, np.unique(data.a)
    first = data.of(data.kind[0])
    is_angle, is_length = "azimuth" in data.kind, data.kind[0] in LENGTHS
    if is_length:
        units = [data.size(u) for u in ("m", "km", "cm", "mm", "ft", "s", "ms", "us", "ns")]
        ratios = {round(u / data.size(data.unit), 12): u / data.size(data.unit) for u in units}
        for ratio in ratios.values():
            if abs(ratio - 1.0) > 1e-9:
                changed = data.with_unit(data.lengths, 1.0, ratio)
                more = 2.0 * data.z.size * np.log(ratio) if data.own_sigma else 0.0
                out.append(Change("unit", (), changed, ODDS + 2.0 * np.log(len(ratios)), offset=-more))
    if data.geodetic is None and np.sqrt((data.place**2).sum(1)).max() < 6e6 and not is_angle:
        for f in (1e3, 1e-3, 100.0, 1e-2, 0.3048, 1.0 / 0.3048):
            level = None if data.level is None else data.level
            changed = replace(data, place=data.place * f, level=level)
            out.append(Change("coordinate-unit", (), changed, ODDS + 2.0 * np.log(6.0)))
    if is_angle:
        bearing = data.of("azimuth")
        turned = {
            "compass": replace(
                data,
                azimuth="north-clockwise" if data.azimuth != "north-clockwise" else "east-counterclockwise",
            ),
            "anticlockwise": replace(data, z=np.where(bearing, -data.z, data.z)),
            "opposite": replace(data, z=np.where(bearing, data.z + np.pi, data.z)),
        }
        out += [Change(cause, (), changed, ODDS) for cause, changed in turned.items()]
        # numbers above a full turn are no radians
        written = replace(data, z=np.where(bearing, data.z % (2.0 * np.pi), data.z))
        if np.degrees(written.z[:, bearing]).max() < 2.1 * np.pi:
            out.append(Change("unit", (), written.with_unit(bearing, 1.0, 180.0 / np.pi), ODDS))
    if data.kind[0] in ("tdoa", "toa"):
        out.append(Change("sign", (), replace(data, z=-data.z), ODDS))
    if data.geodetic is not None and np.abs(data.geodetic[:, 1]).max() < 90.0:
        other = data.geodetic[:, [1, 0, 2]]
        out.append(Change("lat-lon", (), replace(data, geodetic=other, place=ecef(other)), ODDS))
    if data.kind[0] == "tdoa":
        for k in mine:
            b = np.full_like(data.b, k)
            out.append(Change("reference", (int(k),), replace(data, b=b), ODDS + 2.0 * np.log(n)))
    price = ODDS + 2.0 * np.log(len(mine))
    for s in mine:
        rows = (data.a == s) & first
        if data.kind[0] in ("tdoa", "azimuth", "range_rate"):
            out.append(Change("sign-station", (int(s),), replace(data, z=np.where(rows, -data.z, data.z)), price))
    price = ODDS + 2.0 * np.log(len(mine) * (len(mine) - 1) / 2.0)
    for i, j in combinations(mine, 2):
        order = np.arange(len(data.a))
        for kind in dict.fromkeys(data.kind):
            p, q = (np.flatnonzero((data.a == s) & data.of(kind))[0] for s in (i, j))
            order[[p, q]] = q, p
        out.append(Change("swapped", (int(i), int(j)), replace(data, z=data.z[:, order]), price))
    return out


def _of_stations(data: Data) -> list[Change]:
    """Return the explanations that have free parameters: of stations, and of all rows."""
    out, mine, n = [], np.unique(data.a), data.stations
    e, several = len(data.z), len(data.z) > 1
    price = ODDS + PARAMETER
    elapsed = (data.time - data.time[0])[:, None]
    for kind in dict.fromkeys(data.kind):
        for s in mine:
            rows = ((data.a == s) & data.of(kind)) * np.ones((e, 1))
            own = price + 2.0 * np.log(len(mine) * len(set(data.kind)))
            out.append(Change("offset", (int(s),), data, own, rows[None]))
            if several:
                out.append(Change("drift", (int(s),), data, own, (rows * elapsed)[None]))
                if kind in ("range", "tdoa", "groa", "range_sum"):
                    out.append(Change("scale", (int(s),), data, own, rows[None], form="scale", limit=0.5))
    if several or "azimuth" in data.kind:
        own = ODDS + PARAMETER * data.place.shape[1] + 2.0 * np.log(n)
        out += [Change("moved", (s,), data, own, form="move", who=s) for s in range(n)]
    ones = np.ones((1, e, len(data.a)))
    if data.kind[0] in LENGTHS:
        out.append(Change("speed", (), data, price, ones, form="scale", limit=_SPEED))
    if "azimuth" in data.kind:
        out.append(Change("declination", (), data, price, ones * data.of("azimuth"), limit=np.radians(40.0)))
    if data.kind[0] == "range" and data.place.shape[1] == 2:
        out.append(Change("height", (), data, price, form="slant"))
    if data.level is not None:
        out.append(Change("height", (), data, price, form="level"))
    return out


def _row_change(data: Data, rows: tuple[int, ...]) -> Change:
    """Return the explanation that some rows, numbers in the flat table (E, R), are wrong."""
    columns = np.zeros((len(rows), *data.z.shape))
    for k, row in enumerate(rows):
        columns[k].flat[row] = 1.0
    count = data.z.size if len(rows) == 1 else data.z.size * (data.z.size - 1) / 2.0
    price = ODDS * len(rows) + PARAMETER * len(rows) + 2.0 * np.log(count)
    who = tuple(sorted({int(data.a[row % len(data.a)]) for row in rows}))
    return Change("outlier" if len(rows) == 1 else "outliers", who, data, price, columns, rows=rows)


# Scores.


def _cost(change: Change, starts: list[Array], theta: Array | None = None, used: Array | None = None) -> tuple:
    """Return the least cost of a change over starts (E, d) with its positions and parameters."""
    fit = Fit(change, used)
    x = np.array(starts)
    if change.form == "level":
        t = x[:, :1, -1].copy()
        x[..., -1] = t
    else:
        t = np.zeros((len(x), fit.q)) if theta is None else np.array(theta)
    if change.form == "slant":
        t = np.full((len(x), 1), (0.3 * fit.span) ** 2)
    x, t, cost = fit.run(x, t)
    best = int(np.argmin(cost))
    return float(cost[best]), x[best], t[best]


def _interest(found: list[Scored]) -> float:
    """Return the score above which an explanation is of no interest."""
    return max(min(one.score for one in found), 0.0) + 100.0


def _cost_at(fit: Fit, x: Array) -> float:
    """Return the cost at positions (E, d) without parameters."""
    return float((fit.whitened(x[None], np.zeros((1, 0))) ** 2).sum())


def _without(data: Data, row: Array, truth: Array) -> list[Array]:
    """Return starts (E, d): the fit without some rows (E, R), where these rows do not determine the position."""
    fit = Fit(Change("none", (), data, 0.0), ~row)
    return list(best_epochs(fit, starts_of(fit, truth))[:1])


def scores(draw: Draw) -> list[Scored]:
    """Return the scores of all explanations of a draw, best first."""
    data, truth = draw.data, draw.truth
    plain = Change("none", (), data, 0.0)
    fit = Fit(plain)
    base = best_epochs(fit, starts_of(fit, truth))
    cost, x0, _ = _cost(plain, [base[0], base[1], _level(data, truth)])
    out = [Scored("none", (), cost, cost)]
    e, r = data.z.shape
    dof = data.z.size - e * (fit.free + fit.emission)
    out.append(_noise(data, cost, dof))
    if cost < dof + _FITS:
        return sorted(out, key=lambda one: one.score)
    for change in _readings(data)[1:]:
        interest = _interest(out) - change.price - change.offset
        other = Fit(change, interest=interest)
        points = best_epochs(other, starts_of(other, truth))
        found = _cost_at(other, points[0])
        found += change.offset
        out.append(Scored(change.cause, change.stations, found + change.price, found))
    left: dict[tuple[int, ...], list[Array]] = {}
    for change in _of_stations(data):
        key = change.stations
        if key and key not in left:
            left[key] = _without(data, (data.a == key[0]) | (data.b == key[0]) & np.zeros((e, r), bool), truth)
        starts = [x0, _level(data, truth), *left.get(key, [])]
        found, _, t = _cost(change, starts)
        out.append(Scored(change.cause, change.stations, found + change.price, found))
        if change.cause == "offset" and data.kind[0] == "toa":
            out += _periods(change, float(t[0]), [x0, _level(data, truth), *left.get(key, [])])
    out += _rows_scored(data, truth, x0)
    if e > 1:
        out += _station_noise(data, [x0, _level(data, truth)], cost)
    if data.kind[0] in ("toa", "range", "range_sum") and data.z.size >= 10:
        out.append(_late(data, [x0, _level(data, truth)]))
    return sorted(out, key=lambda one: one.score)


def _level(data: Data, truth: Array) -> Array:
    """Return positions (E, d) with the height that the file states."""
    if data.level is None:
        return truth
    return np.column_stack([truth[:, :2], np.full(len(truth), data.level)])


def _noise(data: Data, cost: float, dof: int) -> Scored:
    """Return the score of understated noise: one factor of all sigmas.

    The rows that fix the position are no evidence against a larger noise, until it is as large as the array.
    """
    if dof < 1:
        return Scored("noise", (), np.inf, np.inf)
    span = float(np.sqrt(((data.place - data.place.mean(0)) ** 2).sum(1)).max())
    widest = max(1.0, {"azimuth": np.pi, "groa": 10.0, "range_rate": 500.0}.get(data.kind[0], span) / data.sigma[0])
    square = max(cost / dof, 1.0)
    fixed = (data.z.size - dof) * np.log(min(square, widest**2))
    found = cost / square + data.z.size * np.log(square) - fixed
    return Scored("noise", (), found + NOISE, found)


def _periods(change: Change, value: float, starts: list[Array]) -> list[Scored]:
    """Return the scores of whole periods near an offset of a station."""
    data, out = change.data, []
    for seconds in PERIODS if data.speed == LIGHT else PERIODS[:1]:
        whole = seconds * data.speed
        count = np.round(value / whole)
        if count == 0.0 or abs(count) > 20.0:
            continue
        moved = replace(data, z=data.z - change.columns[0] * count * whole)
        found, _, _ = _cost(Change("period", change.stations, moved, 0.0), starts)
        price = ODDS + 2.0 * np.log(len(np.unique(data.a)) * 2 * len(PERIODS) * 3)
        out.append(Scored("period", change.stations, found + price, found))
    return out


def _rows_scored(data: Data, truth: Array, x0: Array) -> list[Scored]:
    """Return the scores of one wrong row and of two, the most suspicious rows first."""
    e, r = data.z.shape
    single = {}
    for row in _suspicious(data, x0, truth):
        alone = np.zeros(e * r, bool)
        alone[row] = True
        # only the epoch of the row changes
        epoch = row // r
        part = replace(data, z=data.z[[epoch]], time=data.time[[epoch]])
        fit = Fit(Change("none", (), part, 0.0))
        before, _, _ = _cost(fit.change, [x0[[epoch]]])
        change = _row_change(part, (row % r,))
        starts = [x0[[epoch]], _level(part, truth[[epoch]])]
        starts += _without(part, alone.reshape(e, r)[[epoch]], truth[[epoch]])
        found, _, _ = _cost(change, starts)
        single[row] = found - before
    total = _cost(Change("none", (), data, 0.0), [x0])[0]
    out = []
    for row, gain in single.items():
        change = _row_change(data, (row,))
        out.append(Scored("outlier", change.stations, total + gain + change.price, total + gain))
    ranked = sorted(single, key=single.get)
    first = list({row // r: row for row in reversed(ranked)}.values())
    pairs = {*combinations(sorted(ranked[:5]), 2), *combinations(sorted(first), 2)}
    for one, two in sorted(pairs):
        change = _row_change(data, (one, two))
        if one // r != two // r:
            found = total + single[one] + single[two]
        else:
            epoch = one // r
            part = replace(data, z=data.z[[epoch]], time=data.time[[epoch]])
            before, _, _ = _cost(Change("none", (), part, 0.0), [x0[[epoch]]])
            both = np.zeros((1, r), bool)
            both[0, [one % r, two % r]] = True
            pair = _row_change(part, (one % r, two % r))
            starts = [x0[[epoch]], _level(part, truth[[epoch]]), *_without(part, both, truth[[epoch]])]
            found = total + _cost(pair, starts)[0] - before
        out.append(Scored("outliers", change.stations, found + change.price, found))
    return out


def _suspicious(data: Data, x0: Array, truth: Array) -> list[int]:
    """Return the rows, numbers in the flat table, whose removal lowers the cost most, by linear tests at two points."""
    fit, out = Fit(Change("none", (), data, 0.0)), []
    for x in (x0, _level(data, truth)):
        r = fit.whitened(x[None], np.zeros((1, 0)))
        jx, _ = fit.derivatives(x[None], np.zeros((1, 0)), r)
        gain, white = np.empty(data.z.shape), fit.projected(np.repeat(fit.white.T[:, None], len(data.z), 1))
        for epoch in range(len(gain)):
            columns = white[:, epoch]
            q, _ = np.linalg.qr(jx[0, epoch])
            columns = columns - (columns @ q) @ q.T
            gain[epoch] = (columns @ r[0, epoch]) ** 2 / np.maximum((columns**2).sum(1), 1e-12)
        # a gross error hides others in its epoch only
        best = np.argsort(-gain, axis=1, kind="stable")[:, :3] + gain.shape[1] * np.arange(len(gain))[:, None]
        ranked = sorted(best.ravel().tolist(), key=lambda row: -gain.flat[row])
        out += [*ranked[:_RANKED], *(row for row in best[:, 0].tolist() if gain.flat[row] > 9.0)]
    return list(dict.fromkeys(out))


def _station_noise(data: Data, starts: list[Array], cost: float) -> list[Scored]:
    """Return the scores of the noise of single stations; differences share the noise of their reference."""
    if "tdoa" in data.kind:
        return []
    out, mine = [], np.unique(data.a)
    fit = Fit(Change("none", (), data, 0.0))
    r = np.abs(np.array([fit.whitened(x[None], np.zeros((1, 0)))[0] for x in starts])).mean(1).max(0)
    for s in sorted(mine, key=lambda s: -r[(data.a == s) & data.of(data.kind[0])].max())[:3]:
        rows = (data.a == s) & data.of(data.kind[0])
        factor, best = max(1.3, float(r[rows].max())), np.inf
        for _ in range(4):
            sigma = np.where(rows, data.sigma * factor, data.sigma)
            change = Change("noise", (int(s),), replace(data, sigma=sigma), 0.0)
            found, x, _ = _cost(change, starts)
            best = min(best, found + 2.0 * len(data.z) * np.log(factor))
            own = Fit(change).whitened(x[None], np.zeros((1, 0)))[0][:, rows]
            # redundancy of a noisy station: each of its rows checks one estimated position only weakly
            factor = max(1.01, factor * float(np.sqrt((own**2).mean())))
        out.append(Scored("noise", (int(s),), best + NOISE + 2.0 * np.log(len(mine)), best))
    return out


def _late(data: Data, starts: list[Array]) -> Scored:
    """Return the score of detours: a share of the rows has an exponential excess (expectation maximisation)."""
    best = np.inf
    fit = Fit(Change("none", (), data, 0.0))
    for x in starts:
        y, share = x[None].copy(), 0.3
        u = fit.residual(y, np.zeros((1, 0)))[0] / data.sigma
        tau = np.quantile(u, 0.3, axis=-1, keepdims=True) if fit.emission else np.zeros((len(u), 1))
        mean = max(float(np.abs(u - tau).mean()), 3.0)
        for _ in range(40):
            u = fit.residual(y, np.zeros((1, 0)))[0] / data.sigma - tau
            clean = np.log1p(-share) - 0.5 * u**2 - 0.5 * np.log(2 * np.pi)
            other = np.log(share) - np.log(mean) + 0.5 / mean**2 - u / mean + log_ndtr(u - 1.0 / mean)
            total = np.logaddexp(clean, other)
            p, m = np.exp(other - total), u - 1.0 / mean
            excess = m + np.exp(-0.5 * m**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(m))
            share = float(np.clip(p.mean(), 1e-3, 0.6))
            mean = float(np.clip((p * excess).sum() / max(p.sum(), 1e-9), 0.5, 1e6))
            moved = replace(data, z=data.z - p * excess * data.sigma)
            inner = Fit(Change("none", (), moved, 0.0))
            y, _, _ = inner.run(y, np.zeros((1, 0)), steps=2)
            if fit.emission:
                v = inner.residual(y, np.zeros((1, 0)))[0] / data.sigma
                tau = v.mean(-1, keepdims=True)
        found = float(-2.0 * total.sum() - data.z.size * np.log(2 * np.pi))
        best = min(best, found)
    return Scored("late", (), best + ODDS + 2.0 * PARAMETER, best)


# The verdict on a draw.

STATION = frozenset({"offset", "sign-station", "scale", "drift", "period", "outlier", "outliers", "moved", "swapped"})
"""Causes that name a station."""


def same(draw: Draw, one: Scored, planted: Scored) -> bool:
    """Return whether an explanation is only another name of the planted one: no data separate the two."""
    if one.cause == draw.cause:
        return one.stations == draw.stations or not draw.stations
    if {one.cause, draw.cause} == {"unit", "coordinate-unit"}:
        return abs(one.cost - planted.cost) < 1.0
    single = len(draw.data.z) == 1 and one.stations == draw.stations
    return single and {one.cause, draw.cause} <= {"offset", "outlier", "drift", "moved"}


def _more(draw: Draw, one: Scored) -> bool:
    """Return whether an explanation has the planted one as a special case: more parameters for the same station."""
    if one.stations == draw.stations and draw.cause in ("offset", "period"):
        return one.cause in ("offset", "outlier", "moved", "drift")
    return one.cause == "outliers" and len(draw.stations) == 1 and draw.stations[0] in one.stations


def verdict(draw: Draw, found: Sequence[Scored] | None = None) -> Verdict:
    """Return the scores of a draw and the lead of its planted cause; `found` are the scores, if they are known."""
    found = scores(draw) if found is None else found
    if draw.cause is None:
        best = found[0]
        lead = min((one.score for one in found if one.cause != "none"), default=np.inf) - next(
            one.score for one in found if one.cause == "none"
        )
        return Verdict(tuple(found), next(one.score for one in found if one.cause == "none"), lead, best)
    own = [one for one in found if one.cause == draw.cause and one.stations == draw.stations]
    if not own:
        return Verdict(tuple(found), np.inf, -np.inf, found[0])
    rivals = [one for one in found if not same(draw, one, own[0]) and not _more(draw, one)]
    rival = rivals[0]
    return Verdict(tuple(found), own[0].score, rival.score - own[0].score, rival)
