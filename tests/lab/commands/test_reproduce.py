"""optloc reproduce: bad requests are one sentence, and a paper becomes a folder of tables, pictures and a page."""

import pytest
from progress import without_progress
from typer.testing import CliRunner

from optloc.cli import app
from optloc.lab import papers
from optloc.lab.papers import Report, Reproduction, TextTable

RUN = CliRunner()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["registratoin"], "did you mean 'registration'"),
        (["registration", "--size", "huge"], "quick, full"),
        (["registration", "--out", "taken"], "choose another place"),
    ],
)
def test_bad_requests_are_one_sentence(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("a file")
    result = RUN.invoke(app, ["reproduce", *arguments])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert words in result.stderr
    assert len(without_progress(result.stderr)) == 1


def test_tables_are_printed_and_written(tmp_path, monkeypatch):
    table = TextTable("errors", "Errors", ("filter", "error, m"), (("ekf", "0.032"),), "Of one track.")
    ready = Reproduction(1, lambda tick: tick() or Report("# Page\n", (table,), ()))
    monkeypatch.setattr(papers, "reproduction", lambda name, size, seed: ready)
    result = RUN.invoke(app, ["reproduce", "angles", "--out", str(tmp_path / "made")])
    assert result.exit_code == 0
    assert [word for word in ("Errors", "0.032", "Of one track.", "2 files") if word not in result.stdout] == []
    assert (tmp_path / "made" / "errors.csv").read_text(encoding="utf-8") == 'filter,"error, m"\nekf,0.032\n'
    assert (tmp_path / "made" / "README.md").read_text(encoding="utf-8") == "# Page\n"
