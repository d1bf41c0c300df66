"""Several tapes in one table, against the functions that they were recorded of."""

import numpy as np

from optloc.kernels.jit import plain
from optloc.kernels.tape_table import CODE, INPUT, OUTPUT, run_tape, tape_table
from optloc.kernels.trace import Recorder, tape

FUNCTIONS = (
    (lambda u, v: 3.0 * u - v / 7.0, 2),
    (lambda u: np.sqrt(u) + 2.5, 1),
    (lambda u, v, w: np.arctan2(u, v) * np.exp(-w), 3),
)


def recorded(function, count):
    recorder = Recorder()
    return tape(recorder, [function(*(recorder.input(i) for i in range(count)))])


def test_each_tape_of_a_table_gives_what_its_function_does():
    tapes = [recorded(*each) for each in FUNCTIONS]
    table = tape_table(tapes, [one.outputs for one in tapes])
    inputs = np.random.default_rng(1).uniform(0.5, 4.0, (3, 5))
    for k, (function, count) in enumerate(FUNCTIONS):
        r = np.full((table.registers, 6), np.nan)
        for line in table.table[table.table[k, INPUT] : table.table[k + 1, INPUT]]:
            r[line[0], :5] = inputs[line[1]]
        with plain():
            run_tape(table, k, r, 5)
        (output,) = table.table[table.table[k, OUTPUT] : table.table[k + 1, OUTPUT], 0]
        np.testing.assert_allclose(r[output, :5], function(*inputs[:count]), rtol=1e-15)
        assert np.isnan(r[output, 5])


def test_outputs_that_are_zero_have_no_register_and_no_tapes_are_a_table_too():
    one = recorded(*FUNCTIONS[1])
    table = tape_table([one], [(-1, *one.outputs)])
    assert table.table[table.table[0, OUTPUT] :, 0].tolist() == [-1, *one.outputs]
    empty = tape_table([], [])
    assert (empty.registers, len(empty.value), empty.table[0, CODE]) == (1, 0, 1)
