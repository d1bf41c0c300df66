"""Limits on the number of sites in groups, checked before the search starts.

Letters: G groups, n sites.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from optloc.problem import Array, InvalidProblem

# Members of a group, and groups, that a message names; it counts the others.
_NAMED, _GROUPS = 8, 3


@dataclass(frozen=True, slots=True)
class CountGroup:
    """A rule for the number of sites that are taken from a group.

    Parameters
    ----------
    members : tuple of str
        Names of the sites in the group.
    most, least : int, optional
        Largest and smallest number of members that are taken, kept sites included.
    """

    members: tuple[str, ...]
    most: int | None = None
    least: int | None = None


def check_groups(
    groups: Sequence[CountGroup], members: Array, names: Sequence[str], state: Array, choose: int | None
) -> None:
    """Raise if no set of sites meets the groups, or if the wanted number of sites does not fit the groups.

    `members` (G, n) marks the n sites of each of the G groups. `names` are the names of the n sites. `state`
    (n,) is -1 for free, 0 for forbidden and 1 for kept sites. `choose` is the wanted number of free sites;
    None leaves the number to the budget.

    Raises
    ------
    InvalidProblem
        The message names the groups and the possible number of sites.
    """
    for i, group in enumerate(groups):
        _check_group(f"groups, entry {i + 1}", group, members[i], names, state)
    most, least = (_extreme_count(groups, members, state, sign) for sign in (-1.0, 1.0))
    if most is None or least is None:
        what = f"no set of sites meets the rules of groups {_group_numbers(groups)} together"
        raise InvalidProblem(what, "groups", "raise most or lower least of a group")
    if choose is None:
        return
    if choose > most:
        cause = _limiting_groups(groups, members, state, most)
        rules = " and ".join(f"at most {groups[i].most} of {_list_names(members[i], names)}" for i in cause[:_GROUPS])
        rules += f" and {len(cause) - _GROUPS} more groups" if len(cause) > _GROUPS else ""
        what = f"{choose} sites are wanted, but the groups allow at most {most} ({rules})"
        raise InvalidProblem(what, "choose", f"choose {most} or fewer, or raise most of a group")
    if choose < least:
        what = f"{choose} sites are wanted, but the groups need at least {least}"
        raise InvalidProblem(what, "choose", f"choose {least} or more, or lower least of a group")


def _check_group(where: str, group: CountGroup, members: Array, names: Sequence[str], state: Array) -> None:
    """Raise if no set of sites can meet this group, independent of the other groups.

    `members` (n,) marks its sites, `names` are the names of all sites, and `state` (n,) is as in
    `check_groups`. `where` is the place in the file for the message.
    """
    kept, available = int((members & (state == 1)).sum()), int((members & (state != 0)).sum())
    listed = _list_names(members, names)
    if group.most is not None and kept > group.most:
        what = f"at most {group.most} of {listed} may be taken, but {kept} of them are kept"
        raise InvalidProblem(what, where, "raise most, or keep fewer")
    if group.least is not None and group.least > available:
        what = f"at least {group.least} of {listed} are wanted, but only {available} of them can be taken"
        raise InvalidProblem(what, where, "lower least, or add candidates")
    if group.least is not None and group.most is not None and group.least > group.most:
        what = f"at least {group.least} and at most {group.most} of {listed} are wanted"
        raise InvalidProblem(what, where, "make least no larger than most")


def _extreme_count(groups: Sequence[CountGroup], members: Array, state: Array, sign: float) -> int | None:
    """Return the largest (sign -1) or smallest (sign 1) number of free sites in a set that meets all groups.

    The result is None if no set meets the groups. An integer programme finds it. `members` (G, n) marks the
    sites of each group; `state` (n,) is as in `check_groups`.
    """
    low = np.array([-np.inf if g.least is None else g.least for g in groups], dtype=float)
    high = np.array([np.inf if g.most is None else g.most for g in groups], dtype=float)
    rules = [LinearConstraint(members.astype(float), low, high)] if len(groups) else []
    free = (state == -1).astype(float)
    sites = Bounds((state == 1).astype(float), (state != 0).astype(float))
    solved = milp(sign * free, integrality=np.ones(len(state), dtype=np.int64), bounds=sites, constraints=rules)
    return None if solved.x is None else round(float(free @ solved.x))


def _limiting_groups(groups: Sequence[CountGroup], members: Array, state: Array, most: int) -> list[int]:
    """Return the indices of the groups that limit the number of free sites to `most`, for an error message.

    If the removal of one group allows more sites, the list has only this group. Otherwise it has all groups
    with an effective upper limit. `members` (G, n) and `state` (n,) are as in `check_groups`.
    """
    limiting = [i for i, group in enumerate(groups) if group.most is not None and group.most < members[i].sum()]
    for i in limiting:
        kept = [k for k in range(len(groups)) if k != i]
        if (_extreme_count([groups[k] for k in kept], members[kept], state, -1.0) or 0) > most:
            return [i]
    return limiting


def _list_names(mask: Array, names: Sequence[str]) -> str:
    """Return the names at the true entries of a mask (n,) as text: at most `_NAMED`, then the number of others."""
    members = [names[i] for i in np.flatnonzero(mask).tolist()]
    return ", ".join(members[:_NAMED]) + (f" and {len(members) - _NAMED} more" if len(members) > _NAMED else "")


def _group_numbers(groups: Sequence[CountGroup]) -> str:
    """Return the numbers of all groups as text."""
    return ", ".join(str(i + 1) for i in range(len(groups)))
