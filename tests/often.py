"""What every run tests of a long list, and what only full runs do."""

from collections.abc import Iterable
from typing import Any

import pytest


def few(values: Iterable[Any], count: int) -> list[Any]:
    """Return values of one parameter, of which all but the first few stand behind ``-m full``."""
    return [value if i < count else pytest.param(value, marks=pytest.mark.full) for i, value in enumerate(values)]
