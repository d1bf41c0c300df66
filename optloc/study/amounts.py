"""Amounts of a study file as numbers."""

from __future__ import annotations

import numpy as np

from optloc.errors import InvalidProblem
from optloc.files.words import Units
from optloc.models import MODELS
from optloc.study.document import Amount


def sigma_of(kind: str, amount: Amount, where: str) -> float:
    """Return a standard deviation of rows of a kind in SI units; of ratios in decibels, at a ratio of one."""
    quantity = MODELS[kind].quantity
    units = Units(quantity)  # type: ignore[arg-type]  # models hold known quantities only
    number, unit = units.amount(amount, None if isinstance(amount, str) else units.conversion(None, where), where)
    value = float(unit.sigma_to_si(number, np.ones(()))) if unit.logarithmic else abs(unit.factor) * number
    if not value > 0.0:
        raise InvalidProblem(f"{amount!r} is not positive", where, "give a positive standard deviation")
    return value
