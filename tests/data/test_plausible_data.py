"""Physical checks of values on measured data: no data set causes a sentence, and no value is refused.

The checks sample 64 groups of rows, so the epochs of each set are also checked in blocks of 64.
"""

import numpy as np
import pytest
from data.test_real import SETS

from optloc import datasets
from optloc.model_checks import refuse_impossible, suspicious_values
from optloc.model_checks.elements import batch_of

pytestmark = [pytest.mark.data, pytest.mark.slow]

BLOCK = 64
# Blocks of a set: long sets are sampled evenly.
MOST = 200


@pytest.mark.parametrize("name", SETS)
def test_measured_values_cause_no_sentence(name, data_dir):
    guard = SETS[name]
    problem = datasets.load(guard.name, folder=data_dir, **guard.options).problem
    refuse_impossible(problem, lambda number: f"row {number}", "python")
    assert suspicious_values(problem) == ()
    batch = batch_of(problem)
    starts = np.arange(0, batch.batch_shape[0], BLOCK)
    chosen = starts[np.unique(np.linspace(0, len(starts) - 1, min(len(starts), MOST)).astype(int))]
    blocks = [batch.take(np.arange(first, min(first + BLOCK, batch.batch_shape[0]))) for first in chosen]
    assert [one for block in blocks for one in suspicious_values(block)] == []
