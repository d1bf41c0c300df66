"""Tapes against the functions they were traced from, for numbers and for derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from cases import CASES, kitchen_sink, random_vector

from optloc.kernels.trace import OPERATIONS, Recorder, Symbol, evaluate, operate, tape, trace
from optloc.linear.evaluate import block_links, given, points
from optloc.models import MODELS
from optloc.models.primitives import Jet, namespace

SINKS = {f"sink-{d}d-{span}": kitchen_sink(d, span) for d in (2, 3) for span in ("epoch", "run")}
PROBLEMS = {name: (case.problem, case.truth + 11.0) for name, case in CASES.items()}
PROBLEMS |= {name: (problem, random_vector(problem)) for name, problem in SINKS.items()}


def tapes(problem):
    for links in block_links(problem):
        inputs = given(problem, links)
        yield links, inputs, trace(problem, links, frozenset(inputs), frozenset(feed.seed for feed in links.feeds))


def recorded(function, *names):
    """The tape of a function of some inputs, numbered from zero."""
    recorder = Recorder()
    return tape(recorder, [function(*(recorder.input(i) for i in range(len(names))))])


@pytest.mark.parametrize("name", PROBLEMS)
def test_value_and_derivatives_are_those_of_the_jets(name):
    problem, x = PROBLEMS[name]
    for links, inputs, found in tapes(problem):
        t, a, b = points(problem, links, x, differentiate=True)
        jet = links.model.h(t, a, b)
        parts = jet.partials if isinstance(jet, Jet) else {}
        for feed in links.feeds:  # the inputs as the jets had them
            full = np.zeros(links.block.count)
            full[feed.rows] = x[feed.column] * feed.gain
            inputs[feed.seed] = inputs.get(feed.seed, 0.0) + full
        value, *partials = evaluate(found.tape, inputs)
        size = np.abs(jet.value) + (6.4e6 if links.model.ecef else 1.0)
        assert (np.abs(value - jet.value) <= 1e-13 * size).all()
        nonzero = {seed for seed, part in parts.items() if np.any(part)}
        assert nonzero <= set(found.seeds)
        for seed, partial in zip(found.seeds, partials, strict=True):
            assert np.allclose(partial, parts[seed], rtol=1e-12, atol=1e-12 * np.abs(parts[seed]).max())


def test_the_tape_of_a_range_difference_is_short():
    """Two ranges with their derivatives: shared parts once, no product with one or sum with zero."""
    problem = CASES["tdoa-3d"].problem
    (_, _, found), *_ = tapes(problem)
    assert len(found.tape.code) == 30
    assert found.tape.registers <= 13


@pytest.mark.parametrize("name", OPERATIONS)
def test_every_operation(name):
    operation = OPERATIONS.index(name)
    u, v = np.array([0.3, 1.7, 2.0]), np.array([1.1, 0.4, 3.0])
    found = recorded(lambda p, q: p.recorder.apply(operation, p, q), "u", "v")
    assert np.array_equal(evaluate(found, {0: u, 1: v})[0], operate(operation, u, v))
    folded = Recorder()
    constant = folded.apply(operation, 0.3, 1.1)
    assert folded.constant(constant.node) == operate(operation, 0.3, 1.1)


@pytest.mark.parametrize(
    "function",
    [
        lambda u, v: (u + 0.0) * 1.0 - (0.0 - v),
        lambda u, v: -(u - v) + (-u) * (-v) / (-1.0),
        lambda u, v: (u + u) * (0.5 / v) + 3.0 / (-v),
        lambda u, v: np.sqrt(u) * np.float64(2.0) - np.hypot(u, 1.0) + np.arctan2(v, u),
        lambda u, v: u * 0.0 + v - (u + (-v)),
    ],
)
def test_what_is_simplified_gives_the_same_number_to_the_last_bit(function):
    rng = np.random.default_rng(3)
    u, v = rng.uniform(0.1, 1e7, (2, 200))
    assert np.array_equal(evaluate(recorded(function, "u", "v"), {0: u, 1: v})[0], function(u, v))


def test_registers_are_used_again_but_never_by_the_operation_that_reads_them():
    for problem, _ in PROBLEMS.values():
        for _, _, found in tapes(problem):
            _, target, left, right = found.tape.code.T
            assert (target != left).all()
            assert (target != right).all()
            assert found.tape.registers < 100
            assert len(set(found.tape.outputs)) == len(found.tape.outputs)


def test_a_symbol_finds_its_functions_and_refuses_tests():
    symbol = Recorder().input(0)
    assert isinstance(namespace(symbol).sqrt(symbol), Symbol)
    with pytest.raises(TypeError, match="branch"):
        bool(symbol)


def test_a_function_that_asks_for_more_is_left_to_numpy(monkeypatch):
    def branching(t, a, b):
        return t.position[0] if t.position[0] > 0 else -t.position[0]

    monkeypatch.setitem(MODELS, "odd", replace(MODELS["range"], h=branching, ranges=None))
    problem = CASES["range-3d"].problem
    odd = replace(problem, rows=(replace(problem.rows[0], kind="odd"),))
    assert [found for _, _, found in tapes(odd)] == [None]
