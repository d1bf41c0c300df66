"""Every sentence that inputs of the trades cause has at most 200 characters, and names the next step."""

import os
from pathlib import Path

import pytest
from trades.broken import GOOD, broken
from trades.messages import flaws, messages, names_step
from typer.testing import CliRunner

from optloc.cli import app

CASES = [*(make() for make in GOOD), *broken()]
