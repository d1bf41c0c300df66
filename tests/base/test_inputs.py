"""What strangers send: pipes, devices, links, bombs and paths elsewhere are one sentence each, at once."""

import os
import subprocess
import sys
import time
from itertools import product
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from bad_input import HEAD, tdoa, write
from often import few
from pyarrow import parquet
from typer.testing import CliRunner

import optloc
from optloc.base.errors import InvalidProblem, nearest
from optloc.base.inputs import Budget, access, budget_of, files_read, json_of, read_bytes, toml_of
from optloc.cli import app
from optloc.files import table as tables
from optloc.files.reader import read
from optloc.lab.study.design import design_of

RUN = CliRunner()
ROWS = HEAD + '[[measurements]]\nkind = "tdoa"\nsigma = 1.0\n'
# What a refusal may cost; tests stop at five times that, because machines are shared.
SECONDS, MEGABYTES, PATIENCE = 2.0, 500, 5
WINDOWS = sys.platform == "win32"


def named(folder, name, text=ROWS, more=""):
    """Return a problem file that names a table."""
    path = folder / "site.toml"
    path.write_text(text + f'file = "{name}"\n' + more, encoding="utf-8")
    return path


def fifo(folder):
    os.mkfifo(folder / "t.csv")
    return named(folder, "t.csv")


def link(folder, target):
    (folder / "t.csv").symlink_to(target)
    return named(folder, "t.csv")


def table(folder, content):
    (folder / "t.csv").write_bytes(content)
    return named(folder, "t.csv")


def packed(folder, *columns, **options):
    parquet.write_table(pa.table(dict(columns)), folder / "t.parquet", **options)
    return named(folder, "t.parquet")


def document(folder, text):
    path = folder / "site.toml"
    path.write_text(text, encoding="utf-8")
    return path


def invalid_text():
    """Return a column of text whose bytes are none."""
    ends = pa.py_buffer(np.array([0, 2], np.int32).tobytes())
    return pa.Array.from_buffers(pa.string(), 1, [None, ends, pa.py_buffer(b"\xff\xfe")])


def row(**columns):
    return tuple(({"a": ["B"], "b": ["A"], "z": [1.0]} | columns).items())


# How each is made, and the words of its sentence.
HOSTILE = {
    "pipe": (fifo, "a pipe, a device or a socket"),
    "link to itself": (lambda f: link(f, "t.csv"), "symbolic link"),
    "link elsewhere": (lambda f: link(f, "/etc/passwd"), "'t.csv' is outside the folder"),
    "link to a device": (lambda f: link(f, "/dev/zero"), "'t.csv' is outside the folder"),
    "path elsewhere": (lambda f: named(f, "../t.csv"), "'../t.csv' is outside the folder"),
    "root": (lambda f: named(f, "/etc/passwd.csv"), "'/etc/passwd.csv' is outside the folder"),
    "folder": (lambda f: named(f, "."), "a folder, not a file"),
    "long name": (lambda f: named(f, "x" * 5000 + ".csv"), r"cannot be opened \(File name too long\)"),
    "a zero in a name": (lambda f: named(f, "t\\u0000.csv"), "control characters"),
    "columns": (lambda f: table(f, b",".join(b"c%d" % i for i in range(10**6)) + b"\n1\n"), "1000000 columns, 1000 at"),
    "a long header": (lambda f: table(f, b"a,b,z" + b"x" * 10**7 + b"\nB,A,1\n"), "not a CSV table"),
    "rows": (lambda f: table(f, b"a,b,z\n" + b"B,A,1\n" * 10**7), "more rows than 4000000"),
    "digits in a cell": (lambda f: table(f, b"a,b,z\nB,A," + b"9" * 10**6 + b"\n"), "is not a finite number"),
    "zeros": (lambda f: table(f, b"a,b,z\nB,A\0,1\n"), "control characters"),
    "not UTF-8": (lambda f: table(f, b"a,b,z\nB,A,1\nB,\xff,2\n"), "t.csv, line 3: the text is not UTF-8"),
    "quotes": (lambda f: table(f, b'a,b,z\nB,"A,1\n'), "not a CSV table|no station"),
    "parquet rows": (lambda f: packed(f, ("z", np.zeros(10**7)), compression="zstd"), "10000000 rows, 4000000 at"),
    "parquet nothings": (lambda f: packed(f, ("z", pa.nulls(10**7))), "10000000 rows, 4000000 at"),
    "parquet word": (
        lambda f: packed(f, ("a", ["x" * (1 << 20)] * 300), ("z", np.zeros(300)), compression="zstd"),
        "there is no station 'xxx",  # once in its dictionary, it is no burden
    ),
    "parquet lists": (lambda f: packed(f, *row(z=[[1.0]])), "column 'z': the column has the type list<"),
    "parquet truth": (lambda f: packed(f, *row(z=[True])), "column 'z': the column has the type bool"),
    "parquet dates": (lambda f: packed(f, *row(z=pa.array([1], pa.timestamp("ns")))), "datetime64.*not numbers"),
    "parquet bytes": (lambda f: packed(f, *row(a=invalid_text())), "not UTF-8"),
    "digits": (lambda f: document(f, "format = " + "9" * 10**6), "too many digits"),
    "lists": (lambda f: document(f, "format = 1\na = " + "[" * 10**6), "more levels of nesting"),
    "keys": (lambda f: document(f, "format = 1\n" + "a." * 10**6 + "b = 1"), "more levels of nesting"),
    "deep keys": (lambda f: document(f, "format = 1\n" + "a." * 100 + "b = 1"), "33 levels of nesting, 32 at most"),
    "escapes": (lambda f: document(f, tdoa().replace('"B"', '"\\u001b[2J"')), "control characters"),
    "bidi": (lambda f: document(f, tdoa().replace('"B"', '"\u202e"')), "control characters"),
    "a large document": (lambda f: document(f, tdoa() + "#" * (5 << 20)), "more bytes of text than 4194304"),
    "bytes": (lambda f: table(f, bytes(range(256)) * 999), "UTF-8"),
}


