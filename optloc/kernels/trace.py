"""Measurement functions with their derivatives as tapes: each kind is traced once, whoever registered it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from optloc.kernels.symbol import Recorder, Symbol
from optloc.kernels.tape import Tape, tape
from optloc.models import Model
from optloc.models.jet import Jet
from optloc.plan import Plan
from optloc.problem import Problem
from optloc.states import joined


@dataclass(frozen=True, slots=True)
class Traced:
    """A measurement function on registers.

    Parameters
    ----------
    tape : Tape
        Its first output is the value, the others are the derivatives.
    seeds : tuple of int
        Which input each derivative belongs to; a seed that does not move the value is missing.
    """

    tape: Tape
    seeds: tuple[int, ...]


_TRACED: dict[tuple[Any, ...], Traced | None] = {}


def traced(problem: Problem, plan: Plan, given: frozenset[int], moved: frozenset[int]) -> Traced | None:
    """Return the tape of a block of rows, or None where its function cannot be traced.

    Parameters
    ----------
    problem : Problem
        Gives dimension and frame.
    plan : Plan
        The block.
    given : set of int
        Inputs that are data.
    moved : set of int
        Inputs that unknowns move: those that derivatives are wanted of.
    """
    model = plan.model
    frame = problem.frame if model.ecef else None
    key = (model, given, moved, problem.dimension, frame)
    if key not in _TRACED:
        _TRACED[key] = _trace(problem, model, given, moved)
    return _TRACED[key]


def _trace(problem: Problem, model: Model, given: frozenset[int], moved: frozenset[int]) -> Traced | None:
    recorder = Recorder()
    inputs: dict[int, Any] = {seed: recorder.input(seed) for seed in sorted(given | moved)}
    inputs |= {seed: Jet(inputs[seed], {seed: 1.0}) for seed in sorted(moved)}
    try:
        value = model.h(*joined(problem, model, inputs))
        partials = dict(value.partials) if isinstance(value, Jet) else {}
        value = value.value if isinstance(value, Jet) else value
        if not isinstance(value, Symbol | int | float):
            return None
        seeds = tuple(seed for seed in sorted(partials) if recorder.constant(recorder.node(partials[seed])) != 0.0)
        return Traced(tape(recorder, [value, *(partials[seed] for seed in seeds)]), seeds)
    except (TypeError, AttributeError, ValueError):  # it asks for more than the elementary functions
        return None
