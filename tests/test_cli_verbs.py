"""Every command: help with an example, one line and exit code 2 for whatever is wrong, nothing but an answer else."""

import json
import re
import subprocess
import sys
from dataclasses import dataclass

import pytest
import typer
from progress import without_progress
from typer.testing import CliRunner

from optloc.cli import app
from optloc.cli.listing import describe, lists
from optloc.tracking import UPDATES

RUN = CliRunner()


def verbs(command=None, path=()):
    """Yield the words of every command that does something."""
    command = command or typer.main.get_command(app)
    for name, inner in command.commands.items():
        if hasattr(inner, "commands"):
            yield from verbs(inner, (*path, name))
        else:
            yield (*path, name)


VERBS = list(verbs())
# Commands that read a problem file, and what else they need.
READING = {
    "fix": [],
    "check": [],
    "track": [],
    "separate": [],
    "crlb": [],
    "simulate": ["--truth", "1,2,3", "--out", "o.toml"],
}
READING |= {"plot fix": [], "plot landscape": []}


def one_line(arguments, words=""):
    result = RUN.invoke(app, list(map(str, arguments)))
    assert result.exit_code == 2, result.output + repr(result.exception)
    assert result.stdout == ""
    assert len(without_progress(result.stderr)) == 1, result.stderr
    assert "Traceback" not in result.stderr
    assert re.search(words, result.stderr), result.stderr


@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_help_has_an_example_and_fits_a_terminal(verb):
    result = RUN.invoke(app, [*verb, "--help"], env={"COLUMNS": "80", "TERMINAL_WIDTH": "80"})
    assert result.exit_code == 0, result.output
    assert f"optloc {' '.join(verb)}" in result.stdout.partition("Examples")[2]
    assert max(map(len, result.stdout.splitlines())) <= 80
    assert "\x1b" not in result.stdout


def options(verb):
    command = typer.main.get_command(app)
    for name in verb:
        command = command.commands[name]
    return {option for parameter in command.params for option in parameter.opts}


@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_every_command_can_be_verbose_or_quiet(verb):
    assert {"--verbose", "-v"} <= options(verb)
    # What these three print is all they do.
    assert verb[-1] in {"list", "schema", "doctor"} or {"--quiet", "-q"} <= options(verb)


@pytest.mark.parametrize("verb", ["fix", "check", "crlb", "track", "separate", "demo", "convert", "list"])
def test_what_prints_results_prints_json(verb):
    assert "--json" in options([verb])


@pytest.mark.parametrize("verb", [(), ("study",)], ids=str)
def test_unknown_commands(verb):
    one_line(
        [*verb, "rnu", "x"], "there is no command 'rnu'; did you mean 'run'" if verb else "there is no command 'rnu'"
    )
    one_line(["fxi"], "did you mean 'fix'")


