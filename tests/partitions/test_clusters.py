"""Clusters: one that does not reply is one sentence."""

import pytest

from optloc import InvalidProblem
from optloc.partitions import clusters


def test_an_unreachable_scheduler_is_one_sentence(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(clusters, "CONNECT", 1.0)
    text = r"tcp://127\.0\.0\.1:1: the scheduler cannot be reached"
    with pytest.raises(InvalidProblem, match=text), clusters.dask_client("tcp://127.0.0.1:1", 1):
        pass
