"""Figures of pages: methods that look different, and SVG of equal bytes whose identities are those of its page."""

import re

from optloc.show.drawing import Picture, inline, marks, panel, panels, with_legend


def test_ninety_six_methods_look_different():
    looks = marks([str(i) for i in range(96)])
    assert len({(look.colour, look.mark, look.dash) for look in looks.values()}) == 96
    assert looks["1"].line == "method-1"
    assert looks["2"].dashes == "10 3"
    assert looks["0"].dashes == ""


def drawn():
    figure, axes = panel("a $title$", size=(1.0, 1.0))
    (line,) = axes.plot([0.0, 1.0], [0.0, 1.0], label="gtrs")
    line.set_gid("method-0")
    return figure


def test_equal_figures_are_equal_text_whose_identities_begin_with_their_name():
    found, again = (inline(Picture("errors", "Errors < bound", drawn())).svg for _ in range(2))
    assert found == again
    assert "a $title$" in found
    identities = re.findall(r'\bid="([^"]*)"', found)
    assert len(identities) > 10
    assert all(name.startswith("errors-") for name in identities)
    assert 'class="method-0"' in found
    assert 'aria-label="Errors &lt; bound"' in found
    assert "<metadata>" not in found


def test_a_legend_has_each_method_of_all_panels_once():
    figure, both = panels("", 2)
    for axes in both:
        axes.plot([0.0], [0.0], label="gtrs")
    (legend,) = with_legend(figure).legends
    assert [text.get_text() for text in legend.get_texts()] == ["gtrs"]
