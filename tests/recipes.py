"""The package of the contributing guide, installed from its page: what the recipes say, and nothing more."""

import re
import tomllib
from contextlib import contextmanager
from pathlib import Path

import pytest

from optloc.lab.study.baselines import BASELINES
from optloc.models import MODELS
from optloc.problem import LOSSES
from optloc.solvers import FORMULATIONS, SOLVERS
from optloc.tracking import UPDATES

PAGE = Path(__file__).parents[1] / "docs" / "contributing.md"
TABLES = {
    "models": MODELS,
    "formulations": FORMULATIONS,
    "losses": LOSSES,
    "solvers": SOLVERS,
    "trackers": UPDATES,
    "baselines": BASELINES,
}
_BLOCK = re.compile(r"^```\{code-block\} \w+\n:caption: (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def files_of_the_page(page=PAGE):
    """Return the text of every file of a page; parts of one file are joined."""
    files = {}
    for name, text in _BLOCK.findall(page.read_text(encoding="utf-8")):
        files[name] = files.get(name, "") + text
    return files


def write_package(folder, files, name=None, entries=None):
    """Write modules and the metadata that an installer makes of their pyproject.toml."""
    project = tomllib.loads(files["pyproject.toml"])["project"] if "pyproject.toml" in files else {}
    name, entries = name or project["name"], entries or project["entry-points"]
    for file, text in files.items():
        if file.endswith(".py"):
            (folder / file).write_text(text, encoding="utf-8")
    about = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    lines = []
    for group, named in entries.items():
        lines += [f"[{group}]", *(f"{key} = {value}" for key, value in named.items())]
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


@contextmanager
def installed(folder):
    """Have a folder of packages on the path, and forget it afterwards."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        for table in TABLES.values():
            table.forget()
        yield
    for table in TABLES.values():
        table.forget()
