"""The prose linter proselint over pages, docstrings, comments and messages.

`python tests/prose.py` prints each finding with its file and exits with 1 if there is one. `tests/habits.py` counts the
turns of phrase that proselint does not know.
"""

import re
import sys
from collections.abc import Iterator

from habits import ROOT, pages_and_modules, texts
from proselint.checks import __register__
from proselint.config import DEFAULT
from proselint.registry import CheckRegistry
from proselint.tools import LintFile

# Checks that misread technical text: straight quotes are code, lines of a table repeat a word, "free steps" is no
# cliché, "the least worst angle" and "measured less true" are terms, files may have the name of a day, and titles of
# papers are quoted as they are. An array of flags is called TODO.
NOT_USED = (
    "annotations",
    "typography",
    "lexical_illusions",
    "misc.illogic",
    "uncomparables",
    "redundancy.misc.after_the_deadline",
    "redundancy.misc.garner",
    "cliches.misc.garner",
    "misc.capitalization.days",
    "needless_variants",
)
CODE = re.compile(r"`[^`\n]*`|:math:`[^`]*`|\$[^$]*\$")


def findings() -> Iterator[str]:
    """Yield file, words and advice of each finding."""
    registry = CheckRegistry()
    registry.register_many(__register__)
    for path in pages_and_modules():
        text = CODE.sub("X", "\n\n".join(texts(path))) + "\n\n"
        for found in LintFile(str(path), text).lint(DEFAULT):
            result = found.check_result
            start, end = (place - 1 for place in result.span)  # proselint puts a line break before the text
            if not result.check_path.startswith(NOT_USED) and not text[end].isalpha():  # "for ever" in "for every"
                words = " ".join(text[start:end].split())
                yield f"{path.relative_to(ROOT)}: '{words}': {result.message} ({result.check_path})"


if __name__ == "__main__":
    found = sorted(findings())
    sys.exit("\n".join(found) or None)  # an empty text would count as a failure
