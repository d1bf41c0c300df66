"""The nodes of a proof and the cost that they make, written a second time, plainly."""

from __future__ import annotations

import numpy as np
import pymap3d

from optloc.proof.nodes.node import AZIMUTH, ELEVATION, HEIGHT, LINEAR, RANGE, RATE, RATIO
from optloc.proof.position_costs import position_costs


def node_values(problem, kinds, data, x):
    """Return the values (M, J) of the nodes at positions x (M, d), from the words of the table of nodes."""
    d, out = x.shape[-1], []
    for j, kind in enumerate(kinds):
        p = data[:, j]
        line = x - p[:, :d]
        if kind == RANGE:
            out.append(np.linalg.norm(line, axis=-1))
        elif kind == RATIO:
            out.append(np.linalg.norm(line, axis=-1) / np.linalg.norm(x - p[:, 3 : 3 + d], axis=-1))
        elif kind == RATE:
            out.append((line * p[:, 3 : 3 + d]).sum(-1) / np.linalg.norm(line, axis=-1))
        elif kind == LINEAR:
            out.append((line * p[:, 3 : 3 + d]).sum(-1))
        elif kind in (AZIMUTH, ELEVATION):
            own = (p[:, 6:15].reshape(-1, 3, 3)[:, :d, :d] @ line[..., None])[..., 0]
            if kind == AZIMUTH:
                angle = np.arctan2(own[:, 1], own[:, 0]) - p[:, 15]
                out.append((angle + np.pi) % (2.0 * np.pi) - np.pi)
            else:
                out.append(np.arcsin(own[:, 2] / np.linalg.norm(own, axis=-1)))
        else:
            assert kind == HEIGHT
            ecef = line @ np.swapaxes(p[0, 6:15].reshape(3, 3), 0, 1) + p[0, 3:6]
            out.append(pymap3d.ecef2geodetic(*ecef.T)[2])
    return np.stack(out, axis=-1)


def cost_of(problem, x):
    """Return the cost (M,) of one problem at positions x (M, d)."""
    one = position_costs(problem.flat())
    phi = node_values(problem, one.kinds, np.broadcast_to(one.data[:1], (len(x), *one.data.shape[1:])), x)
    return ((phi @ one.K[0].T - one.w[:1]) ** 2).sum(-1)
