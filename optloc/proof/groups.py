"""Groups of nodes that correlated rows connect: each group is solved for its single nodes.

A node is a scalar function of the position, such as a range; whitened rows are K phi - w. Differences of ranges
determine nodes only up to a common *reference* range. The enclosure of a fix (`optloc.proof.enclosure`) then bounds
each node.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optloc.base.types import Array
from optloc.kernels.jit import compiled, zero
from optloc.kernels.systems import invert
from optloc.proof.nodes.node import RANGE

# Nodes count as independent if their coupling by rows is below this share. Rounding of whitened rows leaves such an
# entry of K'K in place of zero.
_APART = 1e-13
# Least pivot of a group's rows as a share of the diagonal; greatest distance of tie factors from -1, 0 and 1; and
# greatest error of products, half of the slack of an enclosure. A group whose covariance has lost more digits bounds
# no node.
_PIVOT, _TIED, _BLURRED = 1e-9, 1e-9, 5e-7
# References of a group that needs no reference, and of a group whose rows are too few.
NONE, LOOSE = -1, -2


class Groups(NamedTuple):
    """Nodes in groups: a node of a group is ``phi_j = n_j r_p + z_j + e_j``, with r_p the reference range of the group.

    Parameters
    ----------
    order : int array (3, J)
        First row: the nodes, group after group, the reference last. Second row: sizes of the groups, then a zero.
        Third row: references of the groups, a node, NONE or LOOSE.
    R : array (J, J)
        Covariances of the errors e of each group without its reference, in the same order.
    tie : array (J,)
        Factors n_j of the nodes: -1, 0 or 1.
    """

    order: Array
    R: Array
    tie: Array


@compiled
def empty_groups(J: int) -> Groups:
    """Return uninitialised arrays for groups of J nodes."""
    return Groups(np.empty((3, J), np.int64), np.empty((J, J)), np.empty(J))


@compiled
def set_groups(kinds: Array, A: Array, groups: Groups) -> None:
    """Write the groups of nodes with codes `kinds` (J,) and products of rows ``A = K'K`` (J, J) into `groups`."""
    J, order = kinds.shape[0], groups.order
    first = number = zero()
    for j in range(J):
        order[0, j] = j
    while first < J:
        count = _gather(A, order[0], first)
        order[1, number] = count
        order[2, number] = _solve(kinds, A, order[0], first, count, groups.R, groups.tie)
        first += count
        number += 1
    order[1, number:] = 0


@compiled
def _gather(A: Array, member: Array, first: int) -> int:
    """Move the nodes that are coupled to the node at `first` directly behind it; return the size of the group.

    `member` (J,) is the list of nodes, in any order from `first` on. Nodes are coupled if their entry of A is not
    rounding, directly or through other nodes.
    """
    seen, end = first, first + 1
    while seen < end:
        j = member[seen]
        seen += 1
        for i in range(end, A.shape[0]):
            m = member[i]
            if A[j, m] * A[j, m] > _APART * _APART * A[j, j] * A[m, m]:
                member[i], member[end] = member[end], m
                end += 1
    return int(end - first)


@compiled
def _solve(kinds: Array, A: Array, member: Array, first: int, count: int, R: Array, tie: Array) -> int:
    """Solve the rows of a group for its nodes; return its reference, which is moved to the end of the group.

    The result is NONE if the group needs no reference, and LOOSE if its rows are too few. The group is
    member[first:first + count], and A is K'K (J, J). `R` and `tie` are written as in `Groups`.
    """
    if _ties(kinds, A, member, first, count, count, R, tie):
        return NONE
    # The rows determine differences only. Any range can be the reference; the function takes the first range.
    for i in range(first, first + count):
        if kinds[member[i]] == RANGE:
            last, reference = first + count - 1, member[i]
            member[i], member[last] = member[last], reference
            return reference if _ties(kinds, A, member, first, count - 1, count, R, tie) else LOOSE
    return LOOSE


@compiled
def _ties(kinds: Array, A: Array, member: Array, first: int, size: int, count: int, R: Array, tie: Array) -> bool:
    """Write the covariance R of the errors, and the factors n_j; return False if the rows do not have this form.

    The arguments are as in `_solve`. The first `size` of the `count` nodes of the group are solved. If `count` is
    larger, the last node is the reference.
    """
    own = R[first : first + size, first : first + size]
    for i in range(size):
        for j in range(size):
            own[i, j] = A[member[first + i], member[first + j]]
    if size == 0 or not invert(own, size, _PIVOT):
        return False
    condition = 0.0  # at least the ratio of largest to least eigenvalue of the rows scaled to equal lengths
    for i in range(size):
        condition += A[member[first + i], member[first + i]] * own[i, i]
    if not (size + 2) * 2.0**-52 * size * condition <= _BLURRED:
        return False
    for i in range(size, count):
        tie[member[first + i]] = 0.0
    for i in range(size):
        factor = 0.0
        for j in range(size if size < count else 0):
            factor -= own[i, j] * A[member[first + j], member[first + size]]
        nearest = 0.0 if abs(factor) < 0.5 else (1.0 if factor > 0.0 else -1.0)
        if not abs(factor - nearest) <= _TIED or (nearest != 0.0 and kinds[member[first + i]] != RANGE):
            return False
        tie[member[first + i]] = nearest
    return True
