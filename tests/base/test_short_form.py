"""Values that print as their short form, and what stands in for one that cannot be made."""

from dataclasses import dataclass

from show.ranging import ranged

from optloc.base.short_form import HasShortForm, ShortForm, short_form_of


@dataclass(frozen=True, slots=True, repr=False)
class Unlisted(HasShortForm):
    number: int


def test_a_value_prints_its_title_its_rows_and_the_next_call():
    problem, _ = ranged()
    form = short_form_of(problem)
    assert isinstance(form, ShortForm)
    text = repr(problem)
    assert text.splitlines()[0] == form.title
    assert form.following in text
    assert all(label in text and words in text for label, words in form.rows)
    assert problem._repr_html_().startswith("<table")


def test_a_class_without_an_entry_prints_as_an_object():
    assert short_form_of(Unlisted(1)) is None
    assert repr(Unlisted(1)).startswith("<")
    assert Unlisted(1)._repr_html_() is None


def test_a_value_without_numbers_prints_as_an_object():
    problem, _ = ranged()
    broken = object.__new__(type(problem))
    assert repr(broken).startswith("<optloc.problem.problem.Problem object")
