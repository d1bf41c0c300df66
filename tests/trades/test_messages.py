"""Every sentence that inputs of the trades cause has at most 200 characters, and names the next step."""

import inspect
import os
import re
import warnings
from pathlib import Path

import doc_pages
import pytest
from conftest import DATA_DEFAULT
from trades import test_public_problems as problems
from trades.broken import GOOD, Case, broken
from trades.messages import flaws, messages, names_step
from typer.testing import CliRunner

import optloc
from optloc.cli import app

CASES = [*(make() for make in GOOD), *broken()]
RECIPES = ("underwater", "bioacoustics", "gunshots", "earthquake", "acoustic-emission", "uwb")
FOLDER = Path(os.environ.get("OPTLOC_DATA", DATA_DEFAULT)).parent / "cases" / "sound"
# Wide enough that no sentence is wrapped.
WIDE = {"COLUMNS": "1000", "NO_COLOR": "1"}
SOUND = ("--wave-speed", "343 m/s")
RAW = {
    "01": [("fix", f"{name}.csv", "--sigma", "0.1 deg") for name in ("sight", "sight_alt", "sight_elev", "v", "xy")],
    "02": [("fix", "floor.toml"), ("check", "floor.toml")],
    "03": [("fix", "theodolite.toml"), ("check", "raw.toml")],
    "05": [("fix", "unknown_speed.toml"), ("fix", "less_1000us.toml"), ("check", "t.toml")],
    "06": [
        ("fix", "a.csv", "--stations", "s.csv", "--sigma", "0.1 ms"),
        ("fix", "a.csv", "--stations", "s.csv", "--sigma", "0.1 ms", *SOUND),
        ("fix", "tof.csv", "--stations", "tr.csv", "--sigma", "0.02 ms", "--as", "range"),
        ("convert", "tof.csv", "--stations", "tr.csv", "--sigma", "0.02 ms", "--wave-speed", "1480 m/s"),
        ("fix", "tdoa.csv", "--stations", "aru.csv", "--sigma", "2 ms", *SOUND),
    ],
    "08": [
        ("fix", "count.toml"),
        ("fix", "o.toml"),
        ("fix", "o.csv", "--stations", "m.csv", "--as", "arrivals", "--sigma", "1 us"),
        ("fix", "o.csv", "--stations", "m.csv", "--as", "arrivals", "--sigma", "1 us", *SOUND),
    ],
    "09": [
        ("fix", "picks.csv", "--stations", "net.csv", "--sigma", "0.2 s"),
        ("fix", "picks.csv", "--stations", "net.csv", "--sigma", "0.2 s", "--vp", "6 km/s", "--vs", "3.57 km/s"),
    ],
    "10": [("fix", "vrx.csv", "--sigma", "range=1 m,bearing=3 deg,elevation=1 deg", "--still")],
    "12": [("fix", "loca2.toml"), ("fix", "p.csv", "--stations", "nodes.csv", "--as", "arrivals", "--sigma", "5 ms")],
}  # fmt: skip


def said(words):
    """Return the output of a command, which must not end with a traceback."""
    result = CliRunner().invoke(app, [str(word) for word in words], env=WIDE)
    assert result.exception is None or isinstance(result.exception, SystemExit), (words, result.exception)
    return result.output


def flaws_of(case: Case, folder: Path):
    """Return the flaws of the messages of a case, which runs in a folder of its own."""
    for name, text in case.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return flaws(said(case.words))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.slow
