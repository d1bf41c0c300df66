"""Methods that raise, exit, crash, hang, eat memory or answer nonsense: the study is complete, and each is named."""

import os
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
from lab.study.texts import assert_identical, design, run_here
from progress import without_progress
from recipes import installed, write_package

from optloc.base.errors import InvalidProblem
from optloc.lab.study import worker_process
from optloc.lab.study.execute import executor, run_design
from optloc.lab.study.folder import read_frame
from optloc.lab.study.trial import DIED, FAILED, INVALID, LATE

FULL = pytest.mark.full
HEAD = """
import ctypes, os, signal, subprocess, sys, threading, time
from dataclasses import replace
import numpy as np
from optloc.base.errors import InvalidProblem
from optloc.lab.study.baselines import BASELINES, Baseline

def good(drawn, start):
    return BASELINES["truth"].run(drawn, start)

def baseline(run):
    return Baseline(run, "misbehaves", guess=False)
"""
# Status, words of the reason, and what the method does; all do so at every trial.
ROGUES = {
    "raise": (DIED, "ZeroDivisionError", "1 / 0"),
    "complain": (DIED, "InvalidProblem: such: no", "raise InvalidProblem('no', 'such', 'luck')"),
    "sys-exit": (DIED, "SystemExit: 3", "sys.exit(3)"),
    "exit": (DIED, "exit code 3", "os._exit(3)"),
    "exit-well": (DIED, "exit code 0", "os._exit(0)"),
    "segfault": (DIED, "signal 11", "ctypes.string_at(0)"),
    "kill": (DIED, "signal 9", "os.kill(os.getpid(), signal.SIGKILL)"),
    "interrupt": (DIED, "", "raise KeyboardInterrupt"),
    "none": (INVALID, "NoneType", "return None"),
    "nan": (INVALID, "estimate is not finite", "return replace(f, x=np.full_like(f.x, np.nan, dtype=float))"),
    "cov-nan": (INVALID, "covariance is not finite", "return replace(f, cov=np.full_like(f.cov, np.nan))"),
    "negative": (INVALID, "negative", "return replace(f, cov=-f.cov)"),
    "indefinite": (INVALID, "semidefinite", "return replace(f, cov=f.cov * np.where(np.eye(3) > 0.0, 1.0, 9.0))"),
    "lopsided": (INVALID, "symmetric", "return replace(f, cov=f.cov * (1.0 + np.triu(np.ones((3, 3)), 1)))"),
    "shape": (INVALID, "x is float64", "return replace(f, x=f.x[:, :2])"),
    "few": (INVALID, "its x is", "return replace(f, x=f.x[:0])"),
    "kind": (INVALID, "complex128", "return replace(f, x=f.x + 1j)"),
    "status": (INVALID, "status is unknown", "return replace(f, code=f.code + 99)"),
    "garbage": (DIED, "", "[os.write(i, b'x' * 99) for i in range(3, 30) if os.path.exists(f'/dev/fd/{i}')]"),
    "memory": (DIED, "MemoryError", "np.ones((1 << 40) // 8)"),
    "small-memory": (DIED, "MemoryError", "b = [bytearray(1 << 26) for _ in range(1 << 14)]"),
}
# These hold up a process until its limit, or leave something behind.
HANGING = {
    "sleep": (LATE, "more than", "time.sleep(1e6)"),
    "deaf": (LATE, "more than", "ctypes.PyDLL(None).sleep(10**6)"),
    "spawn": (LATE, "more than", "subprocess.run([sys.executable, '-c', 'import time; time.sleep(1e6)'])"),
}
STUDY = """
format = 1
name = "rogues"
trials = {trials}
[[scenario]]
name = "six"
layout = {{ stations = 6, kinds = ["toa"] }}
truth = {{ kind = "hull" }}
noise = ["3 m"]
[[method]]
method = "gtrs+lsr"
chunk = 2
[[method]]
baseline = {names}
chunk = 2
"""