@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.skipif(WINDOWS, reason="links and pipes of POSIX")
def test_what_is_no_problem_file_is_one_sentence(tmp_path, case):
    make, words = HOSTILE[case]
    path = make(tmp_path)
    with pytest.raises(InvalidProblem, match=words) as caught:
        read(path)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert len(sentence) < 2000


@pytest.mark.parametrize("case", few(["parquet word", "pipe", "rows", "columns", "lists"], 2))
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is told by /proc")
def test_a_refusal_takes_neither_time_nor_memory(tmp_path, case):
    path = HOSTILE[case][0](tmp_path)
    seconds, megabytes, error = refused(["fix", str(path)])
    assert error.count("\n") == 1, error
    assert seconds < PATIENCE * SECONDS
    assert megabytes < PATIENCE * MEGABYTES


# The high water of a process that was forked counts what its parent had; that since it began another program does not.
COMMAND = """
import sys, time
from optloc.cli import app
from optloc.files import table as tables
try:
    app()
finally:
    print(time.process_time(), next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


def refused(arguments):
    """Run a command that must end with exit code 2; return its processor seconds, megabytes and what it said."""
    made = subprocess.run(
        [sys.executable, "-c", COMMAND, *arguments],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 2, made.stderr
    seconds, kibibytes = made.stdout.split()
    return float(seconds), int(kibibytes) / 1024, made.stderr


@pytest.mark.parametrize("name", ["/dev/zero", "/dev/random", "/proc/self/fd"])
@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no devices here")
def test_devices_are_no_files(name):
    for call in (lambda: read(Path(name)), lambda: design_of(Path(name)), lambda: read_bytes(Path(name))):
        with pytest.raises(InvalidProblem, match=r"a device|a folder"):
            call()


def test_a_file_elsewhere_may_be_allowed(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    path = named(inner, "../t.csv")
    (tmp_path / "t.csv").write_text("a,b,z\nB,A,120.5\nC,A,-33.25\nD,A,710\n")
    with pytest.raises(InvalidProblem, match="allow it with --outside"):
        optloc.load(path)
    assert optloc.load(path, outside=True).count == 3
    refused_ = RUN.invoke(app, ["check", str(path), "--no-solve", "--json"])
    assert refused_.exit_code == 2, refused_.output
    # what one command is allowed, the next is not
    for option, code in ((["--outside"], 0), ([], 2)):
        assert RUN.invoke(app, ["check", str(path), "--no-solve", "--json", *option]).exit_code == code


def test_a_link_inside_is_a_file(tmp_path):
    (tmp_path / "data.csv").write_text("a,b,z\nB,A,120.5\nC,A,-33.25\nD,A,710\n")
    assert optloc.load(link(tmp_path, "data.csv")).count == 3


def test_budgets_can_be_raised_and_lowered(tmp_path):
    path = table(tmp_path, b"a,b,z\nB,A,120.5\nC,A,-33.25\nD,A,710\n")
    for name in ("rows", "cells", "columns", "bytes"):
        with pytest.raises(InvalidProblem, match=f"raise the limit with --budget {name}=NUMBER"):
            optloc.load(path, budget=Budget(**{name: 2}))
    assert optloc.load(path, budget=Budget(rows=3)).count == 3
    assert RUN.invoke(app, ["check", str(path), "--no-solve", "--budget", "rows=2"]).exit_code == 2
    assert RUN.invoke(app, ["check", str(path), "--no-solve", "--budget", "rows=3,bytes=1e3"]).exit_code == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [("rws=3", "did you mean 'rows'"), ("rows", "'' is not a number"), ("rows=0", "'0'"), ("rows=nan", "'nan'")],
)
def test_a_budget_that_is_none_is_refused(text, words):
    with pytest.raises(InvalidProblem, match=words):
        budget_of(text, "--budget")


def test_what_was_read_is_known(tmp_path):
    path = table(tmp_path, b"a,b,z\nB,A,120.5\nC,A,-33.25\nD,A,710\n")
    with access(anew=True):
        read(path)
        assert files_read() == {path.resolve(), (tmp_path / "t.csv").resolve()}
    assert not files_read()


def test_standard_input_is_a_problem_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table(tmp_path, b"a,b,z\nB,A,120.5\nC,A,-33.25\nD,A,710\n")
    text = (tmp_path / "site.toml").read_text()
    found = RUN.invoke(app, ["check", "-", "--no-solve", "--json"], input=text)
    assert found.exit_code == 0, found.output
    wrong = RUN.invoke(app, ["check", "-"], input=text.replace('"tdoa"', '"tdao"'))
    assert wrong.exit_code == 2
    assert wrong.stderr.startswith("standard input, [[measurements]] 1"), wrong.stderr


def test_a_table_named_like_standard_input_is_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InvalidProblem, match="an unknown type"):
        read(named(Path(), "-"))


def test_documents_are_data_or_a_sentence():
    for text, words in (
        ("[" * 10**5, "levels of nesting"),
        ("9" * 10**5, "too many digits"),
        ('{"a": 1', "line 1: this is not JSON"),
    ):
        with pytest.raises(InvalidProblem, match=words):
            json_of(text, "x.json")
    assert toml_of('a = "' + ". " * 250 + '"', "x.toml")["a"].count(".") == 250


def test_advice_of_many_names_is_short_and_quick():
    names = [f"station {i}" for i in range(10**6)]
    began = time.process_time()
    assert len(nearest("nobody" * 10**5, names)) < 1000
    assert time.process_time() - began < PATIENCE * SECONDS


@pytest.mark.parametrize(
    ("written", "seconds"),
    [
        ("2024-05-01T00:00:00Z", 1714521600.0),
        ("2024-05-01T02:00:00+02:00", 1714521600.0),
        ("2024-05-01 00:00:00.25", 1714521600.25),
        ("2024-05-01", 1714521600.0),
    ],
)
def test_dates_have_time_zones(tmp_path, written, seconds):
    text = f"time,a,b,z\n{written},B,A,120.5\n{written},C,A,-33.25\n{written},D,A,710\n"
    found = read(table(tmp_path, text.encode()))
    assert found.times == pytest.approx([seconds], abs=1e-6)


@pytest.mark.parametrize("written", ["9999-12-31", "0001-01-01", "2024-02-30", "2024-05-01T25:00"])
def test_dates_of_no_calendar_are_refused(tmp_path, written):
    text = f"time,a,b,z\n{written},B,A,120.5\n{written},C,A,-33.25\n{written},D,A,710\n"
    with pytest.raises(InvalidProblem, match="column 'time'"):
        read(table(tmp_path, text.encode()))


def test_names_of_stations_keep_all_their_digits(tmp_path):
    one, two = 2**53 + 2, 2**53 + 4  # floats of 15 digits make one of them
    text = f"""format = 1
