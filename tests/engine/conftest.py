"""What tests of single steps of the engine share."""

import pytest

from optloc.kernels.jit import plain


@pytest.fixture
def in_python():
    """Run kernels as plain Python: nothing is compiled."""
    with plain():
        yield