def study(names, trials=3):
    return STUDY.format(names=str(list(names)).replace("'", '"'), trials=trials)


@pytest.fixture(scope="module", autouse=True)
def package(tmp_path_factory):
    """Install a package of methods that misbehave."""
    folder, text = tmp_path_factory.mktemp("rogues"), HEAD
    for name, (_, _, body) in {**ROGUES, **HANGING}.items():
        function = name.replace("-", "_") + "_"
        text += f"\ndef {function}(drawn, start):\n    f = good(drawn, start)\n    {body}\n    return f\n"
        text += f"\n{function}entry = baseline({function})\n"
    text += textwrap.dedent("""
        def once_(drawn, start):
            if (abs(drawn.truth[:, 0] - float(os.environ["BAD_TRIAL"])) < 1e-9).any():
                HOW[os.environ["BAD_WAY"]]()
            return good(drawn, start)

        def fork_(drawn, start):
            os.fork()
            return good(drawn, start)

        def hoard_(drawn, start):
            try:
                while True:
                    KEPT.append(bytearray(1 << 20))
            finally:
                KEPT.pop()

        KEPT = []
        fork_entry, hoard_entry = baseline(fork_), baseline(hoard_)
        HOW = {"die": lambda: os.kill(os.getpid(), signal.SIGKILL), "hang": lambda: time.sleep(1e6)}
        once_entry = baseline(once_)
    """)
    entries = {name: f"rogues:{name.replace('-', '_')}_entry" for name in [*ROGUES, *HANGING, "once", "fork", "hoard"]}
    write_package(folder, {"rogues.py": text}, "rogues", {"optloc.baselines": entries})
    with installed(folder):
        yield folder


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is none on this system")
@pytest.mark.slow
def test_a_method_that_forks_answers_once(tmp_path):
    assert run_design(design(study(["fork"])), tmp_path / "out", executor("processes", 1)).counts == {"unproven": 6}


@FULL
def test_a_method_that_keeps_memory_harms_no_other(tmp_path, monkeypatch):
    monkeypatch.setattr(worker_process, "memory_of", lambda count: 3 << 30)
    found = run_design(design(study(["hoard"])), tmp_path / "out", executor("processes", 1))
    assert found.methods["gtrs+lsr", "unproven"] == 3
    assert found.methods["hoard", DIED] == 3


def check(folder, names):
    frame = read_frame(folder)
    assert set(frame["status"][frame["method"] == "gtrs+lsr"]) == {"unproven"}
    for name in names:
        status, words, _ = {**ROGUES, **HANGING}[name]
        own = frame[frame["method"] == name]
        assert set(own["status"]) == {status}, name
        assert own["reason"].astype(str).str.contains(words, regex=False).all(), (name, set(own["reason"]))
        assert not own["answered"].any()
        assert np.isfinite(own["truth_x"]).all()


@pytest.mark.parametrize(
    ("jobs", "some"),
    [
        (2, "few"),
        *(pytest.param(j, some, marks=FULL) for j in (1, 2) for some in ("answers", "processes")),
    ],
)
def test_methods_that_misbehave_are_named_and_the_study_goes_on(jobs, some, tmp_path, monkeypatch):
    # Little more than libraries reserve: what is asked for beyond is never touched.
    monkeypatch.setattr(worker_process, "memory_of", lambda count: 3 << 30)
    deadly = {"exit", "exit-well", "segfault", "kill", "interrupt", "garbage", "small-memory"}
    names = [name for name in ROGUES if (name in deadly) == (some == "processes")]
    names = ["raise", "nan", "segfault"] if some == "few" else names
    found = run_design(design(study(names, 1 if some == "few" else 3)), tmp_path / "out", executor("processes", jobs))
    assert found.complete
    check(tmp_path / "out", names)
    assert {method for method, _ in found.failures} == set(names)


