"""The memory of blocks, and answers by name."""

import numpy as np
import pytest
from cases import CASES
from engine.blocks import block_of

from optloc.engine import memory, ranges
from optloc.engine.memory import Answer, EngineResult
from optloc.engine.plan import blank_answer


def test_columns_of_answers_have_the_order_of_their_names():
    answer = blank_answer(2, 3, 5, 4, 2)
    answer.number[:] = [EngineResult(1.0, 2.0, 1.0, 4.0, 0.1, 0.2), EngineResult(1.5, 2.5, 0.0, 4.5, 0.3, np.nan)]
    assert answer.cost.tolist() == [1.0, 1.5]
    assert answer.rival_cost.tolist() == [2.0, 2.5]
    assert answer.settled.tolist() == [True, False]
    assert answer.infinity.tolist() == [4.0, 4.5]
    assert answer.kappa[0].tolist() == [0.1, 0.2]
    answer.side[:] = np.arange(5.0)
    assert (answer.multiplier == 0.0).all()
    assert (answer.quantity == 1.0).all()
    assert answer.normal[1, 1].tolist() == [2.0, 3.0, 4.0]
    assert [array.shape for array in answer] == [(2, 5), (2, 4, 4), (2, 5), (2, 6), (2, 2, 5)]
    assert isinstance(answer, Answer)


@pytest.mark.usefixtures("in_python")
def test_a_room_has_a_row_for_every_name():
    room = block_of(CASES["tdoa-3d"].problem, ranges).room
    rows = {
        "vector": (memory.X, memory.OTHER),
        "matrix": (memory.H, memory.REST),
        "axes": (memory.BASE, memory.EIGEN),
        "scalar": (memory.COST, memory.RADIUS),
        "side": (memory.LOWER_BOUND, memory.BOUNDED),
    }
    for name, (first, last) in rows.items():
        assert (first, last + 1) == (0, len(getattr(room, name)))
    assert room.place.shape == (7, 3, 1)
    assert room.rows.shape == room.squared.shape == (7, 5, 1)
