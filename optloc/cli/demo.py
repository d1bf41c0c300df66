"""What ``optloc demo`` does: fix a shipped problem, or walk through a fix, a registration and a proof."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markdown import Markdown

from optloc.cli.commands import draw
from optloc.cli.fixing import Fixed, fix_file
from optloc.cli.output import dumps, fixed_json, write_text
from optloc.cli.show import show
from optloc.errors import InvalidProblem, nearest
from optloc.files import read

_FIX = """
# 1. A fix

Six receivers heard one pulse. When it was sent nobody knows, so all there is are five differences of arrival times,
each good to about 28 ns. From these, and from no first guess, comes the table below: the most likely position, what it
is off by (±, one standard deviation), and `status ok`: an answer that can be used.

`chi-square` compares the residuals with the stated noise: p near 0 would say that something does not fit.
"""
_REGISTRATION = """
# 2. A registration

Five aircraft time an emitter some 360 km away for ten minutes, 200 times, each by a clock of its own. The errors of
four of these clocks are unknown: a fix that believed them would be more than a kilometre off. They are estimated
together with the position, and `from data` says how much of each estimate is measurement, not assumption.

The line `certificate` says `unknown`: so many rows are more than a proof takes, and what is not proven is not claimed.
"""
_PROOF = """
# 3. A proof

Three receivers in the plane give two differences, and two places explain them exactly. An iteration finds the one that
is nearer to its first guess, and says nothing of the other. The line `certificate` is no iteration: all places were
enclosed in boxes, and each box that was dropped was proven to hold nothing better. So the status is
`ambiguous`, both places are listed, and it is proven that there is no third.
"""
_END = """
# Next

- `optloc new tdoa --out site.toml` writes a problem file with comments, to be filled with your own numbers;
  `optloc list starters` shows what else there is.
- `optloc check site.toml`, then `optloc fix site.toml --plot fix.png`.
- `optloc convert` reads tables of arrival times, pseudoranges and GeoJSON stations.
"""
_STEPS = ((_FIX, "demo"), (_REGISTRATION, "registration"), (_PROOF, "ambiguous"))
PICTURE = Path("optloc-demo.png")


def titles() -> dict[str, str]:
    """Return the titles of the shipped problems by name."""
    import tomllib

    folder = files("optloc") / "scenarios"
    found = {entry.name.removesuffix(".toml"): entry for entry in folder.iterdir() if entry.name.endswith(".toml")}
    return {name: tomllib.loads(found[name].read_text(encoding="utf-8"))["title"] for name in sorted(found)}


def run_demo(name: str | None, plot: Path | None, *, as_json: bool, quiet: bool) -> int:
    """Fix one shipped problem, or walk through three of them, and return the exit code."""
    known = titles()
    if name is not None and name not in known:
        raise InvalidProblem(f"there is no demo {name!r}", "demo", nearest(name, known))
    if name is None and not as_json:
        return _walk(plot, quiet)
    fixed = _fixed(name or "demo", quiet or as_json)
    if as_json:
        write_text(Path("-"), dumps(fixed_json(fixed)))
    elif not quiet:
        show(fixed, Console())
    if plot is not None or not as_json:
        _draw(fixed, plot, quiet or as_json)
    return 0 if fixed.clean else 1


def _walk(plot: Path | None, quiet: bool) -> int:
    """Fix three shipped problems and say what is seen; the exit code is that of the first."""
    console = Console(quiet=quiet)
    code = 0
    for i, (text, name) in enumerate(_STEPS):
        _say(text, console)
        fixed = _fixed(name, quiet)
        show(fixed, console)
        if i == 0:
            _draw(fixed, plot, quiet)
            code = 0 if fixed.clean else 1
    _say(_END, console)
    return code


def _fixed(name: str, quiet: bool) -> Fixed:
    with as_file(files("optloc") / "scenarios") as place:
        return fix_file(read(place / f"{name}.toml"), "auto", quiet)


def _say(text: str, console: Console) -> None:
    shown: Any = Markdown(text, hyperlinks=False)
    console.print(shown)
    console.print()


def _draw(fixed: Fixed, plot: Path | None, quiet: bool) -> None:
    """Draw a fix; where no picture was asked for and none can be drawn, say so and go on."""
    from importlib.util import find_spec

    console = Console(quiet=quiet)
    if plot is None and find_spec("matplotlib") is None:
        line = "There is no picture, as matplotlib is not installed: pip install 'optloc[plot]'."
        console.print(line, highlight=False, markup=False, soft_wrap=True)
        return
    draw(fixed, plot or PICTURE)
    console.print(f"The picture is in {plot or PICTURE}.", highlight=False, markup=False, soft_wrap=True)
