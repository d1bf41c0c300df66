"""What all tests share: where the real data is, and reproducible property tests."""

import os
from pathlib import Path

import hypothesis
import pytest

ROOT = Path(__file__).resolve().parents[1]
DATA_DEFAULT = ROOT.parent / "shared" / "data"

# Seeded: a property that fails, fails again; compiled functions make first calls slow.
hypothesis.settings.register_profile("optloc", derandomize=True, deadline=None)
hypothesis.settings.load_profile("optloc")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of the real data sets."""
    folder = Path(os.environ.get("OPTLOC_DATA", DATA_DEFAULT))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set OPTLOC_DATA to its folder")
    return folder
