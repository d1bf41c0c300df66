"""Options of the command line on the wave: its speed, the wind, and two-way times."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from optloc.files.wave_speed import WaveOptions

PANEL = "The wave"

WaveSpeed = Annotated[
    str | None,
    typer.Option(
        "--wave-speed",
        metavar="SPEED",
        help="Speed of the wave: '343 m/s', '343+-5 m/s', air:20C, air:20C,50%, water:8C,35,50m, profile.csv, or "
        "light (default).",
        rich_help_panel=PANEL,
    ),
]
Wind = Annotated[
    str | None,
    typer.Option(
        "--wind",
        metavar="WIND",
        help="Velocity of the air or water: '5 m/s from 270', or 5,0 towards x and y in m/s.",
        rich_help_panel=PANEL,
    ),
]
TwoWay = Annotated[
    bool, typer.Option("--two-way", help="Ranges are times of the way there and back.", rich_help_panel=PANEL)
]
TurnAround = Annotated[
    str | None,
    typer.Option(
        "--turn-around",
        metavar="TIME",
        help="Time between arrival and reply at the other end, such as '2 ms', for two-way times.",
        rich_help_panel=PANEL,
    ),
]
WAVE_OPTIONS: dict[str, Any] = {
    "wave_speed": WaveSpeed, "wind": Wind, "two_way": TwoWay, "turn_around": TurnAround,
}  # fmt: skip
"""Options on the wave by the name of their parameter."""


def wave_options(values: dict[str, Any]) -> WaveOptions:
    """Return the options on the wave, which are removed from the `values` of all options of a command."""
    from optloc.files.wave_speed import WaveOptions

    speed, wind, two_way, turn_around = (values.pop(name) for name in WAVE_OPTIONS)
    return WaveOptions(speed, wind, two_way or turn_around is not None, turn_around)
