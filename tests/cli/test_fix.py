"""What `optloc fix` decides: when fixes are refuted together, its sentences on the noise, and words of options."""

from types import SimpleNamespace

import numpy as np
import pytest

from optloc import InvalidProblem, Status
from optloc.cli.fix import _needs_causes, advice_json, grouping_of, tell_level


class Fixes(SimpleNamespace):
    """The codes of a batch of fixes, some of them refuted."""

    def __len__(self):
        return len(self.code)


@pytest.mark.parametrize(("refuted", "more"), [(0, False), (1, False), (100, True), (1000, True)])
def test_fixes_needs_causes_where_chance_refutes_fewer(refuted, more):
    code = np.full(1000, Status.OK)
    code[:refuted] = Status.MISFIT
    assert _needs_causes(Fixes(code=code, explanations=None)) is more


def level(**given):
    return SimpleNamespace(**{"suspect": False, "alone": False, "sentence": "the noise is twice as large"} | given)


def test_sentences_on_the_noise_say_what_uses_them():
    assert tell_level(None) == ()
    assert tell_level(level(suspect=True)) == ("the noise is twice as large: --rescale-noise uses it",)
    assert tell_level(level(suspect=True), used=True) == ("the noise is twice as large: this is used",)
    assert tell_level(level(), used=True) == (
        "the noise is used as stated: no common factor explains the residuals better",
    )


def test_late_rows_outweigh_the_noise():
    late = SimpleNamespace(sentence="a tenth of the rows is late", alike=False)
    assert tell_level(level(suspect=True), late=late) == (
        "a tenth of the rows is late: --late-from-data fixes with this loss",
    )


def test_groupings_are_known_words():
    assert grouping_of("pair", "--by") == "pair"
    with pytest.raises(InvalidProblem, match="did you mean 'station'"):
        grouping_of("statoin", "--by")
    assert not advice_json(())
