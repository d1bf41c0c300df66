"""One answer, five renderings: the same sections, labels and words in the same order, on Earth and elsewhere."""

import io
import re
from html import unescape
from html.parser import HTMLParser

import pytest
from show.answers import batch, singles, states
from show.ranging import ranged

from optloc.base.types import Status
from optloc.cli.output import Screen, show_answer
from optloc.model_checks.cause import Advice
from optloc.show import fix_page
from optloc.show.describe_fix import answer_of
from optloc.show.fix_answer import SECTIONS
from optloc.show.render import dict_of_answer, html_of_answer, text_of_answer

CASES = {**singles(), "batch": batch(), "two targets": states()}
ADVICE = Advice("cause", "the rows have a redundancy of 1", "add a row", "[[rows]]")


def flat(text):
    return " ".join(text.split())


def of_html(text):
    return flat(unescape(re.sub(r"<[^>]+>", " ", text)))


def of_terminal(answer):
    file = io.StringIO()
    console = Screen()
    console.file, console.width = file, 400
    show_answer(answer, console)
    return flat(re.sub("[│┃─━┌┐└┘├┤┬┴┼┏┓┗┛┡┩╇╈┳┻╋┠┨]", " ", file.getvalue()))


def of_dict(answer):
    found = dict_of_answer(answer)
    parts = []
    for section in found["sections"]:
        parts += [f"{row['label']} {row['text']}" for row in section["rows"]]
        for table in section["tables"]:
            parts += [" ".join(table["columns"]), *(" ".join(row) for row in table["rows"])]
    return flat(" ".join(parts))


RENDERINGS = {
    "text": lambda answer: flat(text_of_answer(answer)),
    "html": lambda answer: of_html(html_of_answer(answer)),
    "page": lambda answer: of_html(
        re.sub("<script.*?</script>", "", fix_page(*ranged(), "page", answer=answer), flags=re.DOTALL)
    ),
    "terminal": of_terminal,
    "dict": of_dict,
}


def words_of(answer):
    """Return the texts of an answer in order: label with text, and the rows of tables."""
    for section in answer.sections:
        yield from (flat(f"{label} {text}") for label, text in section.rows)
        for sheet in section.sheets:
            yield from (flat(" ".join(row)) for row in ([sheet.head] if sheet.head else []))
            yield from (flat(" ".join(row)) for row in sheet.rows)


@pytest.mark.parametrize("rendering", RENDERINGS)
@pytest.mark.parametrize("case", CASES)
def test_all_renderings_have_the_same_words_in_the_same_order(case, rendering):
    answer = answer_of(CASES[case])
    shown, place = RENDERINGS[rendering](answer), 0
    for words in words_of(answer):
        found = shown.find(words, place)
        assert found >= 0, words
        place = found + len(words)


@pytest.mark.parametrize("rendering", ["text", "html", "page", "terminal"])
def test_advice_is_between_the_reason_and_the_details(rendering):
    answer = answer_of(singles()["ambiguous on Earth"], advice=(ADVICE,))
    shown = RENDERINGS[rendering](answer)
    places = [shown.index(text) for text in ("reason", "The rows have a redundancy of 1.", "[[rows]]", "chi-square")]
    assert places == sorted(places)


class Tables(HTMLParser):
    """A parser that notes the open tags and the texts of cells."""

    def __init__(self):
        super().__init__()
        self.open, self.cells = [], []

    def handle_starttag(self, tag, attrs):
        self.open += [] if tag in ("meta", "link", "image", "input", "br") else [tag]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if {"td", "th"} & set(self.open):
            self.cells.append(data.strip())


@pytest.mark.parametrize("case", CASES)
def test_html_parses_and_has_the_numbers_as_text(case):
    answer = answer_of(CASES[case])
    parser = Tables()
    parser.feed(html_of_answer(answer))
    assert parser.open == []
    cells = " ".join(parser.cells)
    assert all(text in cells for section in answer.sections for _, text in section.rows)
    assert "<script" not in html_of_answer(answer)


def test_the_page_of_a_fix_has_status_position_and_sigma_above_the_map():
    problem, fix = ranged()
    page = fix_page(problem, fix, "Four ranges")
    lat, lon, _ = fix.latlon
    places = [
        page.index(text) for text in (Status.OK.sentence, f"{lat:.5f}", f"{lon:.5f}", "sigma east, north", "<svg")
    ]
    assert places == sorted(places)


def test_texts_of_files_are_data_in_html():
    answer = answer_of(ranged()[1], title="<script>alert(1)</script>")
    assert "<script" not in html_of_answer(answer)
    assert "&lt;script&gt;" in html_of_answer(answer)


def test_a_picture_is_between_the_main_part_and_the_details():
    shown = html_of_answer(answer_of(ranged()[1]), "<svg></svg>")
    assert shown.index("95 % radius") < shown.index("<svg>") < shown.index("chi-square")


def test_lines_of_text_fit_the_width():
    assert max(map(len, text_of_answer(answer_of(singles()["ambiguous on Earth"])).splitlines())) <= 100


def test_every_case_has_its_sections_in_order():
    for fix in CASES.values():
        names = [section.name for section in answer_of(fix).sections]
        assert names == sorted(names, key=SECTIONS.index)
        assert names[0] == "use"
