"""How often kernels are compiled that other kernels call."""

from __future__ import annotations

import pytest

from optloc.kernels import jit
from optloc.kernels.jit import Constant, compiled, enabled, specialise

pytestmark = pytest.mark.skipif(not enabled(), reason="without numba nothing is compiled")
WIDTH, UNIT = 3, 1.0


@compiled
def _scaled(value: float, times: int, negative: bool) -> float:
    return -times * value if negative else times * value


@compiled
def _repeated(value: float, times: Constant) -> float:
    total = 0.0
    for _ in range(times):
        total += UNIT * value
    return total


@compiled
def _mixed(value: float, times: int) -> float:
    return _scaled(value, 2, False) + _scaled(value, 3, True) + _scaled(value, times, value > 0.0)


@compiled
def _repeatedly(value: float, times: int) -> float:
    return _repeated(value, WIDTH) + _repeated(value, times)


@pytest.fixture(autouse=True)
def nothing_is_kept(monkeypatch):
    """Machine code on disk would leave nothing to compile."""
    monkeypatch.setattr(jit, "code_cache_of", lambda kernel, *, callee: None)
    for kernel in (_scaled, _repeated, _mixed, _repeatedly):
        kernel.renew()


def forms(kernel):
    return kernel._form(callee=True).signatures


def test_constants_in_calls_need_no_form_of_their_own():
    assert _mixed(1.5, 4) == 2 * 1.5 - 3 * 1.5 - 4 * 1.5
    assert len(forms(_scaled)) == 1


def test_constants_for_which_an_argument_asks_have_a_form_of_their_own():
    assert _repeatedly(1.5, 4) == 7 * 1.5
    assert len(forms(_repeated)) == 2


def test_kernels_with_other_constants_ask_for_the_same():
    wide = specialise(_repeatedly, "wide", WIDTH=5, UNIT=2.0)
    assert wide(1.5, 4) == 18 * 1.5
    (copy,) = (kernel for kernel in jit._KERNELS if kernel.name.endswith("._repeated_UNIT_2_0"))
    assert {str(kinds[1]) for kinds in forms(copy)} == {"int64", "Literal[int](5)"}


def test_what_differs_by_constants_alone_is_one_kernel_for_all_that_call_it():
    count = len(jit._KERNELS)
    one, other = (specialise(_repeatedly, mark, WIDTH=7) for mark in ("one", "other"))
    assert one is other
    assert len(jit._KERNELS) == count + 1
