"""Excess paths of a measurement table: path sums less the distance of the two stations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optloc.base.types import Array, Stations
from optloc.files.measurements import RowChunk


def with_baseline(chunk: RowChunk, baseline: Array) -> RowChunk:
    """Return a chunk of excess paths with the distance (m,) of its stations added."""
    return replace(chunk, z=chunk.z + baseline * (chunk.weight > 0.0), baseline=baseline)


def with_station_distance(chunk: RowChunk, epoch: Array, stations: Stations) -> RowChunk:
    """Return a chunk with excess paths converted to path sums: the distance of the stations is added."""
    if not chunk.excess:
        return chunk
    place = stations.position[epoch if len(stations.position) > 1 else np.zeros_like(epoch)]
    rows = np.arange(len(epoch))
    return with_baseline(chunk, np.linalg.norm(place[rows, chunk.a] - place[rows, chunk.b], axis=-1))
