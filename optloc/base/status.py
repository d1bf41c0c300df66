"""Verdicts: is there an answer, and how sure is it the best one?"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Status(IntEnum):
    """Whether a fix holds an answer; every member carries a sentence with advice."""

    # The numbers stand in stored studies: a new member takes the next one, none changes.
    OK = 0
    AMBIGUOUS = 1
    SEARCHED = 2
    MAX_ITERATIONS = 3
    STALLED = 4
    SINGULAR_GEOMETRY = 5
    TOO_FEW_ROWS = 6
    INFEASIBLE = 7
    UNBOUNDED = 8
    NUMERICAL = 9
    REJECTED = 10
    UNAVAILABLE = 11
    DISCONNECTED = 12
    CONTRADICTORY = 13

    @property
    def sentence(self) -> str:
        """Return what happened and what to do about it."""
        return _SENTENCES[self]

    @property
    def label(self) -> str:
        """Return the member's name as people and files spell it, for instance "too few rows"."""
        return self.name.lower().replace("_", " ")


# What happened, then what helps: a user reads this sentence and no code.
_SENTENCES: dict[Status, str] = {
    Status.OK: "A refined maximum-likelihood fix.",
    Status.AMBIGUOUS: "Several positions explain the data about equally well; see the alternatives, or add a row, a "
    "station or a known height that tells them apart.",
    Status.SEARCHED: "No safe start is known for this mixture of rows: this is the best of a seeded search.",
    Status.MAX_ITERATIONS: "The refinement used all its iterations; raise the limit or look at the geometry.",
    Status.STALLED: "The refinement could not lower the cost any more although its gradient is not zero.",
    Status.SINGULAR_GEOMETRY: "The rows leave a direction of the answer undetermined; add a station off it.",
    Status.TOO_FEW_ROWS: "There are fewer measurements than unknowns; add rows or fix an unknown.",
    Status.INFEASIBLE: "No position meets the constraints.",
    Status.UNBOUNDED: "The likelihood keeps rising towards infinity: the data say a direction, not a range.",
    Status.NUMERICAL: "A solver failed numerically; check the scale and the units of the input.",
    Status.REJECTED: "A measurement is not a finite number; remove the row or give it weight zero.",
    Status.UNAVAILABLE: "The method does not apply to these kinds of rows; choose another or 'auto'.",
    Status.DISCONNECTED: "The station pairs fall into groups without a common station; add a pair that links them.",
    Status.CONTRADICTORY: "The measurements contradict each other, and leaving few of them out does not help, or they "
    "contradict the constraints; check the stations' places and clocks, the noise levels and the bounds.",
}


@dataclass(frozen=True, slots=True)
class Certificate:
    """How sure it is that a fix is the best one.

    Parameters
    ----------
    proof : "global", "region", "local" or "unknown"
        What has been proven about the maximum-likelihood cost: no position costs less, none of a region does, none
        nearby does, or nothing.
    reason : str
        What is claimed in a sentence, and why it is this and not more.
    method : str
        What was done to find out.
    bound : float
        Lower bound of the maximum-likelihood cost over all positions, or over the region; NaN where none was computed.
    gap : float
        Cost less bound.
    unique : bool
        Whether it is proven too that no other minimum costs less than `margin` more, but for listed alternatives;
        otherwise other minima were searched for, not excluded.
    margin : float
        Cost beyond that of the fix below which no other minimum is left; 0 where uniqueness is not proven.
    boxes : int
        How many boxes a proof by branch and bound looked at.
    region : tuple of (lower, upper), optional
        Corners of the region of the claim, each d coordinates in the problem's frame, metres.
    """

    proof: str
    reason: str
    method: str
    bound: float = float("nan")
    gap: float = float("nan")
    unique: bool = False
    margin: float = 0.0
    boxes: int = 0
    region: tuple[tuple[float, ...], tuple[float, ...]] | None = None
