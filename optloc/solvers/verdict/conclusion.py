"""Data that contradict each other: what the explanations that a search has found mean for status and sentence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optloc.base.types import Array, Certificate, Status, first_status
from optloc.problem.claims import claim
from optloc.problem.explanations import Explanation, Suspect
from optloc.problem.fix import Alternatives, Fix
from optloc.problem.problem import Problem

_SHOWN = 4  # names in a sentence; more are not read
_UNKNOWN = claim(Certificate("unknown", "the data contradict each other", "none"))


@dataclass(frozen=True, slots=True)
class Conclusion:
    """What a search for suspects says about one problem.

    Parameters
    ----------
    explanations : tuple of Explanation
        All whose score comes near the best, that one first; empty where none passes.
    rest : Fix
        Of what the first explanation leaves, without batch axes; of all the data where there is none.
    alternatives : Alternatives
        Other positions, of the first explanation and of the others.
    spent : int
        Redundancy that the first explanation takes.
    several : bool
        Whether other explanations place the target elsewhere.
    tried : str
        Where there is no explanation: what came closest.
    """

    explanations: tuple[Explanation, ...]
    rest: Fix
    alternatives: Alternatives
    spent: int = 0
    several: bool = False
    tried: str = ""


def conclude(problem: Problem, conclusion: Conclusion) -> Fix:
    """Return the fix, a flat batch of one, that a conclusion means for its problem.

    One explanation is taken; several that place the target elsewhere make the fix ambiguous, none makes it
    contradictory. One that leaves little to check it, or that needs a common offset, is unproven.
    """
    rest, explanations = conclusion.rest, conclusion.explanations
    if not explanations:
        return _contradictory(conclusion).reshape((1,))
    first = explanations[0]
    weights = np.array(np.broadcast_to(problem.weight, (1, problem.count))[0])
    weights[[row for suspect in first.suspects for row in suspect.rows]] = 0.0
    # the rest stays as it was judged; several explanations are several positions
    marks = int(rest.marks) if rest.marks is not None else rest.status.mark
    if conclusion.several and rest.answered:
        marks |= Status.AMBIGUOUS.mark
    reason = _name_rivals(explanations) if conclusion.several else _name_suspects(explanations, rest)
    if rest.answered and int(rest.dof) <= conclusion.spent:
        # 2 q name the culprits of q rows, and one more notices that there is another
        marks |= Status.UNPROVEN.mark
        reason += f"; redundancy {int(rest.dof)} without them: another explanation would not be noticed"
    if rest.answered and any(suspect.group == "offset" for suspect in first.suspects):
        marks |= Status.UNPROVEN.mark
        reason += '; a bias of all of them has to be stated in the problem, as [[bias]] with per = "kind"'
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
    """Return the fix with nothing left out, without a covariance: the noise that it would follow from is refuted."""
    whole, reason = conclusion.rest, conclusion.tried
    if whole.status == Status.CONTRADICTORY and whole.reason[()]:  # what the constraints have to do with it
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
    """Return names as a sentence has them: "a, b and c"."""
    if len(parts) > _SHOWN:
        parts = [*parts[:_SHOWN], f"{len(parts) - _SHOWN} more"]
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


def _name_suspects(explanations: Sequence[Explanation], rest: Fix) -> str:
    explanation = explanations[0]
    parts = [f"{suspect.name}{_error(suspect)}" for suspect in explanation.suspects]
    verb = "given" if all(suspect.group == "offset" for suspect in explanation.suspects) else "left out"
    reason = f"{verb}: {list_names(parts)}; p = {_p(explanation.suspects[0].p_with)} with"
    reason += "" if len(parts) == 1 else " the first"
    reason = f"{reason}, {_p(explanation.p_value)} without"
    if len(explanations) > 1:
        reason += f"; the same place follows from {_either(explanations[1:])}"
    own = str(rest.reason[()] or "")
    return reason + (f"; {own}" if own else "")


def _name_rivals(explanations: Sequence[Explanation]) -> str:
    common = set(explanations[0].names).intersection(*(one.names for one in explanations[1:]))
    sure = f"; {list_names(sorted(common))} in all of them" if common else ""
    return f"several explanations pass: {_either(explanations)}{sure}"


def _either(explanations: Sequence[Explanation]) -> str:
    """Return explanations as a sentence has them: "A or B and C", by whom they leave out."""
    shown = [" and ".join(one.names) or "nobody" for one in explanations[:_SHOWN]]
    more = f" or {len(explanations) - _SHOWN} others" if len(explanations) > _SHOWN else ""
    return " or ".join(shown) + more


def _error(suspect: Suspect) -> str:
    """Return the error of a suspect of one number in words."""
    if len(suspect.error) != 1 or not np.isfinite(suspect.error[0]):
        return ""
    return f" (error {suspect.error[0]:+.3g}, sigma {suspect.sigma[0]:.2g})"


def _p(value: float) -> str:
    return "none" if np.isnan(value) else f"{value:.1g}"


def _object(value: object) -> Array:
    out = np.empty((), dtype=object)
    out[()] = value
    return out
