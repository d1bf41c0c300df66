"""Odd values of every option of every command: an answer, or one sentence; never a traceback, never for long."""

import os
import random
import signal
import sys
import traceback
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command

from optloc.cli import app

resource = pytest.importorskip("resource", reason="limits and forks of POSIX")

# One run of each command that ends soon; the last two would run for minutes, were there such a folder.
LONG = ("study run", "study bench", "reproduce")
BASE = {
    "fix": "fix demo",
    "track": "track run",
    "separate": "separate two.toml",
    "simulate": "simulate demo --truth 1200,800,50 --out s.toml",
    "crlb": "crlb demo --at 1200,800,50",
    "check": "check run",
    "plot": "plot fix demo --out p.png",
    "demo": "demo ambiguous --plot d.png",
    "new": "new tdoa --out n.toml",
    "convert": "convert toa.csv --stations rx.csv --sigma 1ns --out c.toml",
    "list": "list kinds",
    "schema": "schema",
    "compile": "compile --check",
    "place": "place demo --choose 4 --at 1200,800,50 --draws 0",
    "calibrate": "calibrate net.toml",
    "live": "live demo --check",
    "serve": "serve demo --check",
    "study status": "study status no",
    "study report": "study report no",
    "study compare": "study compare no no",
    "study schema": "study schema",
    "study pairs": "study pairs no",
    "study profiles": "study profiles no",
    "study histories": "study histories demo --trials 1 --method gauss-newton",
    "study bench": "study bench --out /dev/null/no",
    "study run": "study run divergence --out /dev/null/no",
    "reproduce": "reproduce registration --out /dev/null/no",
}
ODD = (
    "",
    " ",
    "-1",
    "0",
    "1",
    "nan",
    "inf",
    "-inf",
    "1e400",
    "1e-400",
    "99999999999999999999",
    "1e30",
    "10**30",
    "١٢",
    "0x10",
)
ODD += (
    "$\\frac{",
    "%s%n{}{0}_^#&~\\",
    "\x1b[2J",
    "=1+1",
    "../../x",
    "/dev/null",
    "/dev/zero",
    "📡",
    "\udcff",
    "-",
    "--",
)
ODD += (
    ",",
    ":",
    "=",
    ":::",
    "1,2",
    "1,2,3",
    "1,2,3,4",
    "nan,nan,nan",
    "1e308,1e308,1e308",
    "inf:inf",
    "0,0,0:-1,-1,-1",
)
ODD += (
    "0,0,0:inf,inf,nan",
    "-5 m",
    "1e400 m",
    "nan m",
    "3 parsec",
    "true",
    "null",
    "[]",
    "x\ny",
    "a" * 5000,
    "auto",
    "estimate",
)
ODD += (
    "x.csv",
    "x.parquet",
    "x.png",
    "x.html",
    "x.geojson",
    "x.toml",
    "site.toml",
    ".",
    "a/b/c.csv",
    "name=",
    "rows=1e9,cells=-1",
)


def options():
    """Return every command with every option of it that takes a value."""
    found = []

    def walk(group, path):
        for name, one in group.commands.items():
            where = f"{path} {name}".strip()
            if hasattr(one, "commands"):
                walk(one, where)
            else:
                found.extend((where, p) for p in one.params if not getattr(p, "is_flag", False))

    walk(get_command(app), "")
    return found


CASES = [
    (where, option, value)
    for where, option in options()
    for value in ODD
    if not (where in LONG and option.name == "out")  # see the top
]


def arguments(where, option, value):
    words = BASE[where].split()
    if option.param_type_name == "argument":
        words[len(where.split())] = value
        return words
    flag = max(option.opts, key=len)
    if flag in words:  # given once
        at = words.index(flag)
        del words[at : at + 2]
    return [*words, f"{flag}={value}"]


# Memory that a command may take: above what any takes in earnest, and far below what absurd numbers ask for.
_MORE = 3 << 29


