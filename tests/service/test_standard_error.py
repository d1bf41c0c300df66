"""Standard error of a service: a reader that does not read stops nothing, and all texts go through one queue."""

import io
import json
import logging
import os
import subprocess
import sys
import threading

import pytest
from service.lines import line, site_in

from optloc.service.standard_error import standard_error


def test_lines_warnings_and_the_log_go_through_one_queue(monkeypatch):
    file = io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    log, handler = logging.getLogger("optloc"), logging.StreamHandler(file)
    monkeypatch.setattr(log, "handlers", [handler])
    with standard_error() as (say, output):
        say("a line\x1b[2J")
        log.warning("a warning")
        sys.stderr.write("a print\n")
        assert not sys.stderr.isatty()
    assert sys.stderr is file
    assert handler.stream is file
    assert file.getvalue().splitlines() == ["a line\\x1b[2J", "a warning", "a print"]
    assert output.dropped == 0


def test_a_quiet_service_prints_warnings_only(monkeypatch):
    file = io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    with standard_error(quiet=True) as (say, _):
        say("health")
        sys.stderr.write("a warning\n")
    assert file.getvalue() == "a warning\n"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="pipes of Windows differ")
def test_a_stream_goes_on_when_nobody_reads_standard_error(tmp_path):
    """With the format nmea each refused line is a line of standard error: 20 000 of them exceed pipe and queue."""
    site_in(tmp_path)
    words = [sys.executable, "-m", "optloc.cli", "live", "site.toml", "--phases", "fix", "--format", "nmea"]
    process = subprocess.Popen(
        words, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    threading.Thread(target=process.stdout.read, daemon=True).start()
    process.stdin.write(b"nonsense that is longer than a few bytes\n" * 20_000)
    process.stdin.write(line(event="1", z=[1.0] * 5) + b"\n")
    process.stdin.close()
    assert process.wait(120.0) == 0
    # texts that fit neither in the pipe nor in the queue were dropped
    os.set_blocking(process.stderr.fileno(), False)
    said = process.stderr.read().splitlines()
    assert said[0].startswith(b"ready: ")
    assert 100 < len(said) < 2000
    assert "error" in json.loads(said[1])
