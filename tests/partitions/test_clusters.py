"""Clusters: one that does not reply is one sentence, and local workers keep the memory that they use again."""

import gc
import os

import pytest

from optloc import InvalidProblem
from optloc.partitions import clusters


def test_an_unreachable_scheduler_is_one_sentence(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(clusters, "CONNECT", 1.0)
    text = r"tcp://127\.0\.0\.1:1: the scheduler cannot be reached"
    with pytest.raises(InvalidProblem, match=text), clusters.dask_client("tcp://127.0.0.1:1", 1):
        pass


def settings(_):
    import dask

    variable = os.environ.get("MALLOC_TRIM_THRESHOLD_")
    return variable, dask.config.get("distributed.worker.profile.enabled"), gc.get_threshold()[0]


@pytest.mark.slow
def test_local_workers_do_not_return_memory_after_each_array(monkeypatch, importable):
    """Otherwise fixes take 1.3 times as long. The settings of the program do not change."""
    pytest.importorskip("distributed")
    import dask

    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
    before = dask.config.get("distributed.nanny.pre-spawn-environ")
    with clusters.dask_client(None, 1) as client:
        assert client.submit(settings, 0).result() == (None, False, 50_000)
    assert dask.config.get("distributed.nanny.pre-spawn-environ") == before
    assert dask.config.get("distributed.worker.profile.enabled")
