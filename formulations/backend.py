"""Which back end solves the programs of this package, and a count of what solving took.

Both are context variables: threads and tasks may each have a choice of their own, and no formulation passes them on.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Literal

Kind = Literal["conic", "nonlinear"]
"""What a back end solves."""


@dataclass(frozen=True, slots=True)
class Choice:
    """A back end in the place of a formulation's own.

    Parameters
    ----------
    kind : "conic" or "nonlinear"
        Which programs it takes: those of cvxpy, or those of CasADi.
    name : str
        Solver of cvxpy, for instance ``"SCS"``, or plugin of CasADi, for instance ``"sqpmethod"``.
    settings : Mapping[str, Any]
        Its settings, by its own names.
    """

    kind: Kind
    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Return text that is equal for equal choices."""
        return f"{self.kind}:{self.name}:{sorted(self.settings.items())!r}"


@dataclass(frozen=True, slots=True)
class Ending:
    """How one solve of a back end ended.

    Parameters
    ----------
    backend : str
        Name of the back end.
    status : str
        Its own word.
    message : str
        Its own sentence; empty where it has none.
    found : bool
        Whether it returned a point that is an answer.
    """

    backend: str
    status: str
    message: str
    found: bool

    def __str__(self) -> str:
        """Return back end and status, and the message where there is one."""
        return f"{self.backend}: {self.message or self.status}"


class SolverError(ArithmeticError):
    """A back end stopped with an error of its own on numbers that it was given."""


def hold_in_forks(lock: Any) -> None:
    """Let nobody else hold a lock, or all locks behind it, while the process forks: in the child nobody would open it.

    Parameters
    ----------
    lock : object
        It has ``acquire`` and ``release``. Of several the one that was named last is taken first.
    """
    if hasattr(os, "register_at_fork"):  # not where processes do not fork
        os.register_at_fork(before=lock.acquire, after_in_parent=lock.release, after_in_child=lock.release)


# Context variables, not globals: a choice inside `using` holds for its thread and task alone. Threads that are meant to
# share it start in a copy of the caller's context.
_CHOICE: ContextVar[Choice | None] = ContextVar("choice", default=None)
_TALLY: ContextVar[list[tuple[str, int]] | None] = ContextVar("tally", default=None)
_ENDINGS: ContextVar[list[Ending] | None] = ContextVar("endings", default=None)


def choice_for(kind: Kind) -> Choice | None:
    """Return the choice that holds for a kind of program, None for the formulation's own."""
    choice = _CHOICE.get()
    return choice if choice is not None and choice.kind == kind else None


@contextmanager
def using(choice: Choice | None) -> Iterator[None]:
    """Let a choice hold for everything inside."""
    token = _CHOICE.set(choice)
    try:
        yield
    finally:
        _CHOICE.reset(token)


@contextmanager
def counting() -> Iterator[list[tuple[str, int]]]:
    """Yield a list to which everything inside adds the name of the solver and its iterations, one pair a solve."""
    tally: list[tuple[str, int]] = []
    token = _TALLY.set(tally)
    try:
        yield tally
    finally:
        _TALLY.reset(token)


@contextmanager
def recording() -> Iterator[list[Ending]]:
    """Yield a list to which every solve inside adds how it ended; a list outside gets the same entries afterwards."""
    endings: list[Ending] = []
    outer = _ENDINGS.get()
    token = _ENDINGS.set(endings)
    try:
        yield endings
    finally:
        _ENDINGS.reset(token)
        if outer is not None:
            outer.extend(endings)


def failures() -> tuple[Ending, ...]:
    """Return the endings without an answer that the innermost `recording` holds so far."""
    return tuple(ending for ending in _ENDINGS.get() or () if not ending.found)


def record(ending: Ending) -> None:
    """Add the ending of a solve to the list of `recording`, where there is one."""
    endings = _ENDINGS.get()  # one list for all threads of a caller: appending is atomic
    if endings is not None:
        endings.append(ending)


def first_sentence(trouble: BaseException) -> str:
    """Return the first line of an error, and its type where it has no text."""
    return str(trouble).partition("\n")[0] or type(trouble).__name__


def count(name: str, iterations: int) -> None:
    """Add a solve to the tally, where one is kept."""
    tally = _TALLY.get()  # one list for all threads of a caller: appending is atomic
    if tally is not None:
        tally.append((name, iterations))
