"""Locks of state files: one owner, released when its process dies."""

import subprocess
import sys

import pytest
from service.lines import Answers, site_in

from optloc.problem import InvalidProblem
from optloc.service.site import FAST
from optloc.service.state_lock import StateLock
from optloc.service.stream import Settings, Stream

HOLD = """
import sys, time
from pathlib import Path
from optloc.service.state_lock import StateLock
lock = StateLock(Path(sys.argv[1]))
print("locked", flush=True)
time.sleep(60)
"""


def test_a_second_owner_is_refused_until_the_first_releases(tmp_path):
    path = tmp_path / "s.state"
    first = StateLock(path)
    with pytest.raises(InvalidProblem, match=r"s\.state: another process uses this state file; stop the other process"):
        StateLock(path)
    first.release()
    StateLock(path).release()
    assert list(tmp_path.iterdir()) == []


def test_the_death_of_a_process_releases_its_lock(tmp_path):
    path = tmp_path / "s.state"
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(path)], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"locked\n"
    with pytest.raises(InvalidProblem, match="another process uses"):
        StateLock(path)
    process.kill()
    process.wait(20.0)
    assert (tmp_path / "s.state.lock").exists()
    StateLock(path).release()


def test_a_lock_file_that_cannot_be_made_is_one_sentence(tmp_path):
    with pytest.raises(InvalidProblem, match=r"the lock file s\.state\.lock cannot be made"):
        StateLock(tmp_path / "none" / "s.state")


def test_a_second_stream_with_a_state_is_refused(tmp_path):
    site, path = site_in(tmp_path, method=FAST), tmp_path / "s.state"
    stream = Stream(site, Settings(phases="fix", state=path), Answers())
    before = path.read_bytes()
    with pytest.raises(InvalidProblem, match="another process uses this state file"):
        Stream(site, Settings(phases="fix", state=path, record=tmp_path / "r"), Answers())
    assert path.read_bytes() == before
    stream.close()
    assert stream.ended.wait(10.0)
    assert {each.name for each in tmp_path.iterdir()} == {"site.toml", "s.state"}