def test_sentences_on_wrong_inputs(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert flaws_of(case, tmp_path) == []


def test_sentences_on_a_tenth_of_the_wrong_inputs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert [flaw for case in CASES[::10] if case.words[0] != "calibrate" for flaw in flaws_of(case, tmp_path)] == []


def test_the_wrong_inputs_are_many_and_cover_the_commands():
    assert len(CASES) >= 100
    assert {case.words[0] for case in CASES} == {"fix", "convert", "check", "track", "calibrate"}
    assert len({case.name for case in CASES}) == len(CASES)


def recording(monkeypatch):
    """Return a list that gets the flaws of all commands and calls of `locate` that follow."""
    found, invoke, locate = [], CliRunner.invoke, optloc.locate

    def invoked(self, cli, words, **more):
        result = invoke(self, cli, words, **more)
        found.extend(flaws(said([word for word in words if word != "--json"])))
        return result

    def located(*given, **more):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fix = locate(*given, **more)
        texts = [fix.status.sentence, *(str(one.message) for one in caught)]
        found.extend(text for text in texts if len(text) > 200 or not names_step(text))
        return fix

    # the outer command only: `said` uses the original
    monkeypatch.setattr(optloc, "locate", located)
    monkeypatch.setattr(problems.CliRunner, "invoke", invoke)
    monkeypatch.setattr(problems, "CliRunner", type("Recorder", (CliRunner,), {"invoke": invoked}))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in vars(problems) if name.startswith("test_")])
def test_sentences_on_public_problems(name, tmp_path, monkeypatch):
    test = getattr(problems, name)
    given = {"tmp_path": tmp_path, "monkeypatch": monkeypatch}
    given = {key: value for key, value in given.items() if key in inspect.signature(test).parameters}
    table = problems.SAMPLES if "samples" in inspect.signature(test).parameters else [()]
    monkeypatch.chdir(tmp_path)
    found = recording(monkeypatch)
    for row in table:
        test(*row, **given)
    assert found == []


@pytest.mark.slow
@pytest.mark.parametrize("name", RECIPES)
def test_sentences_on_recipes(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found, run = [], doc_pages.run_command

    def recorded(command):
        printed, code = run(command)
        found.extend(flaws(printed))
        return printed, code

    monkeypatch.setattr(doc_pages, "run_command", recorded)
    for key, value in WIDE.items():
        monkeypatch.setenv(key, value)
    doc_pages.run_page(doc_pages.DOCS / "recipes" / f"{name}.md")
    assert found == []


@pytest.mark.slow
@pytest.mark.parametrize("name", RAW)
@pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no cases at {FOLDER}")
def test_sentences_on_collected_cases(name, tmp_path, monkeypatch):
    for path in (FOLDER / name).glob("*.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.chdir(tmp_path)
    assert [flaw for words in RAW[name] for flaw in flaws(said(words))] == []


# The collector itself.

OUTPUT = """t.csv is understood as
  toa       6 readings in ms from toa_ms: arrival times
3 stations without both P and S are left out.
 1234 ms  loading machine code
Warning: the range values are too large; state their unit.
t
┌────────┐
│ status │ misfit │
│        │ Do not use it: the residuals are too large. │
│ x      │ 3.1 m │
└────────┘
Advice
  The values fit with the opposite sign.
  State the sign:
      positive = "b-farther"
"""


def test_the_collector_finds_all_messages():
    found = messages(OUTPUT)
    assert [one.sentences[0] for one in found if one.stepped] == [
        "3 stations without both P and S are left out.",
        "Warning: the range values are too large; state their unit.",
        "Do not use it: the residuals are too large.",
        "The values fit with the opposite sign.",
    ]
    assert flaws(OUTPUT) == [
        "no next step: 3 stations without both P and S are left out.",
        "no next step: Do not use it: the residuals are too large.",
    ]
    (long,) = flaws("Add " + "a" * 250 + ".")
    assert re.match(r"255 characters: Add", long)


@pytest.mark.parametrize(
    "text", ["add a station", "the unit is wrong; state it", "x is unknown; did you mean 'y'?", "see --height"]
)
def test_next_steps_are_recognised(text):
    assert names_step(text)


@pytest.mark.parametrize(
    "text", ["the state is unknown", "the unit of the fix is wrong", "no check is possible", "in use"]
)
def test_other_sentences_have_no_next_step(text):
    assert not names_step(text)