def _data():
    """Return the bytes of data that this process has, and its fork begins with: the tests before have left some."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[5]) * resource.getpagesize() if statm.exists() else _MORE


def run(words, place):
    """Run a command in a fork of this process with limits; return exit code, standard output and standard error."""
    child = os.fork()
    if not child:
        os.chdir(place)
        for number, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(os.open(place / name, os.O_CREAT | os.O_TRUNC | os.O_WRONLY), number)
        sys.stdout, sys.stderr = open(1, "w", encoding="utf-8"), open(2, "w", encoding="utf-8")  # noqa: SIM115
        sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: PTH123, SIM115
        os.dup2(sys.stdin.fileno(), 0)
        for stream in (sys.stdout, sys.stderr):
            stream.reconfigure(errors="replace")
        resource.setrlimit(resource.RLIMIT_AS, (1 << 34, 1 << 34))
        limit = _data() + _MORE
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
        signal.alarm(60)
        code = 70
        try:
            app(words)
        except SystemExit as end:
            code = end.code or 0
        except BaseException:  # noqa: BLE001  (whatever it is: the parent judges)
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status), *(
        (place / name).read_text("utf-8", "replace") for name in ("stdout", "stderr")
    )


@pytest.fixture
def place(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "toa.csv").write_text("message,station,time_s\n1,a,0\n1,b,1e-6\n1,c,2e-6\n")
    (folder / "rx.csv").write_text("name,x,y\na,0,0\nb,1000,0\nc,0,1000\n")
    (folder / "site.toml").write_text("mine")
    ring = {n: 5e3 * np.array([np.cos(i), np.sin(i)]) for i, n in enumerate("ABCDE")}
    away = [{n: np.linalg.norm(target - p) for n, p in ring.items()} for target in ([1000, 2000], [-1500, 500])]
    rows = [f'{{ a = "{n}", b = "A", z = {r[n] - r["A"]} }}' for r in away for n in "BCDE"]
    stations = [f'{{ name = "{n}", x = {x}, y = {y} }}' for n, (x, y) in ring.items()]
    text = f'format = 1\n[stations]\nrows = [{", ".join(stations)}]\n[[measurements]]\nkind = "tdoa"\nsigma = 3\n'
    heard = [f'{{ epoch = {j}, a = "{n}", z = {r[n]} }}' for j, r in enumerate(away) for n in "ABCDE"]
    names = ", ".join(f'{{ name = "{n}" }}' for n in "ABCDE")
    net = f'format = 1\n[stations]\ndimension = 2\nrows = [{names}]\n[[measurements]]\nkind = "range"\nsigma = 3\n'
    (folder / "net.toml").write_text(f"{net}rows = [{', '.join(heard)}]\n")
    (folder / "two.toml").write_text(f"{text}rows = [{', '.join(rows)}]\n")
    return folder


def check(case, place):
    where, option, value = case
    words = arguments(where, option, value)
    before = {p.name: p.read_bytes() for p in place.iterdir()}
    code, out, said = run(words, place)
    told = f"{words}: {code}\n{out[-500:]}\n{said[-3000:]}"
    assert code in (0, 1, 2), told
    assert "Traceback" not in said, told
    assert code != 2 or len(said.strip().splitlines()) == 1, told
    assert all(
        (place / name).read_bytes() == data for name, data in before.items() if name not in ("stdout", "stderr")
    ), told
    assert not list(place.glob(".optloc-*")), told


def test_every_command_has_a_base():
    assert {where for where, _ in options()} <= BASE.keys()


@pytest.mark.parametrize("number", range(10))
def test_an_odd_value_is_a_sentence(number, seed, place):
    draw = random.Random(f"{seed} {number}")
    check(draw.choice(CASES), place)


@pytest.mark.full
@pytest.mark.parametrize("where", BASE)
def test_all_odd_values_are_sentences(where, place):
    wrong = []
    for case in CASES:
        if case[0] == where:
            try:
                check(case, place)
            except AssertionError as error:
                wrong.append(str(error)[:2000])
            for path in place.iterdir():
                if path.name not in {"toa.csv", "rx.csv", "site.toml", "two.toml", "net.toml"} and path.is_file():
                    path.unlink()
    assert not wrong, "\n\n".join(wrong)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("simulate demo --truth 1,2,3 --out s.toml --trials 99999999999", "--trials"),
        ("simulate demo --truth 1,2,3 --out s.toml --seed -1", "--seed"),
        ("separate two.toml --emitters 1000000000000000000000000000000", "--emitters"),
        ("track run --noise nan", "noise"),
        ("track run --noise -1", "noise"),
        ("track run --memory 0 --model singer", "time_constant"),
        ("track run --gate nan", "--gate"),
        ("separate two.toml --false inf", "false"),
        ("separate two.toml --detection nan", "detection"),
        ("study run divergence --jobs 99999999 --out s", "--jobs"),
        ("study run divergence --trials 99999999999999 --out s", "fewer trials"),
    ],
)
def test_absurd_numbers_name_their_option(words, said, place):
    code, _, error = run(words.split(), place)
    assert (code, len(error.splitlines())) == (2, 1), error
    assert said in error
