"""How tests of pieces of proofs run them."""

from contextlib import nullcontext

import numpy as np
import pytest

from optloc.kernels.jit import plain


@pytest.fixture(params=["plain", pytest.param("machine", marks=pytest.mark.full)])
def form(request):
    """Run a piece as the Python that it is, and in full as machine code, which is made for these tests alone."""
    # numbers beyond all, and none, are numbers to machine code
    with plain() if request.param == "plain" else nullcontext(), np.errstate(all="ignore"):
        yield request.param


@pytest.fixture
def plainly():
    """Run a piece as the Python that it is, in every run."""
    with plain(), np.errstate(all="ignore"):
        yield
