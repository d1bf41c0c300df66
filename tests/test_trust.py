"""No file's text runs, imports, reads or writes anything: every key that may hold text is given hostile ones."""

import copy
import os
import sys
import threading
import types
import typing
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from pydantic import BaseModel

import optloc
from optloc.base.errors import InvalidProblem
from optloc.files.reader import read
from optloc.files.schema import ProblemFile
from optloc.files.writer import toml_text
from optloc.lab.study.design import design_of
from optloc.lab.study.document import StudyFile
from optloc.lab.study.methods import SETTINGS
from optloc.lab.study.trial import compute
from optloc.solvers import solve

ROW = {"a": "A", "z": 5000.0}
STATIONS = [{"name": name, "x": x, "y": y} for name, x, y in (("A", 0.0, 0.0), ("B", 9e3, 1e3), ("C", 2e3, 8e3))]
PROBLEM = {
    "format": 1,
    "stations": {"rows": STATIONS},
    "measurements": [{"kind": "range", "sigma": 1.0, "rows": [ROW, ROW | {"a": "B"}, ROW | {"a": "C"}]}],
}
STUDY = {
    "format": 1,
    "name": "trust",
    "trials": 2,
    "scenario": [{"name": "s", "layout": {"stations": 5}, "truth": {"kind": "hull"}, "noise": ["3 m"]}],
    "method": [{"method": "gtrs+lsr"}],
}
# What tables need beside the key that is looked at.
NEEDED = {
    "biases": {"name": "clock"},
    "priors": {"name": "position", "mean": [0.0, 0.0], "sigma": "1 km"},
    "constraints": {"kind": "box", "min": [-1e5, -1e5]},
    "outliers": {"share": 0.5, "size": "9 m"},
    "origin": {"lat_deg": 47.0, "lon_deg": 11.0},
    "scenario": STUDY["scenario"][0],
    "method": STUDY["method"][0],
}
# What a key takes the place of.
INSTEAD = {"file": "rows", "problem": "layout", "baseline": "method"}
# Things that must not happen while a file is read and solved: new processes, the network, libraries, deletions.
FORBIDDEN = (
    "os.system os.exec os.fork os.forkpty os.spawn os.posix_spawn subprocess.Popen socket.connect socket.getaddrinfo "
    "socket.bind ctypes.dlopen os.remove os.rename os.mkdir os.rmdir os.chmod os.link os.symlink os.truncate "
    "shutil.rmtree shutil.copyfile webbrowser.open pty.spawn"
).split()


class Watch:
    """What Python's audit events say while it looks; hooks cannot be removed, so there is one.

    Threads that run before it looks belong to libraries or to other tests. Only this thread and new ones are watched.
    """

    def __init__(self):
        self.looking, self.seen, self.others = False, [], frozenset()
        sys.addaudithook(self.hook)

    def hook(self, event, details):
        if not self.looking or threading.get_ident() in self.others:
            return
        if event == "open":
            self.seen.append(("open", str(details[0]), details[2]))
        elif event in FORBIDDEN:
            self.seen.append((event, str(details), 0))

    @contextmanager
    def look(self):
        others = {thread.ident for thread in threading.enumerate()} - {threading.get_ident()}
        self.looking, self.seen, self.others = True, [], frozenset(others)
        try:
            yield self.seen
        finally:
            self.looking = False


@pytest.fixture(scope="module")
def watch():
    return Watch()


def hostile(folder):
    """Return texts that do harm wherever something trusts them, each naming the folder beside the one that is asked."""
    secret, stray = folder.parent / "secret.csv", folder.parent / "stray"
    return [
        str(secret),
        "../secret.csv",
        "/etc/passwd",
        f"$(touch {stray})",
        f"; touch {stray} #",
        f"| touch {stray}",
        f"__import__('os').system('touch {stray}')",
        "optloc.cli:main",
        "file:///etc/passwd",
        "http://127.0.0.1:9/x.csv",
        "{{ 7 * 7 }} %(x)s {0.__class__} $\\frac{",
    ]


def holds_text(annotation):
    """Return whether a key of a schema may hold text, itself, in a list or in a table."""
    if annotation in (str, typing.Any):
        return True
    return any(holds_text(inner) for inner in typing.get_args(annotation) if not isinstance(inner, str))


def tables_in(annotation):
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for inner in typing.get_args(annotation) for table in tables_in(inner)]


