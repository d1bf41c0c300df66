"""Contradictory data: status and reason of a fix from the explanations that a search for suspects found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array, Certificate, Status, first_status
from optloc.problem.claims import claim
from optloc.problem.explanations import Explanation, Suspect
from optloc.problem.fix import Fix
from optloc.problem.fix_parts import Alternatives
from optloc.problem.problem import Problem

_SHOWN = 4  # names in a sentence: a longer list does not help
_UNKNOWN = claim(Certificate("unknown", "the data contradict each other", "none"))


@dataclass(frozen=True, slots=True)
class Conclusion:
    """The result of a search for suspects in one problem.

    Parameters
    ----------
    explanations : tuple of Explanation
        Explanations whose score is near the best, the best first; empty if no explanation passes.
    rest : Fix
        Fix of the rows that the first explanation keeps, without batch axes; of all rows if there is no explanation.
    alternatives : Alternatives
        Other positions, of the first explanation and of the others.
    spent : int
        Redundancy that the first explanation uses.
    several : bool
        Whether explanations lead to different positions.
    tried : str
        If no explanation passes: a sentence on the closest one.
    """

    explanations: tuple[Explanation, ...]
    rest: Fix
    alternatives: Alternatives
    spent: int = 0
    several: bool = False
    tried: str = ""


def conclude(problem: Problem, conclusion: Conclusion) -> Fix:
    """Return the fix of a problem from the result of its search for suspects, a flat batch of one.

    The first explanation gives the fix. If explanations lead to different positions, the fix is `ambiguous`. Without an
    explanation it is `contradictory`. If the explanation leaves too little redundancy, or needs a common offset, the
    fix is `unproven`.
    """
    rest, explanations = conclusion.rest, conclusion.explanations
    if not explanations:
        return _contradictory(conclusion).reshape((1,))
    first = explanations[0]
    weights = np.array(np.broadcast_to(problem.weight, (1, problem.count))[0])
    weights[[row for suspect in first.suspects for row in suspect.rows]] = 0.0
    # the fix of the remaining rows keeps its marks; several explanations give several positions
    marks = int(rest.marks) if rest.marks is not None else rest.status.mark
    if conclusion.several and rest.answered:
        marks |= Status.AMBIGUOUS.mark
    reason = _name_rivals(explanations) if conclusion.several else _name_suspects(explanations, rest)
    if rest.answered and int(rest.dof) <= conclusion.spent:
        # a redundancy of 2 q names q wrong rows; one more shows that another explanation exists
        marks |= Status.UNPROVEN.mark
        reason += f"; redundancy {int(rest.dof)} without them is too small to exclude another explanation"
    if rest.answered and any(suspect.group == "offset" for suspect in first.suspects):
        marks |= Status.UNPROVEN.mark
        reason += '; state the common bias in the problem, as [[bias]] with per = "kind"'
    return replace(
        rest,
        x=first.x,
        code=first_status(np.array(marks)),
        marks=np.array(marks, dtype=np.int32),
        reason=_object(reason),
        alternatives=conclusion.alternatives,
        weights=weights,
        local=rest.local if rest.layout == problem.layout else None,
        explanations=_object(explanations),
    ).reshape((1,))


def _contradictory(conclusion: Conclusion) -> Fix:
    """Return the fix of all rows without a covariance: its noise model is refuted."""
    whole, reason = conclusion.rest, conclusion.tried
    if whole.status == Status.CONTRADICTORY and whole.reason[()]:  # that reason names the constraints
        reason = f"{whole.reason[()]}; {reason}"
    return replace(
        whole,
        cov=np.full_like(whole.cov, np.nan),
        code=np.array(int(Status.CONTRADICTORY), dtype=np.int8),
        marks=np.array(Status.CONTRADICTORY.mark, dtype=np.int32),
        reason=_object(reason),
        claims=_UNKNOWN,
        local=None if whole.local is None else np.full_like(whole.local, np.nan),
        explanations=_object(()),
    )


def list_names(parts: Sequence[str]) -> str:
    """Return names as a part of a sentence: "a, b and c". At most four names are listed, and the others counted."""
    if len(parts) > _SHOWN:
        parts = [*parts[:_SHOWN], f"{len(parts) - _SHOWN} more"]
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


def _name_suspects(explanations: Sequence[Explanation], rest: Fix) -> str:
    """Return the reason of a fix with one explanation, or with several that give one position."""
    explanation = explanations[0]
    parts = [f"{suspect.name}{_error(suspect)}" for suspect in explanation.suspects]
    verb = "offset estimated" if all(suspect.group == "offset" for suspect in explanation.suspects) else "left out"
    reason = f"{verb}: {list_names(parts)}; p = {_p(explanation.suspects[0].p_with)} with"
    reason += "" if len(parts) == 1 else " the first"
    reason = f"{reason}, {_p(explanation.p_value)} without"
    if len(explanations) > 1:
        reason += f"; other explanations give the same position: {_either(explanations[1:])}"
    own = str(rest.reason[()] or "")
    return reason + (f"; {own}" if own else "")


def _name_rivals(explanations: Sequence[Explanation]) -> str:
    """Return the reason of a fix with explanations that give different positions."""
    common = set(explanations[0].names).intersection(*(one.names for one in explanations[1:]))
    sure = f"; {list_names(sorted(common))} in every explanation" if common else ""
    return f"several explanations pass: {_either(explanations)}{sure}"


def _either(explanations: Sequence[Explanation]) -> str:
    """Return explanations by the names of their suspects, as a part of a sentence: "A or B and C".

    Most `_SHOWN` explanations are named, and the others are counted.
    """
    shown = [" and ".join(one.names) or "no station" for one in explanations[:_SHOWN]]
    more = f" or {len(explanations) - _SHOWN} others" if len(explanations) > _SHOWN else ""
    return " or ".join(shown) + more


def _error(suspect: Suspect) -> str:
    """Return the error of a suspect with a single error as text; else an empty text."""
    if len(suspect.error) != 1 or not np.isfinite(suspect.error[0]):
        return ""
    return f" (error {suspect.error[0]:+.3g}, sigma {suspect.sigma[0]:.2g})"


def _p(value: float) -> str:
    """Return a p-value as text; "none" without redundancy."""
    return "none" if np.isnan(value) else f"{value:.1g}"


def _object(value: object) -> Array:
    """Return a value as an object array without axes."""
    out = np.empty((), dtype=object)
    out[()] = value
    return out
