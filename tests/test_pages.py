"""The pages of the documentation as they are built: they ask nobody for anything, draw all formulas, and are readable.

Without OPTLOC_PAGES, the folder of built pages, a few of them are built here.
"""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from doc_pages import DOCS
from show.browser import Browser, executable

# Links that a reader follows are no requests; everything that a browser fetches by itself is.
FETCHED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src", "embed": "src"}
NEEDED = ("sphinx", "furo", "myst_nb", "numpydoc", "sphinx_design", "sphinx_gallery", "sphinx-mathjax-offline")
FEW = ("how-to-choose.md", "theory/squared_range.md", "howto/formats.md", "notebooks/first-fix.ipynb")
PHONE, DESK = 390, 1280
# The least size of text that can be read, in pixels.
LEAST = 9
CORE = re.search(r":caption: Core\n:hidden:\n\n(.*?)```", (DOCS / "index.md").read_text("utf-8"), re.DOTALL)[1]
# What a reader sees badly: the reach of the page, blocks of code that go on beyond their edge, blocks with more lines
# than were written, tables in blocks that are wider than these, and text below a size.
SEEN = """(least => {
  const found = {wide: document.documentElement.scrollWidth, hidden: [], broken: [], tables: [], small: []};
  const pen = document.createElement('canvas').getContext('2d');
  for (const pre of document.querySelectorAll('article pre')) {
    const style = getComputedStyle(pre), text = pre.textContent.trimEnd();
    if (pre.scrollWidth > pre.clientWidth) found.hidden.push(text);
    const height = pre.clientHeight - parseFloat(style.paddingTop) - parseFloat(style.paddingBottom);
    if (Math.round(height / parseFloat(style.lineHeight)) > text.split('\\n').length) found.broken.push(text);
    const width = pre.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight);
    pen.font = style.font;
    const wide = line => /[│━]/.test(line) && pen.measureText(line).width > width + 1;
    found.tables.push(...text.split('\\n').filter(wide));
  }
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const {data, parentElement: place} = texts.currentNode;
    const drawn = data.trim() && place.offsetParent && !place.closest('script, style');
    if (drawn && parseFloat(getComputedStyle(place).fontSize) < least) found.small.push(data);
  }
  return found;
})"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    if given := os.environ.get("OPTLOC_PAGES"):
        return Path(given)
    if lacking := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
        pytest.skip(f"{', '.join(lacking)} is not installed: pip install 'optloc[docs]'")
    folder = tmp_path_factory.mktemp("docs")
    for name in ("conf.py", "generated.py", "scraper.py", "_static", "measured", *FEW):
        place = folder / name
        place.parent.mkdir(exist_ok=True)
        (shutil.copytree if (DOCS / name).is_dir() else shutil.copy)(DOCS / name, place)
    (folder / "recipes").mkdir()
    for picture in (DOCS / "recipes").glob("*.png"):
        shutil.copy(picture, folder / "recipes")
    front = re.sub(r"```\{toctree\}.*?```", "", (DOCS / "index.md").read_text("utf-8"), flags=re.DOTALL)
    (folder / "index.md").write_text(
        f"{front}\n```{{toctree}}\n" + "\n".join(name.rpartition(".")[0] for name in FEW) + "\n```\n"
    )
    # Without the gallery, whose examples run, and the sources of all modules.
    settings = "extensions=myst_nb,sphinx_design,sphinx.ext.mathjax,sphinx-mathjax-offline"
    command = [sys.executable, "-m", "sphinx", "-q", "-D", settings, str(folder), str(folder / "html")]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return folder / "html"


def found(pages):
    return sorted(path for path in pages.rglob("*.html") if "_static" not in path.parts)


class Fetches(HTMLParser):
    """Notes what a page fetches."""

    def __init__(self):
        super().__init__()
        self.places = []

    def handle_starttag(self, tag, attrs):
        known = dict(attrs)
        # a link to another form of the page is for machines that look for it
        if tag in FETCHED and known.get("rel") not in ("canonical", "author", "license"):
            self.places.append(known.get(FETCHED[tag]) or "")
            self.places += (known.get("srcset") or "").split()


def is_foreign(place):
    return re.match(r"(?:[a-z]+:)?//", place.strip("'\" "), re.IGNORECASE) is not None


def test_no_page_fetches_anything_from_elsewhere(pages):
    foreign, formulas = [], 0
    for path in found(pages):
        text, parser = path.read_text(encoding="utf-8"), Fetches()
        parser.feed(text)
        foreign += [f"{path.name}: {place}" for place in parser.places if is_foreign(place)]
        foreign += [f"{path.name}: {place}" for place in in_style(text) if is_foreign(place)]
        if 'class="math' in text:
            formulas += 1
            assert any("mathjax/tex-chtml.js" in place for place in parser.places), path.name
    for path in pages.rglob("*.css"):
        text = path.read_text(encoding="utf-8", errors="replace")
        foreign += [f"{path.name}: {place}" for place in in_style(text) if is_foreign(place)]
    assert foreign == []
    assert formulas
    assert (
        pages / "_static" / "mathjax" / "output" / "chtml" / "fonts" / "woff-v2" / "MathJax_Main-Regular.woff"
    ).exists()


def in_style(text):
    """Return what url() and @import name."""
    found = re.findall(r"url\(\s*['\"]?([^'\")]{1,200})", text)
    return found + re.findall(r"@import\s+['\"]([^'\"]+)", text)


def test_the_test_sees_what_is_fetched():
    parser = Fetches()
    parser.feed('<script src="https://a.b/c.js"></script><a href="https://d.e"></a><img src="_images/x.png">')
    assert [place for place in parser.places if is_foreign(place)] == ["https://a.b/c.js"]
    assert in_style("a{src:url( 'https://f.g/h.woff')} @import \"//i.j/k.css\";") == [
        "https://f.g/h.woff",
        "//i.j/k.css",
    ]
    assert is_foreign("//i.j/k.css")
    assert not is_foreign("data:image/svg+xml,<svg xmlns='http://www.w3.org/2000/svg'>")


@pytest.mark.skipif(executable() is None, reason="there is no browser")
def test_a_browser_draws_all_formulas_and_a_phone_shows_all_of_a_page(pages):
    wide = []
    with Browser() as browser:
        for path in found(pages):
            browser.open(path, PHONE, 800, phone=True)
            if browser.run("document.querySelectorAll('.math').length"):
                browser.run("MathJax.startup.promise.then(() => document.fonts.ready).then(() => 0)")
                undrawn = "[...document.querySelectorAll('.math')].filter(m => !m.querySelector('mjx-container'))"
                assert browser.run(f"{undrawn}.length") == 0, path.name
                assert browser.run("document.querySelectorAll('mjx-merror').length") == 0, path.name
            reach = browser.run("document.documentElement.scrollWidth")
            wide += [f"{path.name}: {reach}"] if reach > PHONE else []
        assert {url.partition(":")[0] for url in browser.requests} == {"file"}
    assert wide == []


def in_the_core(pages):
    """Return the front page and the core pages, those that are built."""
    names = ["index", *(line.rpartition("<")[2].rstrip(">") for line in CORE.split("\n") if line)]
    return [path for name in names if (path := pages / f"{name}.html").exists()]


@pytest.mark.skipif(executable() is None, reason="there is no browser")
def test_code_and_text_of_core_pages_are_readable_on_a_desk_and_a_phone(pages, tmp_path):
    wrong = []
    with Browser() as browser:
        for path in in_the_core(pages):
            front = path.stem == "index"
            for width in (DESK, PHONE):
                browser.open(path, width, 900, phone=width == PHONE)
                seen = browser.run(f"{SEEN}({LEAST})")
                # On a phone code is moved within its block, but not on the front page.
                bad = [*seen["small"], *(seen["hidden"] if front or width == DESK else [])]
                # Long lines may break, but no line of a table, and none of the front page.
                bad += (seen["broken"] if front else []) + (seen["tables"] if width == DESK else [])
                wrong += [f"{path.name} at {width}: {text[:60]}" for text in bad]
                wrong += [f"{path.name} at {width}: reaches to {seen['wide']}"] if seen["wide"] > width else []
                if front:
                    browser.picture(tmp_path / f"front-{width}.png", whole=True)
    assert wrong == [], "\n".join(wrong)


@pytest.mark.skipif(executable() is None, reason="there is no browser")
def test_the_test_sees_what_cannot_be_read(tmp_path):
    page, long = tmp_path / "page.html", "x" * 200
    page.write_text(
        "<article><style>pre { overflow: auto; line-height: 18px }</style>"
        f"<pre>{long}</pre><pre style='white-space: pre-wrap; overflow-wrap: anywhere'>{long}</pre>"
        f"<p style='font-size: 8px'>small</p><pre>short\nlines</pre><pre>│{long}</pre></article>"
    )
    with Browser() as browser:
        browser.open(page, DESK, 900)
        seen = browser.run(f"{SEEN}({LEAST})")
    table = f"│{long}"
    assert seen == {"wide": DESK, "hidden": [long, table], "broken": [long], "tables": [table], "small": ["small"]}
