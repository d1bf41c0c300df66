"""Differences of arrival times, which replace arrivals with unknown emission times in trackers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from optloc.base.types import Array, Rows
from optloc.linear.least_squares_ranges import reduce
from optloc.problem.epochs import cut
from optloc.problem.noise import Block, Noise
from optloc.problem.problem import Problem


def differences(run: Problem) -> Problem:
    """Return the run of one target with differences of arrivals in each epoch instead of the arrivals.

    The differences and their covariance contain all information of the arrivals about positions. So a tracker
    needs no emission times.
    """
    scans = [reduce(cut(run, k, k + 1)) for k in range(run.epochs)]
    kinds = dict.fromkeys(rows.kind for scan in scans for rows in scan.rows)
    blocks_of_kind: dict[str, list[Rows]] = {kind: [] for kind in kinds}
    # New row numbers: the run has one block of rows per kind, with all epochs in a block.
    numbers = [np.zeros(scan.count, dtype=np.int64) for scan in scans]
    count = 0
    for kind, found in blocks_of_kind.items():
        for k, scan in enumerate(scans):
            for rows, start in zip(scan.rows, scan.starts, strict=True):
                if rows.kind == kind:
                    numbers[k][start : start + rows.count] = np.arange(count, count + rows.count)
                    found.append(replace(rows, epoch=np.full(rows.count, k)))
                    count += rows.count
    blocks = [
        Block(numbers[k][block.row], block.covariance)
        for k, scan in enumerate(scans)
        for block in scan.noise.blocks
        if block.row.size
    ]
    return replace(
        run, rows=tuple(_one_after_another(found) for found in blocks_of_kind.values()), noise=Noise(tuple(blocks))
    )


def _one_after_another(parts: list[Rows]) -> Rows:
    """Return several blocks of rows of one kind as one block, in the given order."""

    def joined_column(name: str) -> Array:
        """Return the values of all rows in the column `name`."""
        return np.concatenate([getattr(part, name) for part in parts])

    names = ("z", "a", "b", "epoch", "target", "weight", "correction")
    columns: dict[str, Any] = {name: joined_column(name) for name in names}
    return replace(parts[0], **columns)