@FULL
@pytest.mark.parametrize("jobs", [1, 2])
def test_methods_that_end_or_hold_up_their_process_are_named(jobs, tmp_path):
    names = ["segfault", "sleep"] if jobs == 1 else ["exit", "deaf"]
    found = run_design(design(study(names, trials=1)), tmp_path / "out", executor("processes", jobs, limit=3.0))
    assert found.complete
    check(tmp_path / "out", names)


@FULL
@pytest.mark.parametrize("jobs", [1, 2])
def test_all_that_hang_are_given_up_after_a_few_limits(jobs, tmp_path):
    names, limit = list(HANGING), 2.0
    began = time.monotonic()
    made = design(study(names, trials=40))
    found = run_design(made, tmp_path / "out", executor("processes", jobs, limit=limit))
    assert found.complete
    check(tmp_path / "out", names)
    # Four limits for each cell, those that were under way, and what processes take to begin.
    assert time.monotonic() - began < 15.0 + len(names) * (4 + jobs) * (limit + 1.5)
    assert any(reason.startswith("given up") for reason in read_frame(tmp_path / "out")["reason"].astype(str))


@FULL
@pytest.mark.parametrize("way", ["die", "hang"])
def test_of_many_trials_one_is_to_blame(way, tmp_path, monkeypatch):
    made = design(study(["once"], 8).replace("chunk = 2", "chunk = 4"))
    monkeypatch.setenv("BAD_WAY", way)
    monkeypatch.setenv("BAD_TRIAL", "0.0")
    whole = read_frame(run_here(made, tmp_path / "whole"))
    bad = (whole["method"] == "once") & (whole["trial"] == 5)
    monkeypatch.setenv("BAD_TRIAL", repr(float(whole["truth_x"][bad].item())))
    found = run_design(made, tmp_path / "out", executor("processes", 2, limit=3.0))
    assert found.complete
    table = read_frame(tmp_path / "out")
    lost = table["status"].isin(FAILED)
    assert (lost == bad).all()
    assert table["status"][lost].item() == (DIED if way == "die" else LATE)
    for name in ("seed", "trial", "truth_x", "crlb", "cost_truth", "chunk"):
        assert (table[name].astype(object) == whole[name].astype(object)).all(), name
    assert np.allclose(table["error"][~lost], whole["error"][~lost])


def test_a_process_that_cannot_begin_is_a_sentence_and_stores_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(worker_process, "_BEGIN", "import sys; sys.exit(7)")
    with pytest.raises(InvalidProblem, match=r"no process can be started \(its process ended with exit code 7\)"):
        run_design(design(), tmp_path / "out", executor("processes", 1))
    assert not list((tmp_path / "out" / "parts").iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="asks the system for the environment of processes")
@pytest.mark.slow
def test_what_a_method_began_ends_with_it(tmp_path, monkeypatch):
    psutil = pytest.importorskip("psutil")
    monkeypatch.setenv("OPTLOC_MARK", str(tmp_path))
    assert run_design(
        design(study(["spawn"], trials=1)), tmp_path / "out", executor("processes", 1, limit=1.0)
    ).complete
    marked = [one for one in psutil.process_iter() if one.pid != os.getpid() and mark_of(one) == str(tmp_path)]
    assert not marked


def mark_of(process):
    import psutil

    try:
        return process.environ().get("OPTLOC_MARK")
    except psutil.Error:
        return None


@pytest.mark.slow
def test_methods_do_not_speak_on_standard_output(tmp_path):
    text = study(["raise"], 2).replace("baseline", 'method = "gtrs+nlp"\n[[method]]\nbaseline')
    (tmp_path / "s.toml").write_text(text)
    command = [sys.executable, "-m", "optloc.cli", "study", "run", str(tmp_path / "s.toml"), "--out", "o", "--json"]
    path = os.pathsep.join(sys.path)
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("{")
    assert '"reason": "ZeroDivisionError: division by zero"' in done.stdout
    assert not without_progress(done.stderr)
    assert_identical(tmp_path / "o", run_here(design(text), tmp_path / "here"))
