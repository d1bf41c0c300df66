"""The choice of the back end that solves the programs of this package, and a count of its iterations.

Both are context variables: each thread and task can have a different choice, and no formulation passes them as
arguments.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Literal

Kind = Literal["conic", "nonlinear"]
"""Kind of the programs that a back end solves."""


@dataclass(frozen=True, slots=True)
class Choice:
    """A back end that replaces the default of a formulation.

    Parameters
    ----------
    kind : "conic" or "nonlinear"
        Kind of programs: "conic" for cvxpy, "nonlinear" for CasADi.
    name : str
        Solver of cvxpy, for instance ``"SCS"``, or plugin of CasADi, for instance ``"sqpmethod"``.
    settings : Mapping[str, Any]
        Settings of the solver, by the solver's names.
    """

    kind: Kind
    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Return a text that is equal for equal choices."""
        return f"{self.kind}:{self.name}:{sorted(self.settings.items())!r}"


@dataclass(frozen=True, slots=True)
class Ending:
    """The result status of one solve of a back end.

    Parameters
    ----------
    backend : str
        Name of the back end.
    status : str
        Status in the words of the back end.
    message : str
        Message of the back end; empty if there is none.
    found : bool
        Whether the returned point is a valid solution.
    """

    backend: str
    status: str
    message: str
    found: bool

    def __str__(self) -> str:
        """Return back end and status, and the message if there is one."""
        return f"{self.backend}: {self.message or self.status}"


class SolverError(ArithmeticError):
    """A back end raised an error for the given numbers."""


def hold_in_forks(lock: Any) -> None:
    """Acquire a lock while the process forks: a lock held by another thread would never be released in the child.

    Parameters
    ----------
    lock : object
        Object with ``acquire`` and ``release``. Of several locks, the one registered last is acquired first.
    """
    if hasattr(os, "register_at_fork"):  # missing on systems without fork
        os.register_at_fork(before=lock.acquire, after_in_parent=lock.release, after_in_child=lock.release)


# Context variables, not globals: a choice inside `using` is valid only in its thread and task. Threads that are to
# share it start in a copy of the caller's context.
_CHOICE: ContextVar[Choice | None] = ContextVar("choice", default=None)
_TALLY: ContextVar[list[tuple[str, int]] | None] = ContextVar("tally", default=None)
_ENDINGS: ContextVar[list[Ending] | None] = ContextVar("endings", default=None)


def choice_for(kind: Kind) -> Choice | None:
    """Return the choice that is valid for a kind of program in this thread; None for the default of the formulation."""
    choice = _CHOICE.get()
    return choice if choice is not None and choice.kind == kind else None


@contextmanager
def using(choice: Choice | None) -> Iterator[None]:
    """Make a choice valid for all code inside the ``with`` block."""
    token = _CHOICE.set(choice)
    try:
        yield
    finally:
        _CHOICE.reset(token)


@contextmanager
def counting() -> Iterator[list[tuple[str, int]]]:
    """Yield a list to which each solve inside the block appends the name of the solver and its iterations."""
    tally: list[tuple[str, int]] = []
    token = _TALLY.set(tally)
    try:
        yield tally
    finally:
        _TALLY.reset(token)


@contextmanager
def recording() -> Iterator[list[Ending]]:
    """Yield a list to which each solve inside the block appends its `Ending`; an outer list gets the same entries."""
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
    """Return the endings of failed solves in the list of the innermost `recording`; () outside of `recording`."""
    return tuple(ending for ending in _ENDINGS.get() or () if not ending.found)


def record(ending: Ending) -> None:
    """Append the ending of a solve to the list of `recording`, if there is one."""
    endings = _ENDINGS.get()  # one list for all threads of a caller: appending is atomic
    if endings is not None:
        endings.append(ending)


def first_sentence(trouble: BaseException) -> str:
    """Return the first line of an error, or its type if it has no text."""
    return str(trouble).partition("\n")[0] or type(trouble).__name__


def count(name: str, iterations: int) -> None:
    """Append a solve to the list of `counting`, if there is one."""
    tally = _TALLY.get()  # one list for all threads of a caller: appending is atomic
    if tally is not None:
        tally.append((name, iterations))
