"""Fixes and tracks as marks on the Earth: longitude, latitude, ellipse, a line of text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optloc.ellipse import error_ellipse
from optloc.evaluate import differentiate
from optloc.fix import Fix
from optloc.models import MODELS
from optloc.plot.style import figure_class
from optloc.problem import Problem
from optloc.scene import states_of
from optloc.status import Status
from optloc.types import Array

_RING = 73
_SKY = 100e3
_LINES, _GRID = 24, 281


@dataclass(frozen=True, slots=True)
class Spots:
    """Marks on the Earth.

    Parameters
    ----------
    place : array (n, 2)
        Longitude and latitude, degrees; NaN where there is none.
    rings : tuple of array (r, 2)
        The 95 % ellipse of each, degrees; empty where there is no covariance.
    clean : bool array (n,)
        Where the status is ok.
    text : tuple of n str
        What is told of each.
    """

    place: Array
    rings: tuple[Array, ...]
    clean: Array
    text: tuple[str, ...]


def spots(problem: Problem, position: Array, covariance: Array, clean: Array, text: Sequence[str]) -> Spots:
    """Return positions (n, d) in a problem's frame, with covariances (n, d, d), as marks on the Earth."""
    angle = np.linspace(0.0, 2.0 * np.pi, _RING)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = []
    for centre, spread in zip(position, covariance, strict=True):
        if not (np.isfinite(centre).all() and np.isfinite(spread).all()):
            rings.append(np.zeros((0, 2)))
            continue
        axes = problem.frame.enu_axes(centre)[:2]
        semi_axes, directions = error_ellipse(axes @ spread @ axes.T)
        rings.append(degrees(problem, centre + circle * semi_axes @ directions.T @ axes))
    return Spots(degrees(problem, position), tuple(rings), clean, tuple(text))


def degrees(problem: Problem, position: Array) -> Array:
    """Return longitude and latitude (n, 2) of positions (n, d), NaN where these are."""
    out = np.full((len(position), 2), np.nan)
    known = np.isfinite(position).all(-1)
    if known.any():
        lat, lon, _ = problem.frame.to_geodetic(position[known])
        out[known] = np.degrees(np.stack([lon, lat], axis=-1))
    return out


def fixed_spots(problem: Problem, fixes: Sequence[Fix], labels: Sequence[str]) -> Spots:
    """Return the marks of fixes; labels name them where there are as many."""
    parts = [part for fix in fixes for part in states_of(fix)]
    position, covariance, clean = (np.concatenate(each) for each in zip(*parts, strict=True))
    status = [Status(int(code)).label for fix in fixes for code in np.ravel(fix.code)]
    named = list(labels) if len(labels) == len(position) > 1 else [""] * len(position)
    told = status if len(status) == len(position) else ["" if ok else "status not ok" for ok in clean]
    sigma = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    sentences = [sentence(*each) for each in zip(named, told, degrees(problem, position), sigma, strict=True)]
    return spots(problem, position, covariance, clean, sentences)


def sentence(name: str, status: str, place: Array, sigma: float) -> str:
    """Return what is told of a fix."""
    parts = [name, status, f"{place[1]:.5f}°, {place[0]:.5f}°" if np.isfinite(place).all() else "no position"]
    return ", ".join(part for part in [*parts, f"sigma {sigma:.3g} m" if np.isfinite(sigma) else ""] if part)


def other_spots(problem: Problem, fixes: Sequence[Fix]) -> Spots:
    """Return the marks of the alternatives of single fixes."""
    places, text = [np.zeros((0, problem.dimension))], []
    for fix in fixes:
        flat = fix if len(fix.shape) == 1 else fix.flat()
        shown = np.isfinite(flat.alternatives.gap)
        for slot in flat.layout.shared:
            if slot.name.partition("[")[0] == "position":
                places.append(flat.layout.take(flat.alternatives.x, slot.name)[shown])
                text += [f"alternative, costs {gap:.3g} more" for gap in flat.alternatives.gap[shown]]
    position = np.concatenate(places)
    count, d = position.shape
    return spots(problem, position, np.full((count, d, d), np.nan), np.zeros(count, dtype=bool), text)


def station_spots(problem: Problem) -> Spots:
    """Return the marks of the stations of the first epoch; those in the sky have no place on a map."""
    position = problem.stations.position.reshape(-1, problem.stations.count, problem.dimension)[0]
    place = degrees(problem, position)
    place[problem.frame.to_geodetic(position)[2] > _SKY] = np.nan
    nothing = tuple(np.zeros((0, 2)) for _ in position)
    return Spots(place, nothing, np.ones(len(position), dtype=bool), problem.stations.names)


def lines_of_position(problem: Problem, fix: Fix, limits: tuple[float, float, float, float]) -> list[tuple[str, Array]]:
    """Return where a target would be by each row alone, at the height of the fix: name, and line (n, 2) in degrees.

    Hyperbolas of time differences, circles of ranges, rays of bearings; other unknowns are as the fix has them.
    """
    figure_class()  # one sentence where matplotlib, which brings contourpy, is missing
    from contourpy import contour_generator

    flat, x = problem.flat(), fix.flat().x[0]
    if flat.batch_shape != (1,) or flat.count > _LINES or not np.isfinite(x).all():
        return []
    slot, shared = flat.layout.find("position") if _positioned(flat) else (None, False)
    if slot is None or not shared:
        return []
    lon, lat = _beyond(*limits[:2]), np.clip(_beyond(*limits[2:]), -89.9, 89.9)
    own = x[slot.start : slot.start + slot.size]
    height = float(problem.frame.to_geodetic(own)[2])
    east, north = (np.radians(v.ravel()) for v in np.meshgrid(lon, lat))
    vectors = np.tile(x, (east.size, 1))
    place = problem.frame.from_geodetic(north, (east + np.pi) % (2.0 * np.pi) - np.pi, np.full(east.size, height))
    vectors[:, slot.start : slot.start + slot.size] = place[:, : slot.size]
    with np.errstate(all="ignore"):
        residual = differentiate(flat, vectors)[0]
    found: list[tuple[str, Array]] = []
    for rows, start in zip(flat.rows, flat.starts, strict=True):
        for i in range(rows.count):
            values = residual[:, start + i].reshape(_GRID, _GRID)
            if MODELS[rows.kind].period is not None:
                values = np.where(np.abs(values) < 0.5 * np.pi, values, np.nan)
            ends = [flat.stations.names[k] for k in (rows.a[i], rows.b[i]) if k >= 0]
            made = contour_generator(lon, lat, np.ma.masked_invalid(values)).lines(0.0)
            found += [(f"{rows.kind} {' – '.join(ends)}", np.asarray(line)) for line in made]
    return found


def _beyond(low: float, high: float) -> Array:
    """Return a grid that goes beyond the limits of a map, whose window may be wider or taller."""
    rim = 0.75 * (high - low)
    return np.linspace(low - rim, high + rim, _GRID)


def _positioned(problem: Problem) -> bool:
    return any(slot.name == "position" for slot in problem.layout.shared)
