"""What every run tests of a long list, and what only full runs do."""

from collections.abc import Iterable
from typing import Any

import pytest


def few(values: Iterable[Any], count: int, names: int = 1) -> list[Any]:
    """Return values of a parameter, or of several, of which all but the first few stand behind ``-m full``."""
    each = [value if names > 1 else (value,) for value in values]
    return [pytest.param(*value, marks=[] if i < count else [pytest.mark.full]) for i, value in enumerate(each)]
