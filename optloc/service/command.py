"""The commands ``optloc live`` and ``optloc serve``: fixes from a stream, until the stream or a signal ends."""

from __future__ import annotations

import json
from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optloc.cli import (
    Budget,
    Force,
    Height,
    Method,
    Outside,
    ProblemPath,
    Quiet,
    TurnAround,
    TwoWay,
    Verbose,
    WaveSpeed,
    Wind,
    choice,
    example,
)
from optloc.files import visible
from optloc.problem import InvalidProblem, nearest
from optloc.service.http_options import Hosts, Http, NoToken, Tokens, access_of

if TYPE_CHECKING:
    from optloc.service.site import Site, SiteOptions

# Import the stream inside the commands, so that --help prints without delay.

Replay = Annotated[
    Path | None,
    typer.Option("--replay", metavar="FILE", help="Read a recording, or the epochs of a problem file (.toml)."),
]
Speed = Annotated[
    float | None,
    typer.Option(metavar="N", help="Replay speed relative to the recording; by default as fast as possible."),
]
Wait = Annotated[str, typer.Option(metavar="TIME", help="Time from the first row of an event to its closing.")]
Late = Annotated[str, choice("drop|revise", "Ignore late rows, or answer again.", "--late")]
Phases = Annotated[
    str,
    choice("two|one|fix", "Answers: a fix at once and its proof later, both in one, or no proof.", "--phases"),
]
Deadline = Annotated[
    str | None,
    typer.Option(metavar="TIME", help="Time limit of a proof; by default 1 s, or none for input from a file."),
]
Shed = Annotated[
    bool | None,
    typer.Option("--shed/--no-shed", help="Skip proofs under load, or let rows wait; by default, rows of a file wait."),
]
Part = Annotated[
    str, typer.Option("--partition", metavar="K/N", help="Answer only the share of events of process K of N.")
]
Format = Annotated[
    str, typer.Option("--format", metavar="NAME", help="Output format: ndjson, geojson, aircraft, cot or nmea.")
]
State = Annotated[
    Path | None, typer.Option("--state", metavar="FILE", help="Write checkpoints to this file, and continue from it.")
]
Every = Annotated[str, typer.Option("--every", metavar="TIME", help="Time between checkpoints.")]
Record = Annotated[Path | None, typer.Option("--record", metavar="FILE", help="Record the input lines.")]

Mqtt = Annotated[
    str | None, typer.Option("--mqtt", metavar="URL", help="Read a topic of an MQTT broker: mqtt://host:1883/topic.")
]
Zmq = Annotated[
    str | None,
    typer.Option("--zmq", metavar="URL", help="Read a ZeroMQ socket: tcp://host:5555, or pull+tcp://127.0.0.1:5555."),
]
Adapt = Annotated[
    str | None,
    choice("chirpstack|mode-s", "Format of the input lines from other systems.", "--adapter"),
]

Model = Annotated[
    str, typer.Option("--model", metavar="NAME", help="Motion model of tracks; see [bold]optloc track[/bold].")
]
Filter = Annotated[
    str, typer.Option("--filter", metavar="NAME", help="Filter of tracks; see [bold]optloc track[/bold].")
]
Noise = Annotated[
    float | None, typer.Option("--noise", metavar="SD", help="Process noise of tracks; see [bold]optloc track[/bold].")
]
Gap = Annotated[
    float | None,
    typer.Option(
        "--gap", metavar="SECONDS", help="Longest time without rows of tracks; see [bold]optloc track[/bold]."
    ),
]
Track = Annotated[bool, typer.Option("--track", help="Answer with states of tracks instead of fixes.")]

EXAMPLES = example(
    "feed | optloc live site.toml > fixes.ndjson",
    "optloc live site.toml --check",
    "optloc live site.toml --replay monday.ndjson --speed 10",
    "optloc live site.toml --state site.state --late revise",
)


