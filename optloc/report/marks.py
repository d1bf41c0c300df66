"""How methods look in every figure of a report: a colour, a mark and a dash each, told apart without colour too."""

from __future__ import annotations

from dataclasses import dataclass

from optloc.plot.style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, YELLOW

_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, YELLOW, BLACK, GREY)
_MARKS = "osD^vP*X<>hp"
_DASHES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (5, 1.2, 1.2, 1.2)))


@dataclass(frozen=True, slots=True)
class Mark:
    """The look of a method.

    Parameters
    ----------
    number : int
        Of the method, in the order of the report.
    name : str
        The method.
    colour, mark : str
        As matplotlib takes them.
    dash : str or tuple
        Line style of matplotlib.
    """

    number: int
    name: str
    colour: str
    mark: str
    dash: str | tuple[float, tuple[float, ...]]

    @property
    def line(self) -> str:
        """Return the identity of the method's lines in SVG, by which a page finds them."""
        return f"method-{self.number}"


def marks(methods: list[str]) -> dict[str, Mark]:
    """Return the look of every method."""
    return {
        name: Mark(i, name, _COLOURS[i % 8], _MARKS[i % 12], _DASHES[(i // 2 + i // 8) % 4])
        for i, name in enumerate(methods)
    }
