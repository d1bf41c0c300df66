"""The process of a service: exit codes, threads and locks after a refusal, and the environment."""

import os
import sys
import threading
from threading import Event as Flag
from types import SimpleNamespace

import pytest
from service.lines import line, site_in
from typer.testing import CliRunner

from optloc import InvalidProblem
from optloc.cli import app
from optloc.service.adapters import adapter_of
from optloc.service.process import _stream_environment, wait


def test_a_stream_ends_with_the_code_of_what_ended_it():
    ended, not_set, pressed = Flag(), Flag(), Flag()
    ended.set()
    pressed.set()
    sources, broken = SimpleNamespace(failed=[]), SimpleNamespace(failed=["mqtt"])
    good = SimpleNamespace(ended=ended, error=None, failed=False, sources=sources)
    gone = SimpleNamespace(ended=ended, error=None, failed=True, sources=sources)
    lost = SimpleNamespace(ended=ended, error=None, failed=False, sources=broken)
    assert wait(good, not_set) == 0
    assert wait(lost, not_set) == 3
    assert len({wait(each, not_set) for each in (good, gone, lost)} | {wait(lost, pressed)}) == 4
    with pytest.raises(InvalidProblem, match="the site"):
        wait(SimpleNamespace(ended=ended, error=InvalidProblem("the site is gone", None, ""), failed=False), not_set)


def test_the_environment_of_a_stream_ends_with_it(monkeypatch):
    monkeypatch.delenv("OPTLOC_THREADS", raising=False)
    monkeypatch.setenv("OPTLOC_COMPILE", "wait")
    before = sys.getswitchinterval()
    with _stream_environment():
        assert (os.environ["OPTLOC_THREADS"], os.environ["OPTLOC_COMPILE"]) == ("1", "wait")
        assert sys.getswitchinterval() < before
    assert "OPTLOC_THREADS" not in os.environ
    assert sys.getswitchinterval() == before


def test_unknown_formats_and_addresses_are_one_sentence(tmp_path):
    site_in(tmp_path)
    for words, said in (
        (["--adapter", "chirpstak"], "did you mean 'chirpstack'?"),
        (["--http", "port"], "'port' is not a port"),
        (["--mqtt", "x"], "is not an address of a topic"),
    ):
        result = CliRunner().invoke(app, ["live", str(tmp_path / "site.toml"), *words])
        assert (result.exit_code, len(result.output.splitlines())) == (2, 1), result.output
        assert said in result.output
    with pytest.raises(InvalidProblem):
        adapter_of("none", ())


REFUSED = (
    (["--state", "s.state", "--http", "port"], "'port' is not a port"),
    (["--state", "s.state", "--mqtt", "x"], "is not an address of a topic"),
    (["--state", "s.state", "--http", "0", "--zmq", "nonsense"], "'nonsense' cannot be used"),
    (["--state", "s.state", "--track", "--partition", "1/2"], "this process answers a part of the events"),
    (["--state", "damaged"], "this is not a checkpoint"),
    (["--state", "s.state", "--record", "no-such-folder/r.ndjson"], "no-such-folder"),
)


@pytest.mark.parametrize(("words", "said"), REFUSED, ids=[words[-1] for words, _ in REFUSED])
def test_a_refused_command_leaves_neither_threads_nor_a_locked_state(tmp_path, monkeypatch, words, said):
    for name in ("paho.mqtt.client", "zmq", "uvicorn", "starlette"):
        pytest.importorskip(name)
    site_in(tmp_path)
    (tmp_path / "damaged").write_text("[1]")
    monkeypatch.chdir(tmp_path)
    before = set(threading.enumerate())
    result = CliRunner().invoke(app, ["live", "site.toml", *words])
    assert set(threading.enumerate()) <= before
    assert (result.exit_code, len(result.output.splitlines())) == (2, 1), result.output
    assert said in result.output
    assert not list(tmp_path.glob("*.lock"))


def test_a_command_that_ends_leaves_no_threads(tmp_path, monkeypatch):
    for name in ("uvicorn", "starlette"):
        pytest.importorskip(name)
    site_in(tmp_path)
    monkeypatch.chdir(tmp_path)
    before = set(threading.enumerate())
    words = ["live", "site.toml", "--http", "0", "--state", "s.state", "--record", "r.ndjson"]
    result = CliRunner().invoke(app, words, line(event="1", z=[1.0] * 5) + b"\n")
    assert set(threading.enumerate()) <= before
    assert (result.exit_code, result.stdout.count('"event":"1"')) == (0, 2), result.output
