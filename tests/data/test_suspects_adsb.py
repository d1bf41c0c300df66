"""Airliners' messages: the stations that are accused in every other message are those accused in the rest."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from optloc import solve
from optloc.lab.datasets import adsb

pytestmark = pytest.mark.data
HEARD = 5


@pytest.mark.full
def test_the_same_stations_are_accused_in_odd_and_even_messages(data_dir):
    messages = adsb.heard(data_dir / "locards_adsb", refraction=True)
    fix = solve(messages.problem("row"), "robust")
    _, station = np.unique(messages.stations.reshape(-1, 3), axis=0, return_inverse=True)
    station = station.reshape(-1, HEARD)
    heard, accused = (np.zeros((2, station.max() + 1)) for _ in range(2))
    for i, who in enumerate(station):
        heard[i % 2, who] += 1.0
        for explanation in fix.explanations[i] or ():
            rows = [row for suspect in explanation.suspects for row in suspect.rows if row < HEARD]
            accused[i % 2, who[rows]] += 1.0 / len(fix.explanations[i])
    often = (heard >= 25).all(0)
    accused, heard = accused[:, often], heard[:, often]
    share, pooled = accused / heard, accused.sum(0) / heard.sum(0)
    assert accused.sum() > 30.0
    assert spearmanr(*share).statistic > 0.6
    spread = np.sqrt(pooled * (1.0 - pooled) * (1.0 / heard).sum(0))
    apart = (share[0] - share[1])[spread > 0.0] / spread[spread > 0.0]
    assert np.sqrt(np.mean(apart**2)) < 1.5
