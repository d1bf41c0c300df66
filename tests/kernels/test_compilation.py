"""The options of compilation: results are those of numpy, and callees give entries their code."""

import pytest

from optloc.kernels.compilation import callee_compiler, callee_library, options
from optloc.kernels.jit import enabled

numba = pytest.importorskip("numba")
pytestmark = pytest.mark.skipif(not enabled(), reason="without numba nothing is compiled")


def test_an_entry_can_be_called_from_python_and_a_callee_ends_before_translation():
    entry, callee = (options(callee=callee, taken_in=False) for callee in (False, True))
    assert entry == {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "forceinline": False}
    assert callee == entry | {"no_cpython_wrapper": True, "pipeline_class": callee_compiler()}
    assert options(callee=False, taken_in=True)["forceinline"]


def test_a_callee_has_no_address_and_an_entry_that_calls_it_divides_as_numpy_does():
    ratio = numba.njit(**options(callee=True, taken_in=False))(lambda a, b: a / b)
    entry = numba.njit(**options(callee=False, taken_in=False))(lambda a, b: 2.0 * ratio(a, b))
    assert entry(1.0, 0.0) == float("inf")
    assert entry(3.0, 4.0) == 1.5
    (made,) = ratio.overloads.values()
    assert isinstance(made.library, callee_library())
    assert made.library.get_pointer_to_function("any") == 0
