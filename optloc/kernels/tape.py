"""A function of numbers as a straight list of operations on registers: only what is needed, registers used again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optloc.kernels.symbol import CONSTANT, INPUT, Recorder, computed
from optloc.types import Array


@dataclass(frozen=True, slots=True)
class Tape:
    """A straight list of operations on registers.

    Parameters
    ----------
    code : int array (n, 4)
        Operation, target register, left and right operand; a target is never an operand of its own operation.
    inputs : tuple of (seed, register)
        Where each input is expected.
    constants : tuple of (register, value)
        What must be there before the first operation.
    outputs : tuple of int
        Registers of the outputs.
    registers : int
        How many there are.
    """

    code: Array
    inputs: tuple[tuple[int, int], ...]
    constants: tuple[tuple[int, float], ...]
    outputs: tuple[int, ...]
    registers: int


def tape(recorder: Recorder, outputs: list[Any]) -> Tape:
    """Return the operations that given outputs (symbols or numbers) need, in order, registers used again and again."""
    wanted = [recorder.node(value) for value in outputs]
    needed = _needed(recorder, wanted)
    last = _last_uses(recorder, needed, wanted)
    free: list[int] = []
    code: list[tuple[int, int, int, int]] = []
    loaded = [node for node in needed if recorder.nodes[node][0] < 0]
    register = {node: number for number, node in enumerate(loaded)}
    count = len(loaded)
    for node in needed:
        operation, left, right = recorder.nodes[node]
        if operation < 0:
            continue
        count += not free
        register[node] = free.pop() if free else count - 1
        code.append((operation, register[node], register[left], register[right]))
        free.extend(register[used] for used in {left, right} if last[used] == node)
    return Tape(
        np.array(code, dtype=np.int64).reshape(-1, 4),
        tuple((int(recorder.nodes[n][1]), register[n]) for n in loaded if recorder.nodes[n][0] == INPUT),
        tuple((register[n], float(recorder.nodes[n][1])) for n in loaded if recorder.nodes[n][0] == CONSTANT),
        tuple(register[node] for node in wanted),
        count,
    )


def _needed(recorder: Recorder, wanted: list[int]) -> list[int]:
    """Return the nodes that others need, in the order in which they were written down."""
    found: set[int] = set()
    ahead = list(wanted)
    while ahead:
        node = ahead.pop()
        if node not in found:
            found.add(node)
            operation, left, right = recorder.nodes[node]
            ahead.extend((left, right) if operation >= 0 else ())
    return sorted(found)


def _last_uses(recorder: Recorder, needed: list[int], wanted: list[int]) -> dict[int, int]:
    last: dict[int, int] = {}
    for node in needed:
        operation, left, right = recorder.nodes[node]
        if operation >= 0:
            last[left] = last[right] = node
    return last | dict.fromkeys(wanted, len(recorder.nodes))


def evaluated(tape: Tape, inputs: dict[int, Any]) -> list[Any]:
    """Return the outputs of a tape for numbers or arrays, in plain numpy: what the compiled interpreter is held to."""
    own: list[Any] = [0.0] * tape.registers
    for seed, register in tape.inputs:
        own[register] = inputs[seed]
    for register, value in tape.constants:
        own[register] = value
    for operation, target, left, right in tape.code.tolist():
        own[target] = computed(operation, own[left], own[right])
    return [own[register] for register in tape.outputs]
