"""What every foreign table becomes: rows of arrivals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Measured:
    """The columns (m,) of a measurements table, their unit, what they are, and what had to be assumed."""

    columns: Mapping[str, Any]
    unit: str
    comment: str
    notes: tuple[str, ...] = ()
