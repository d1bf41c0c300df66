"""The table of nodes, and generated functions that choose by the code of a node.

Compiled code can call only functions that are known when it is compiled. So for each property of a node, a chain of
``if kind == code`` is generated from the table and compiled like any other function. The chain of the shipped nodes is
always the same, and its compiled code is stored on disk. A user's node lengthens the chain. Its callers are then
compiled again, and stored on disk under another name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from math import inf
from threading import Lock
from typing import Any

from optloc.base.errors import InvalidProblem, nearest
from optloc.base.forks import held_by_forks
from optloc.kernels.jit import compiled, inlined, replace
from optloc.proof.atlas import frame_of, set_line
from optloc.proof.nodes import node as columns
from optloc.proof.nodes.angles import HORIZONTAL_ANGLE, VERTICAL_ANGLE
from optloc.proof.nodes.level import GEODETIC_HEIGHT, LINEAR_FORM
from optloc.proof.nodes.log_range import LOGARITHM
from optloc.proof.nodes.node import BALANCED, DIFFERENCE, FLAT, GROWS, MIXED, SCALED, Node, range_form, triple_at
from optloc.proof.nodes.range import DISTANCE, bound_difference, curve_centre, curve_difference
from optloc.proof.nodes.rate import RATE_OF_RANGE
from optloc.proof.nodes.ratio import RATIO_OF_RANGES

# In the order of their codes (`optloc.proof.nodes.node`). Nodes of users follow in the order of their first use.
_SHIPPED = (
    *(DISTANCE, LINEAR_FORM, HORIZONTAL_ANGLE, VERTICAL_ANGLE, RATIO_OF_RANGES, GEODETIC_HEIGHT, RATE_OF_RANGE),
    LOGARITHM,
)
NODES: list[Node] = list(_SHIPPED)
_CODES = {node: code for code, node in enumerate(NODES)}
_NAMES = {node.name: node for node in NODES}


def named(node: str | Node) -> Node:
    """Return the node with a name that a `Model` uses, or the node itself if the model contains it.

    An unknown name raises `InvalidProblem` with the nearest known names.
    """
    if isinstance(node, Node):
        return node
    if node not in _NAMES:
        raise InvalidProblem(f"the proof has no node {node!r}", "nodes", nearest(node, list(_NAMES)))
    return _NAMES[node]


# Functions that return a property of a node by its code: arguments, the expression for a node, and the default.

_Writer = Callable[[Node, int], str]


def _call(field: str, arguments: str) -> _Writer:
    """Return a writer of source text: for a node and its code, the text is a call of the node's function `field`.

    The text is empty if the node does not have this function.
    """
    return lambda node, code: "" if getattr(node, field) is None else f"{field}_{code}({arguments})"


def _constant(field: str) -> _Writer:
    """Return a writer of source text: for a node, the text is the value of the node's field."""
    return lambda node, code: repr(getattr(node, field))


_PROPERTIES: dict[str, tuple[str, _Writer, str]] = {
    "size_of": ("kind, data, reach", _call("size", "data, reach"), "1.0"),
    "ball_of": ("kind, data, least, most", _call("ball", "data, least, most"), "0.0, 0.0, 0.0, inf"),
    "ray_of": ("kind, kinds, data, swing, j, x, row", _call("ray", "kinds, data, swing, j, x, row"), "-1.0, 0.0"),
    "has_ray": ("kind", lambda node, code: repr(node.ray is not None), "False"),
    "shape_of": ("kind", _constant("shape"), repr(MIXED)),
    "infinity_of": ("kind", _constant("infinity"), repr(GROWS)),
    "points_of": ("kind", _constant("points"), "1"),
}


def _property_source(name: str, nodes: list[Node]) -> str:
    """Return the source of the function `name`, which returns one property of a node by its code.

    `nodes` are in the order of their codes.
    """
    arguments, write, default = _PROPERTIES[name]
    lines = [f"def {name}({arguments}):"]
    for code, node in enumerate(nodes):
        expression = write(node, code)
        if expression and expression != default:
            lines.append(f"    if kind == {code}:\n        return {expression}")
    return "\n".join([*lines, f"    return {default}", ""])


# Loops over all nodes except ranges in search coordinates around a fix, and over all nodes over a piece of an atlas.
# Each loop contains the cases as text. A separate function for the cases would take seven arrays for each node.
# Passing arrays counts references, which takes half as long as the bound of an angle.

