"""The environment of workers that tests of partitions share."""

import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def importable(monkeypatch):
    """Let workers import functions of test modules: Dask's get the path of this process, and Ray's the environment."""
    paths = [*sys.path, str(ROOT)]
    monkeypatch.setattr(sys, "path", paths)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