def keys(model, path=()):
    """Yield the path and the annotation of every key of a schema that may hold text."""
    for name, entry in model.model_fields.items():
        for table in tables_in(entry.annotation):
            yield from keys(table, (*path, name))
        if holds_text(entry.annotation) or typing.get_origin(entry.annotation) is typing.Literal:
            yield (*path, name), entry.annotation


def values(annotation, text):
    """Return the shapes in which a key may hold a text."""
    origin = typing.get_origin(annotation)
    if origin in (types.UnionType, typing.Union):
        return [value for inner in typing.get_args(annotation) for value in values(inner, text)]
    if origin is list:
        return [[value] for value in values(typing.get_args(annotation)[0], text)] + [[[0.0, text]]]
    if origin is dict:
        return [{text: value} for value in values(typing.get_args(annotation)[1], text)] + [{"a": text}]
    return [text]


def put(base, path, value):
    """Return a document with a value at a path, made of what its tables need."""
    out = copy.deepcopy(base)
    at = out
    for name in path[:-1]:
        kind = "list" if name in ("measurements", "biases", "priors", "constraints", "scenario", "method") else "table"
        inner = at.get(name) or (
            [copy.deepcopy(NEEDED.get(name, {}))] if kind == "list" else copy.deepcopy(NEEDED.get(name, {}))
        )
        at[name] = inner
        at = inner[0] if kind == "list" else inner
        if name == "targets":
            at = at.setdefault("target", {})
    at.pop(INSTEAD.get(path[-1]), None)
    at[path[-1]] = value
    return out


CASES = [("problem", *found) for found in keys(ProblemFile)] + [("study", *found) for found in keys(StudyFile)]
HOMES = tuple(os.path.realpath(place) for place in {sys.prefix, sys.base_prefix, str(Path(optloc.__file__).parents[1])})


def used(kind, path):
    """Do with a file what a command does with it."""
    if kind == "problem":
        solve(read(path).problem, "gtrs+lsr")
    else:
        chunk = next(iter(design_of(path).chunks))
        compute(chunk)


@pytest.fixture(scope="module", autouse=True)
def warm(tmp_path_factory):
    """Let everything be loaded that loads itself: machine code, plugins of solvers, time zones."""
    folder = tmp_path_factory.mktemp("warm")
    for kind, base in (("problem", PROBLEM), ("study", STUDY)):
        path = folder / f"{kind}.toml"
        path.write_text(toml_text(base))
        used(kind, path)


def test_the_schemas_have_the_keys_that_are_looked_at():
    names = {path[-1] for _, path, _ in CASES}
    assert {"file", "title", "rows", "columns", "kind", "unit", "stations", "problem", "solver", "settings"} <= names
    assert len(CASES) > 80


@pytest.mark.parametrize("case", CASES, ids=lambda case: " ".join([case[0], *case[1]]))
def test_text_of_a_file_is_data(tmp_path, watch, case):
    kind, key, annotation = case
    folder = tmp_path / "asked"
    folder.mkdir()
    (tmp_path / "secret.csv").write_text("name,x,y,a,z\nA,0,0,A,1\nB,1,0,B,1\nC,0,1,C,1\n")
    before = sorted(tmp_path.rglob("*"))
    base = PROBLEM if kind == "problem" else STUDY
    for text in hostile(folder):
        for value in values(annotation, text):
            path = folder / "file.toml"
            path.write_text(toml_text(put(base, key, value)), encoding="utf-8")
            with watch.look() as seen, suppress(InvalidProblem):
                used(kind, path)
            wrong = [one for one in seen if not harmless(one, folder)]
            assert not wrong, (value, wrong)
            path.unlink()
    assert sorted(tmp_path.rglob("*")) == before


def harmless(seen, folder):
    """Return whether an event is reading: in the folder of the file, or of Python's own parts and those of optloc."""
    event, name, flags = seen
    if event != "open" or (flags or 0) & (os.O_WRONLY | os.O_RDWR):
        return False
    # a descriptor that is open already has no name; what libraries are loaded is asked where threads are counted
    about = ("/proc/self/maps", "/proc/cpuinfo")
    return name.isdigit() or name in about or os.path.realpath(name).startswith((os.path.realpath(folder), *HOMES))


@pytest.mark.parametrize("solver", SETTINGS)
def test_no_setting_is_text(solver):
    """What a study may say to a back end is a number, or yes or no: text names files, compilers and callbacks."""
    assert all(setting.kind in (bool, int, float) for setting in SETTINGS[solver].values())
