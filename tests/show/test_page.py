"""Pages: one file that needs nothing else, runs its own scripts only, and shows names that are no HTML."""

import re
from base64 import b64encode
from hashlib import sha256

import pandas as pd
from show.ranging import ranged

from optloc.show.maps.map_pages import fix_page
from optloc.show.page import PagePart, write_page
from optloc.show.sheet import Sheet, TextTable


def test_a_page_loads_nothing_and_escapes_what_it_shows():
    shown = TextTable("t", "", ("name", "value"), (("<script>alert(1)</script>", "2"),))
    page = write_page("a <title>", [PagePart("one", "PagePart & more", tables=[Sheet(pd.DataFrame(), shown)])])
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "<script>alert(1)" not in page
    assert "PagePart &amp; more" in page
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', page)


def test_the_page_of_a_fix_names_its_stations():
    problem, fix = ranged()
    page = fix_page(problem, fix, "Four ranges")
    assert all(f"station {name}" in page for name in problem.stations.names)
    assert "<title>Four ranges</title>" in page


def test_a_browser_runs_the_scripts_of_the_page_only():
    problem, fix = ranged()
    page = fix_page(problem, fix, "Four ranges")
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)[1].replace("&#39;", "'")
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    hashes = [f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'" for text in scripts]
    assert f"script-src {' '.join(hashes)};" in policy
    assert "default-src 'none'" in policy
    assert "connect-src 'none'" in policy