@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_unknown_options(verb):
    one_line([*verb, "--verbsoe"], "did you mean --verbose")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fix", "demo", "--method", "gtsr"], "did you mean 'gtrs"),
        (["fix", "demo", "--noise-from-data", "statoin"], "did you mean 'station'"),
        (["check", "demo", "--by", "statoin"], "did you mean 'station'"),
        (["check", "demo", "--method", "huebr"], "did you mean 'huber"),
        (["track", "run", "--model", "cvv"], "did you mean 'cv'"),
        (["track", "run", "--filter", "iekff"], "did you mean 'iekf'"),
        (["list", "kindz"], "did you mean 'kinds'"),
        (["new", "tdao"], "did you mean 'tdoa'"),
        (["demo", "ambigous"], "did you mean 'ambiguous'"),
        (["reproduce", "registraton"], "did you mean 'registration'"),
        (["reproduce", "registration", "--size", "ful"], "did you mean 'full'"),
        (["study", "run", "divergense"], "did you mean 'divergence'"),
        (["study", "run", "divergence", "--executor", "proceses"], "did you mean 'processes'"),
        (["plot", "lanscape", "demo"], "did you mean 'landscape'"),
        (["fix", "registraton"], "did you mean 'registration'"),
        (["simulate", "demo", "--truth", "1,2,3", "--out", "o.toml", "--trials", "many"], "--trials"),
        (["simulate", "demo"], "Missing option '--truth'"),
        (["fix"], "Missing argument 'FILE'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_misspelt_values(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one_line(arguments, re.escape(words))
    assert not list(tmp_path.iterdir()), "nothing may be left behind"


def broken(folder):
    (folder / "empty.toml").write_text("")
    (folder / "binary.toml").write_bytes(bytes(range(256)))
    (folder / "folder.toml").mkdir()
    return {"missing": "nowhere.toml", "empty": "empty.toml", "binary": "binary.toml", "folder": "folder.toml"}


@pytest.mark.parametrize("kind", ["missing", "empty", "binary", "folder"])
@pytest.mark.parametrize("verb", READING)
def test_files_that_are_none(verb, kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one_line([*verb.split(), broken(tmp_path)[kind], *READING[verb]], r"(nowhere|empty|binary|folder)\.toml")


@pytest.mark.parametrize("kind", ["missing", "empty", "binary", "folder"])
@pytest.mark.parametrize("suffix", ["csv", "parquet", "geojson"])
def test_tables_that_are_none(kind, suffix, tmp_path):
    path = tmp_path / f"{kind}.{suffix}"
    if kind == "folder":
        path.mkdir()
    elif kind != "missing":
        path.write_bytes(b"" if kind == "empty" else bytes(range(256)))
    one_line(
        ["convert", path, "--out", tmp_path / ("o.csv" if suffix == "geojson" else "o.toml")], rf"{kind}\.{suffix}"
    )


@pytest.mark.parametrize("kind", ["missing", "empty", "binary", "folder"])
def test_studies_that_are_none(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = broken(tmp_path)[kind]
    one_line(["study", "run", name, "--out", tmp_path / "out"], name)
    for verb in ("status", "report"):
        one_line(["study", verb, name], name)
    one_line(["study", "compare", name, name], name)


@pytest.mark.parametrize(
    "arguments",
    [
        ["fix", "demo", "--out", "{}/f.csv"],
        ["fix", "demo", "--plot", "{}/f.png"],
        ["fix", "demo", "--geojson", "{}/f.json"],
        ["track", "run", "--out", "{}/f.csv"],
        ["check", "run", "--out", "{}/f.csv"],
        ["crlb", "demo", "--at", "1,2,3", "--map", "{}/f.geojson"],
        ["simulate", "demo", "--truth", "1000,4000,1700", "--out", "{}/f.toml"],
        ["new", "tdoa", "--out", "{}/f.toml"],
        ["demo", "ambiguous", "--plot", "{}/f.png"],
        ["plot", "fix", "demo", "--out", "{}/f.png"],
        ["study", "run", "divergence", "--trials", "1", "--out", "{}/study"],
        ["reproduce", "registration", "--out", "{}/paper"],
    ],
    ids=" ".join,
)
def test_places_that_cannot_be_written(arguments, tmp_path):
    file = tmp_path / "file"
    file.write_text("no folder")
    result = RUN.invoke(app, [a.format(file) for a in arguments])
    assert result.exit_code == 2, result.output + repr(result.exception)
    assert len(without_progress(result.stderr)) == 1, result.stderr
    assert str(file) in result.stderr


def test_ctrl_c_is_one_line(monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("optloc.cli.fix.run_fix", lambda *a, **k: stopped())
    result = RUN.invoke(app, ["fix", "demo"])
    assert (result.exit_code, result.stdout, result.stderr) == (130, "", "Stopped.\n")


def test_an_error_of_the_system_is_one_line(monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device", "fixes.csv")

    monkeypatch.setattr("optloc.cli.fix.run_fix", full)
    one_line(["fix", "demo"], "fixes.csv: No space left on device")


def test_a_mistake_of_optloc_is_not_hidden(monkeypatch):
    def wrong(*_, **__):
        raise ZeroDivisionError

    monkeypatch.setattr("optloc.cli.fix.run_fix", wrong)
    assert isinstance(RUN.invoke(app, ["fix", "demo"]).exception, ZeroDivisionError)


def test_verbose_tells_the_steps_on_standard_error(tmp_path):
    result = RUN.invoke(app, ["fix", "demo", "--json", "--verbose", "--out", str(tmp_path / "f.csv")])
    assert json.loads(result.stdout)["fixes"]
    for words in ("read demo.toml: 5 rows", "gtrs:", "certify:", "wrote"):
        assert words in result.stderr
    assert without_progress(RUN.invoke(app, ["fix", "demo", "--json"]).stderr) == []


def test_without_matplotlib_the_demo_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    result = RUN.invoke(app, ["demo", "ambiguous"])
    assert result.exit_code == 0, result.output  # it shows what it is to show
    assert "pip install 'optloc[plot]'" in result.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("what", lists())
def test_every_list_has_names_and_summaries(what):
    rows = json.loads(RUN.invoke(app, ["list", what, "--json"]).stdout)
    assert rows
    assert all(row["summary"] for row in rows)


def test_help_names_every_list():
    words = " ".join(RUN.invoke(app, ["list", "--help"]).stdout.replace("\u2502", " ").split())
    assert [name for name in lists() if name not in words] == []


def test_an_entry_from_elsewhere_is_listed(monkeypatch):
    monkeypatch.setitem(UPDATES, "mine", lambda scan, mean, cov: None)
    rows = json.loads(RUN.invoke(app, ["list", "trackers", "--json"]).stdout)
    assert "mine" in [row["tracker"] for row in rows]


@dataclass
class Entry:
    """What an entry is."""

    kinds: tuple[str, ...]
    bound: object
    exact: bool = True


def test_entries_show_what_they_say_in_words():
    assert describe("method", {"quick": "gtrs+lsr"}) == [{"method": "quick", "summary": "gtrs+lsr"}]
    (row,) = describe("way", {"a": Entry(("tdoa", "range"), bound=len)})
    assert row == {"way": "a", "kinds": "tdoa range", "exact": "True", "summary": "What an entry is."}


def test_names_are_completed():
    environment = {"_OPTLOC_COMPLETE": "complete_bash", "COMP_WORDS": "optloc new rang", "COMP_CWORD": "2"}
    result = RUN.invoke(app, [], prog_name="optloc", env=environment)
    assert result.stdout.split() == ["range", "range_rate", "range_sum"]


@pytest.mark.parametrize("module", ["optloc", "optloc.cli"])
def test_a_process_ends_with_the_code_and_one_line(module):
    found = subprocess.run([sys.executable, "-m", module, "fxi"], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (2, "")
    assert found.stderr.count("\n") == 1