def live(
    file: ProblemPath,
    method: Method = "auto",
    replay: Replay = None,
    speed: Speed = None,
    wait: Wait = "50 ms",
    late: Late = "drop",
    phases: Phases = "two",
    deadline: Deadline = None,
    shed: Shed = None,
    part: Part = "1/1",
    form: Format = "ndjson",
    state: State = None,
    every: Every = "5 s",
    record: Record = None,
    http: Http = None,
    hosts: Hosts = None,
    token_file: Tokens = None,
    no_token: NoToken = False,
    mqtt: Mqtt = None,
    zmq: Zmq = None,
    adapter: Adapt = None,
    track: Track = False,
    model: Model = "cv",
    filter_: Filter = "iekf",
    noise: Noise = None,
    gap: Gap = None,
    wave_speed: WaveSpeed = None,
    wind: Wind = None,
    two_way: TwoWay = False,
    turn_around: TurnAround = None,
    height: Height = None,
    check: Annotated[bool, typer.Option("--check", help="Print the input format of the stream, and end.")] = False,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fix events as they arrive: JSON lines are the input, fixes and proofs the output.

    The rows of FILE are the template of an event. Signals: TERM answers all waiting events and ends, HUP reloads FILE.
    """
    stated = site_options(wave_speed, wind, two_way, turn_around, height)
    if check:
        raise typer.Exit(run_check(file, method, stated))
    from optloc.service.process import ServiceOptions, run_stream

    settings = _settings(wait, late, phases, deadline, part, form)
    settings |= _tracking(model, filter_, noise, gap, track=track)
    settings |= {"state": state, "every": seconds_of(every, "--every"), "record": record}
    options = ServiceOptions(
        settings, method=method, recording=replay, speed=inf if speed is None else speed, shed=shed, quiet=quiet,
        http=http, mqtt=mqtt, zmq=zmq, adapter=adapter, stdin=not (mqtt or zmq), stated=stated,
        access=access_of(hosts or (), token_file, without_token=no_token),
    )  # fmt: skip
    raise typer.Exit(run_stream(file, options))


SERVED = example(
    "optloc serve site.toml",
    'curl -d \'{"event": "1", "z": [283.0, 1739.5, 1102.9, 524.3, 2344.4]}\' localhost:8200/fix',
    "optloc serve site.toml --http 0.0.0.0:8200 --token-file tokens.txt --mqtt mqtt://broker/toa/#",
)


def serve(
    file: ProblemPath,
    http: Annotated[
        str, typer.Option("--http", metavar="[HOST:]PORT", help="Address of the server; by default this machine only.")
    ] = "8200",
    hosts: Hosts = None,
    token_file: Tokens = None,
    no_token: NoToken = False,
    method: Method = "auto",
    wait: Wait = "50 ms",
    late: Late = "drop",
    deadline: Deadline = None,
    part: Part = "1/1",
    state: State = None,
    every: Every = "5 s",
    record: Record = None,
    mqtt: Mqtt = None,
    zmq: Zmq = None,
    adapter: Adapt = None,
    track: Track = False,
    model: Model = "cv",
    filter_: Filter = "iekf",
    noise: Noise = None,
    gap: Gap = None,
    wave_speed: WaveSpeed = None,
    wind: Wind = None,
    two_way: TwoWay = False,
    turn_around: TurnAround = None,
    height: Height = None,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fix events from HTTP requests: /fix, /track, /ws, /health, /metrics, a map at /, fixes as GeoJSON and aircraft.

    The command does not use standard input and standard output.
    """
    from optloc.service.process import ServiceOptions, run_stream

    settings = _settings(wait, late, "two", deadline, part, "ndjson")
    settings |= _tracking(model, filter_, noise, gap, track=track)
    settings |= {"state": state, "every": seconds_of(every, "--every"), "record": record}
    options = ServiceOptions(
        settings, method=method, shed=True, quiet=quiet,
        http=http, mqtt=mqtt, zmq=zmq, adapter=adapter, stdin=False, stdout=False,
        stated=site_options(wave_speed, wind, two_way, turn_around, height),
        access=access_of(hosts or (), token_file, without_token=no_token),
    )  # fmt: skip
    raise typer.Exit(run_stream(file, options))


def _settings(wait: str, late: str, phases: str, deadline: str | None, part: str, form: str) -> dict[str, Any]:
    """Return the values of options as arguments of `optloc.service.stream.Settings`; times in seconds.

    `wait` and `deadline` are texts with a unit. `late` is "drop" or "revise", and `part` a text such as "1/4". A
    deadline of None is decided later: it depends on the source.
    """
    from optloc.service.engine import PHASES
    from optloc.service.feeds import FORMATS

    return {
        "wait": seconds_of(wait, "--wait"),
        "revise": one_of(late, ("drop", "revise"), "--late") == "revise",
        "phases": one_of(phases, PHASES, "--phases"),
        "deadline": None if deadline is None else seconds_of(deadline, "--deadline"),
        "part": part_of(part),
        "format": one_of(form, tuple(FORMATS), "--format"),
    }


def _tracking(model: str, name: str, noise: float | None, gap: float | None, *, track: bool) -> dict[str, Any]:
    """Return the tracking options as arguments of `optloc.service.stream.Settings`.

    `model` is the motion model and `name` the filter. `noise` is the process noise and `gap` the longest time without
    rows, s; None for the default. The tracker is imported only if an option differs from its default.
    """
    if (model, name, noise, gap) == ("cv", "iekf", None, None):
        return {"track": track}
    from optloc.cli import TrackOptions, dynamics_of, rules
    from optloc.service.tracks import TrackSettings
    from optloc.tracking import Rules, filter_of

    dynamics = dynamics_of(TrackOptions(model, noise=noise))
    return {"track": track, "track_settings": TrackSettings(dynamics, filter_of(name), rules(Rules().gate, gap))}


def site_options(
    wave_speed: str | None, wind: str | None, two_way: bool, turn_around: str | None, height: str | None
) -> SiteOptions:
    """Return the options of a command that replace statements of the file of a site."""
    from optloc.files import WaveOptions
    from optloc.service.site import SiteOptions

    return SiteOptions(WaveOptions(wave_speed, wind, two_way or turn_around is not None, turn_around), height)


def run_check(file: Path, method: str, stated: SiteOptions | None = None) -> int:
    """Print the input lines that a stream of a site accepts, and return the exit code 0.

    `stated` has the options on the wave and the height, or None.
    """
    from optloc.service.site import read_site

    site = read_site(file, method, stated)
    for line in input_description(site):
        typer.echo(visible(line))
    return 0


def input_description(site: Site) -> Iterator[str]:
    """Yield a description of the input of a stream, with an example line of each form."""
    yield f"{site.title}: {len(site.rows)} rows of {len(site.stations)} stations, solved by {site.method}"
    yield "whole events: " + json.dumps({"event": "1", "z": [0.0] * len(site.rows)})
    row = site.rows[0]
    ends = {key: value for key, value in (("a", row.a), ("b", row.b)) if value}
    yield "single rows: " + json.dumps({"event": "1", "kind": row.kind, **ends, "z": 0.0})
    if site.arrival_rows:
        line = {"event": "1", "station": site.stations[site.arrival_stations[0]], "time_ns": 1_700_000_000_000_000_000}
        yield "arrivals: " + json.dumps(line)
    listed = ", ".join(site.name_of(i) for i in range(min(len(site.rows), 12)))
    yield f"z is: {listed}" + (" ..." if len(site.rows) > 12 else "")
    yield "an event is whole with " + (
        f"the arrivals of {', '.join(site.stations[i] for i in site.arrival_stations[:12])}"
        + (" ..." if len(site.arrival_stations) > 12 else "")
        if site.arrival_rows and not site.other_rows
        else f"all {len(site.rows)} rows"
    )


def part_of(text: str) -> tuple[int, int]:
    """Return the part (from 0) and the number of processes of a text such as "2/4"; raise InvalidProblem for others."""
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise InvalidProblem(f"{text!r} is not a part", "--partition", "write 1/4 for the first of four processes")
    return int(number) - 1, int(count)


def seconds_of(text: str, where: str) -> float:
    """Return a time such as "50 ms" in seconds; raise InvalidProblem for a number without a unit."""
    from optloc.files import Units

    value = Units("time").plain(text, None, where)
    if not value >= 0.0:
        raise InvalidProblem(f"{text!r} is negative", where, "give a time such as '50 ms'")
    return float(value)


def one_of(word: str, known: tuple[str, ...], where: str) -> str:
    """Return a word if it is in `known`; raise InvalidProblem with the option otherwise."""
    if word not in known:
        raise InvalidProblem(f"{word!r} is unknown", where, nearest(word, known))
    return word