_LOOPS = {
    "bound_others": """
def bound_others(kinds, data, centre, sense, half, line, nodes):
    for j in range(kinds.shape[0]):
        kind = kinds[j]
        if kind == RANGE:
            continue
        for k in range(3):
            line[k] = centre[k] - data[j, k]
        own, slope = data[j], nodes[j, SLOPE0 : SLOPE2 + 1]
{cases}
        nodes[j, PHI], nodes[j, LOW], nodes[j, HIGH] = value, low, high
""",
    "curve_others": """
def curve_others(kinds, data, centre, sense, half, line, second, nodes, curves):
    for j in range(kinds.shape[0]):
        kind = kinds[j]
        if kind == RANGE:
            continue
        for k in range(3):
            line[k] = centre[k] - data[j, k]
        own, turn = data[j], curves[j, TURN0 : TURN2 + 1]
{cases}
        # A slope may be zero because the bound does not use it. It is then not the gradient of the node.
        flat = nodes[j, SLOPE0] == 0.0 and nodes[j, SLOPE1] == 0.0 and nodes[j, SLOPE2] == 0.0
        curves[j, CHI] = inf if flat else chi
        column = 0
        for k in range(3):
            for m in range(k, 3):
                curves[j, column] = second[k, m]
                column += 1
""",
    "bound_pieces": """
def bound_pieces(atlas, kinds, data, half, nodes):
    away, away_b, sense, sense_b = atlas.away, atlas.away_b, atlas.sense, atlas.sense_b
    frame, h = frame_of(atlas), triple_at(half, 0)
    centre = range_form(atlas.point, atlas.slant, h)
    for j in range(kinds.shape[0]):
        kind, own = kinds[j], data[j]
        if kind == RANGE:
            value, low, high, g, form = bound_difference(frame, own, centre, h, away, sense)
            nodes[j, SLOPE0], nodes[j, SLOPE1], nodes[j, SLOPE2] = g
            nodes[j, PHI], nodes[j, LOW], nodes[j, HIGH] = value, low, high
            nodes[j, FORM], nodes[j, FORM + 4], nodes[j, FORM + 5] = form[0], form[2], form[3]
            nodes[j, FORM + 1], nodes[j, FORM + 2], nodes[j, FORM + 3] = form[1]
            continue
        slope = nodes[j, SLOPE0 : SLOPE2 + 1]
        set_line(frame, own, 0, away, sense)
{cases}
        nodes[j, PHI], nodes[j, LOW], nodes[j, HIGH] = value, low, high
""",
    "curve_pieces": """
def curve_pieces(atlas, kinds, data, half, nodes, curves):
    away, away_b, sense, sense_b, bend = atlas.away, atlas.away_b, atlas.sense, atlas.sense_b, atlas.bend
    frame, h = frame_of(atlas), triple_at(half, 0)
    centre = range_form(atlas.point, atlas.slant, h)
    bent = curve_centre(atlas.slant, centre, h)
    for j in range(kinds.shape[0]):
        kind, own = kinds[j], data[j]
        if kind == RANGE:
            second, turns, chi = curve_difference(frame, own, nodes[j], centre, bent, h, away, sense)
            curves[j, H00], curves[j, H01], curves[j, H02] = second[0], second[1], second[2]
            curves[j, H11], curves[j, H12], curves[j, H22] = second[3], second[4], second[5]
            curves[j, TURN0], curves[j, TURN1], curves[j, TURN2] = turns
            curves[j, CHI] = chi
            continue
        turn = curves[j, TURN0 : TURN2 + 1]
        set_line(frame, own, 0, away, sense)
{cases}
        curves[j, CHI] = chi
        column = 0
        for k in range(3):
            for m in range(k, 3):
                curves[j, column] = bend[k, m]
                column += 1
""",
}


def _near_case(node: Node, code: int, call: str) -> list[str]:
    """Return the source lines that call `bound` or `curve` of a node over a box in search coordinates around a fix.

    `call` is a template of the call, with gaps for the code of the node and for the arguments that contain its lines.
    """
    if node.points == 1:
        return [call.format(code, "line[:3], sense")]
    second = ["for k in range(3):", "    line[3 + k] = centre[k] - data[j, 3 + k]"]
    return [*second, call.format(code, "line[:3], sense, line[3:], sense")]


def _far_case(node: Node, code: int, call: str) -> list[str]:
    """Return the source lines that call `bound` or `curve` of a node over a box of an atlas.

    `code` and `call` are as in `_near_case`. The list is empty if the node does not work with scaled lines.
    """
    if node.infinity not in (SCALED, BALANCED):
        return []
    if node.points == 1:
        return [call.format(code, "away, sense")]
    return ["set_line(frame, own, 3, away_b, sense_b)", call.format(code, "away, sense, away_b, sense_b")]