[stations]
rows = [{{ name = {one}, x = 0.0, y = 0.0 }}, {{ name = {two}, x = 9.0, y = 0.0 }}, {{ name = "C", x = 3.0, y = 8.0 }}]
[[measurements]]
kind = "range"
sigma = 1.0
rows = [{{ a = {one}, z = 5.0 }}, {{ a = {two}, z = 5.0 }}, {{ a = "C", z = 5.0 }}]
"""
    assert read(document(tmp_path, text)).problem.stations.names == (str(one), str(two), "C")


def test_a_number_is_written_as_one(tmp_path):
    with pytest.raises(InvalidProblem, match="'1_0' is not a number"):
        read(table(tmp_path, b"a,b,z\nB,A,1_0\nC,A,-33.25\n"))


def test_a_problem_file_of_another_folder_is_whole(tmp_path):
    """A simulation names nothing beyond its folder: what it needs is copied beside it."""
    source, out = tmp_path / "a", tmp_path / "b"
    source.mkdir()
    out.mkdir()
    write(
        source,
        'format = 1\n[stations]\nfile = "st.csv"\n[[measurements]]\nkind = "toa"\nsigma = 1.0\n'
        'rows = [{ a = "A", z = 1.0 }, { a = "B", z = 1.0 }, { a = "C", z = 1.0 }, { a = "D", z = 1.0 }]\n',
        st="name,x,y\nA,0,0\nB,4000,300\nC,200,5000\nD,4100,4700\n",
    )
    made = RUN.invoke(
        app, ["simulate", str(source / "p.toml"), "--truth", "1200,800", "--out", str(out / "drawn.toml")]
    )
    assert made.exit_code == 0, made.output
    (source / "st.csv").unlink()
    assert read(out / "drawn.toml").problem.stations.names == ("A", "B", "C", "D")


def test_code_comes_in_by_name_on_the_command_line_alone(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text("from optloc.problem import LOSSES\nLOSSES['mine'] = LOSSES['cauchy']\n")
    site = document(tmp_path, tdoa())
    fix = ["fix", str(site), "--method", "mine", "--quiet"]
    plain = RUN.invoke(app, fix)
    assert plain.exit_code == 2, plain.stderr
    with monkeypatch.context() as later:
        later.setitem(optloc.problem.LOSSES, "mine", None)  # what the plugin adds goes again
        found = RUN.invoke(app, ["--plugin", str(tmp_path / "mine.py"), *fix])
    assert found.exit_code == 1, found.stderr  # a robust loss proves nothing: an answer that is not ok


@pytest.mark.parametrize(
    ("text", "words"), [("import nowhere_at_all", "ModuleNotFoundError"), ("1 / 0", "ZeroDivision")]
)
def test_a_plugin_that_fails_is_named(tmp_path, text, words):
    (tmp_path / "mine.py").write_text(text)
    found = RUN.invoke(app, ["--plugin", str(tmp_path / "mine.py"), "list", "losses"])
    assert found.exit_code == 2
    assert words in found.stderr
    assert found.stderr.count("\n") == 1


def test_a_damaged_byte_of_a_parquet_table_is_a_table_or_a_sentence(tmp_path):
    """Every byte in turn, its last bit or its second: it is read with another value, or refused."""
    path = tmp_path / "t.parquet"
    words = pa.array(["A", "B", "A", "C", "B"])
    parquet.write_table(pa.table({"a": words, "z": [1.0, 2.0, 3.0, 4.0, 5.0]}), path)
    whole, refused = path.read_bytes(), 0
    for place, flip in product(range(len(whole)), (1, 64)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ flip]) + whole[place + 1 :])
        try:
            table = tables.parquet(path, {})
        except InvalidProblem:
            refused += 1
        else:
            assert {len(column) for column in table.columns.values()} <= {table.count}
    assert refused > 100
