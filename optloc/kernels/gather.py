"""From derivatives and residuals to normal equations: whitened, multiplied with themselves, summed over groups."""

from __future__ import annotations

from optloc.kernels.jit import compiled
from optloc.kernels.lanes import Scratch, measure
from optloc.kernels.pack import Numbers, Packed
from optloc.kernels.tables import Tables
from optloc.types import Array


@compiled
def gather(packed: Packed, work: Scratch, x: Array, lanes: int, out: Array) -> None:
    """Write the normal equations of the first lanes, priors included.

    Parameters
    ----------
    packed : Packed
        Problems of one epoch, or without unknowns local to the epochs.
    work : Scratch
        Their numbers.
    x : array (p, B)
        Parameter vectors: shared unknowns, then local ones.
    lanes : int
        How many lanes hold a problem.
    out : array (p + 1, p + 1, B)
        Lower triangle of the information; the last row is the vector and the cost.
    """
    t, c = packed
    out[:, :, :lanes] = 0.0
    for packet in range(t.packet_row.shape[0]):
        measure(packed, work, x, packet, lanes)
        for group in range(t.packet_group[packet], t.packet_group[packet + 1]):
            whiten(t, c, work, group, lanes)
            add_group(t, work, group, lanes, out)
    for i in range(c.prior_start.shape[0]):
        start = c.prior_start[i] + (t.shared if c.prior_local[i] else 0)
        add_prior(c, work, i, x[start : start + c.prior_size[i]], start, lanes, out)


@compiled
def whiten(t: Tables, c: Numbers, work: Scratch, group: int, lanes: int) -> None:
    """Write the whitened rows of a group into `work.whitened`."""
    size, columns = t.group_size[group], t.column_at[group + 1] - t.column_at[group] + 1
    first, place = t.group_row[group], c.group_white[group]
    for i in range(size):
        end = size if c.group_full[group] else i + 1
        for s in range(columns):
            target = work.whitened[i, s]
            target[:lanes] = 0.0
            for j in range(end):
                row = work.rows[first + j, s]
                if place >= 0:
                    factor = c.white_common[place + i * size + j]
                    for b in range(lanes):
                        target[b] += factor * row[b]
                else:
                    factors = work.white[-1 - place + i * size + j]
                    for b in range(lanes):
                        target[b] += factors[b] * row[b]


@compiled
def add_group(t: Tables, work: Scratch, group: int, lanes: int, out: Array) -> None:
    """Add the products of the whitened rows of a group."""
    begin, end = t.column_at[group], t.column_at[group + 1]
    size, count, last = t.group_size[group], end - begin, out.shape[0] - 1
    for i in range(count + 1):
        row = out[t.column[begin + i] if i < count else last]
        for j in range(i + 1):
            total = row[t.column[begin + j] if j < count else last]
            for r in range(size):
                u, v = work.whitened[r, i], work.whitened[r, j]
                for b in range(lanes):
                    total[b] += u[b] * v[b]


@compiled
def add_prior(c: Numbers, work: Scratch, prior: int, x: Array, start: int, lanes: int, out: Array) -> None:
    """Add a Gaussian prior of the unknowns x (q, B) whose first column is `start`."""
    size, place, last = c.prior_size[prior], c.prior_at[prior], out.shape[0] - 1
    for i in range(size):
        error, pull = work.error[i], work.error[size + i]
        for b in range(lanes):
            error[b] = (c.prior_common[place + i] if place >= 0 else work.prior[-1 - place + i, b]) - x[i, b]
            pull[b] = 0.0
    for i in range(size):
        pull = work.error[size + i]
        for j in range(size):
            error, at = work.error[j], size + i * size + j
            information = out[start + max(i, j), start + min(i, j)]
            for b in range(lanes):
                precision = c.prior_common[place + at] if place >= 0 else work.prior[-1 - place + at, b]
                pull[b] += precision * error[b]
                if j <= i:
                    information[b] += precision
    for i in range(size):
        error, pull = work.error[i], work.error[size + i]
        for b in range(lanes):
            out[last, start + i, b] += pull[b]
            out[last, last, b] += error[b] * pull[b]