def _cases(name: str, nodes: list[Node]) -> Iterator[str]:
    """Yield the source lines of the cases of the loop `name`, in the order of the codes; the last case has no bound."""
    near, bounds = name.endswith("others"), name.startswith("bound")
    if bounds:
        call = "value, low, high = bound_{}(own, {}, half, slope)"
    else:
        call = f"chi = curve_{{}}(own, {{}}, half, {'second' if near else 'bend'}, turn)"
    indent, word = " " * 8, "if"
    for code, node in enumerate(nodes):
        if node.infinity == DIFFERENCE:
            continue
        if near and not bounds and node.shape == FLAT:
            lines = ["curves[j, :FORCE] = 0.0", "continue"]
        else:
            lines = (_near_case if near else _far_case)(node, code, call)
        if lines:
            yield f"{indent}{word} kind == {code}:"
            yield from (f"{indent}    {line}" for line in lines)
            word = "elif"
    yield f"{indent}else:"
    yield f"{indent}    {'value, low, high = 0.0, -inf, inf' if bounds else 'chi = inf'}"


def text_of(name: str, nodes: list[Node]) -> str:
    """Return the source of the generated function `name`, which chooses by the code of a node."""
    if name in _PROPERTIES:
        return _property_source(name, nodes)
    return _LOOPS[name].format(cases="\n".join(_cases(name, nodes)))


_KERNELS = ("bound", "curve", "size", "ball", "ray")
# Functions that the loops call, other than the functions of the nodes.
_NAMED = (range_form, triple_at, frame_of, set_line, bound_difference, curve_centre, curve_difference)
_COLUMNS = (
    *("RANGE", "PHI", "SLOPE0", "SLOPE1", "SLOPE2", "LOW", "HIGH", "FORM"),
    *("H00", "H01", "H02", "H11", "H12", "H22", "TURN0", "TURN1", "TURN2", "CHI", "FORCE"),
)


def _kernels(node: Node) -> Iterator[tuple[str, Any]]:
    """Yield the compiled functions of a node with their names."""
    yield from ((name, getattr(node, name)) for name in _KERNELS if getattr(node, name) is not None)


def _generated(name: str, nodes: list[Node]) -> Callable[..., Any]:
    """Return the generated function `name` for these nodes, not yet compiled.

    Its file is this file, because stored machine code belongs to a file.
    """
    space: dict[str, Any] = {
        "__name__": __name__,
        "inf": inf,
        **{column: getattr(columns, column) for column in _COLUMNS},
    }
    space |= {function.__name__: function for function in _NAMED}
    space |= {f"{field}_{code}": kernel for code, node in enumerate(nodes) for field, kernel in _kernels(node)}
    exec(compile(text_of(name, nodes), __file__, "exec"), space)  # noqa: S102  # generated text
    function: Callable[..., Any] = space[name]
    return function


bound_others = compiled(_generated("bound_others", NODES))
curve_others = compiled(_generated("curve_others", NODES))
bound_pieces = compiled(_generated("bound_pieces", NODES))
curve_pieces = compiled(_generated("curve_pieces", NODES))
size_of = compiled(_generated("size_of", NODES))
ball_of = compiled(_generated("ball_of", NODES))
ray_of = compiled(_generated("ray_of", NODES))
has_ray = inlined(_generated("has_ray", NODES))
shape_of = inlined(_generated("shape_of", NODES))
infinity_of = inlined(_generated("infinity_of", NODES))
points_of = inlined(_generated("points_of", NODES))

# Nodes of users.

_LOCK = held_by_forks(Lock())


def code_of(node: str | Node) -> int:
    """Return the code of a node; add a new node to the table and to all chains."""
    entry = named(node)
    with _LOCK:
        if entry not in _CODES:
            _CODES[entry] = len(NODES)
            NODES.append(entry)
            _regenerate()
        return _CODES[entry]


def _regenerate() -> None:
    """Generate the chains again, for all nodes."""
    replace({globals()[name]: _generated(name, NODES) for name in (*_LOOPS, *_PROPERTIES)})


def width(kinds: Iterable[int]) -> int:
    """Return the number of columns for the numbers of nodes with these codes, `kinds`.

    The result is the greatest width of these kinds, so that a million problems of ranges take little memory.
    """
    return max((NODES[kind].width for kind in kinds), default=DISTANCE.width)
