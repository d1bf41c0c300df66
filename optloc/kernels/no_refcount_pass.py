"""A compiler pass that removes reference counts of arrays from functions that make, store and return no array.

numba counts the references to an array at each assignment, also of a field of a record or a slice. It uses atomic
operations, which took more time than the arithmetic in a function of a dozen arrays and few sums. A caller holds all
arguments until the function returns. So a function that makes, stores and returns no array only borrows its arguments,
and needs no counts. In proofs, counting took half of the time.
"""

from __future__ import annotations

from functools import cache
from typing import Any

# Operations that name an array without making one: fields, slices, tuples and loops of the arguments.
_BORROWS = {
    "getattr",
    "getitem",
    "static_getitem",
    "typed_getitem",
    "cast",
    "phi",
    "build_tuple",
    "exhaust_iter",
    "getiter",
    "iternext",
    "pair_first",
    "pair_second",
}


@cache
def borrowing() -> Any:
    """Return numba's pass that compiles functions that only borrow arrays without reference counts."""
    from numba.core import compiler_machinery

    numba: Any = compiler_machinery  # without types

    @numba.register_pass(mutates_CFG=False, analysis_only=False)
    class Borrowing(numba.LoweringPass):  # type: ignore[misc]
        _name = "optloc_borrowing"

        def __init__(self) -> None:
            numba.LoweringPass.__init__(self)

        def run_pass(self, state: Any) -> bool:
            if not only_borrows(state):
                return False
            state.targetctx = state.targetctx.subtarget(enable_nrt=False)
            return True

    return Borrowing


def only_borrows(state: Any) -> bool:
    """Return whether a function with inferred types makes, stores and returns no arrays."""
    from numba.core import types

    models, numba = state.targetctx.data_model_manager, types

    def is_counted(kind: Any) -> bool:
        return bool(models[kind].contains_nrt_meminfo())

    plain = (numba.Array, numba.BaseTuple, numba.IteratorType)
    if is_counted(state.return_type) or any(
        is_counted(kind) and not isinstance(kind, plain) for kind in state.typemap.values()
    ):
        return False  # a list stores its items
    statements = [one for block in state.func_ir.blocks.values() for one in block.body]
    return not any(_makes_or_keeps(one, state.typemap, is_counted) for one in statements)


def _makes_or_keeps(statement: Any, types: Any, is_counted: Any) -> bool:
    from numba.core import ir

    if isinstance(statement, ir.SetItem | ir.StaticSetItem):
        return bool(is_counted(types[statement.value.name]))
    if isinstance(statement, ir.SetAttr | ir.StoreMap):
        return True
    if not (isinstance(statement, ir.Assign) and isinstance(statement.value, ir.Expr)):
        return False
    made = statement.value
    if not is_counted(types[statement.target.name]):
        return False
    # An array as an index selects elements, which makes a new array.
    picks = made.op == "getitem" and is_counted(types[made.index.name])
    return picks or made.op not in _BORROWS
