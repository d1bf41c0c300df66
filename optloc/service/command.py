"""The commands ``optloc live`` and ``optloc serve``: fixes from a stream, until the stream or a signal ends."""

from __future__ import annotations

import json
import os
import select
import signal
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from math import inf
from pathlib import Path
from threading import Event, current_thread, main_thread
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optloc.cli import (
    READER_GONE,
    STOPPED,
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
from optloc.files import claim, visible
from optloc.problem import InvalidProblem, nearest
from optloc.service.http_options import AccessRules, Hosts, Http, NoToken, Tokens, access_of, address_of

if TYPE_CHECKING:
    from optloc.service.adapters import Adapter
    from optloc.service.recording import Recorded
    from optloc.service.site import Site, SiteOptions
    from optloc.service.stream import Stream

# Import the stream inside the commands, so that --help prints without delay.

# Thread switch interval, s: the first phase must not wait 5 ms for the second.
_SWITCH = 5e-4

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
    if check:
        raise typer.Exit(run_check(file, method, site_options(wave_speed, wind, two_way, turn_around, height)))
    settings = _settings(wait, late, phases, deadline, part, form) | {"state": state, "record": record}
    settings |= _tracking(model, filter_, noise, gap, track=track)
    settings["every"] = seconds_of(every, "--every")
    speed = inf if speed is None else speed
    options = ServiceOptions(
        settings, method, replay, speed, shed, quiet, http, mqtt, zmq, adapter, stdin=not (mqtt or zmq),
        stated=site_options(wave_speed, wind, two_way, turn_around, height),
        access=access_of(hosts or (), token_file, without_token=no_token),
    )  # fmt: skip
    raise typer.Exit(run_live(file, options))


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
    settings = _settings(wait, late, "two", deadline, part, "ndjson") | {"state": state, "record": record}
    settings |= _tracking(model, filter_, noise, gap, track=track)
    settings["every"] = seconds_of(every, "--every")
    options = ServiceOptions(
        settings, method, None, inf, True, quiet, http, mqtt, zmq, adapter, stdin=False, stdout=False,
        stated=site_options(wave_speed, wind, two_way, turn_around, height),
        access=access_of(hosts or (), token_file, without_token=no_token),
    )  # fmt: skip
    raise typer.Exit(run_live(file, options))


def _settings(wait: str, late: str, phases: str, deadline: str | None, part: str, form: str) -> dict[str, Any]:
    """Return the values of options as arguments of `optloc.service.stream.Settings`; times in seconds.

    `wait` and `deadline` are texts with a unit. `late` is "drop" or "revise", and `part` a text such as "1/4". A
    deadline of None is decided later: it depends on the source.
    """
    from optloc.service.answers import FORMATS
    from optloc.service.engine import PHASES

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
    from optloc.service.tracks import Following
    from optloc.tracking import Rules, filter_of

    dynamics = dynamics_of(TrackOptions(model, noise=noise))
    return {"track": track, "following": Following(dynamics, filter_of(name), rules(Rules().gate, gap))}


@dataclass(frozen=True, slots=True)
class ServiceOptions:
    """Options of the commands `live` and `serve`.

    settings: arguments of the stream settings except `shed`, which depends on the source. method: method of the fixes.
    recording: file to read instead of standard input. speed: replay speed relative to the recording. shed: whether
    proofs are skipped under load; None means yes, unless the source can wait. quiet: whether messages and health are
    not printed. http, mqtt, zmq, adapter: as the options. stdin: whether lines come from standard input if there is no
    recording. stdout: whether answers go to standard output. stated: options on the wave and the height, or None.
    access: rules of access to HTTP, or None.
    """

    settings: dict[str, Any]
    method: str = "auto"
    recording: Path | None = None
    speed: float = inf
    shed: bool | None = None
    quiet: bool = False
    http: str | None = None
    mqtt: str | None = None
    zmq: str | None = None
    adapter: str | None = None
    stdin: bool = True
    stdout: bool = True
    stated: SiteOptions | None = None
    access: AccessRules | None = None


def run_live(file: Path, options: ServiceOptions) -> int:
    """Run a stream until its source ends or a signal arrives, and return the exit code, as in `wait`.

    `file` is the problem file of the site.
    """
    from optloc.service.adapters import adapter_of
    from optloc.service.recording import read_recording
    from optloc.service.site import read_site
    from optloc.service.standard_error import standard_error
    from optloc.service.stream import Settings, Stream

    if not options.speed > 0.0:
        raise InvalidProblem(f"the speed is {options.speed:g}, not positive", "--speed", "give a positive number")
    site = read_site(file, options.method, options.stated)
    adapter = None if options.adapter is None else adapter_of(options.adapter, site.stations)
    recording = None if options.recording is None else read_recording(options.recording)
    # lines of a file can wait, so no proof needs to be skipped
    waits = recording is not None or (options.stdin and _is_file(sys.stdin))
    shed = not waits if options.shed is None else options.shed
    # If no proof is skipped, the default deadline is infinite. Settings that are None keep their default values.
    given = options.settings | ({"deadline": inf} if not shed and options.settings.get("deadline") is None else {})
    settings = Settings(shed=shed, **{key: value for key, value in given.items() if value is not None})
    claim(settings.record, inputs=[file])
    write = _write(sys.stdout.buffer) if options.stdout else _silent
    with _threads(), standard_error(quiet=options.quiet) as (say, messages), ExitStack() as stops:
        stream = Stream(site, settings, write, say, again=file, replayed=recording is not None)
        stream.watch_output(messages)
        stops.callback(stream.sources.stop)
        stops.callback(stream.close)  # also if a source cannot be opened
        if settings.track and stream.untracked:
            raise InvalidProblem(stream.untracked, "--track", "remove this option")
        interrupted = stops.enter_context(_signal_handlers(stream))  # before the first line is read
        places = _open(options, stream, adapter)
        say(f"ready: {site.title!r}, {len(site.rows)} rows of {len(site.stations)} stations{places}")
        _read(options, stream, adapter, recording)
        code = wait(stream, interrupted)
        stream.sources.stop()  # so that no line comes after the last line of health
        failed = stream.sources.failed
        if failed:
            say(f"The stream ends with exit code {code}, because these sources do not work: {', '.join(failed)}.")
        say(json.dumps({"health": stream.health()}))
    return code


def _open(options: ServiceOptions, stream: Stream, adapter: Adapter | None) -> str:
    """Start the HTTP, MQTT and ZeroMQ sources, and return a text on them for the ready message."""
    from optloc.service import serve as requests
    from optloc.service.sources import mqtt, zeromq

    opened = ""
    if options.http is not None:
        host, port = address_of(options.http)
        number, _ = requests.serve(stream, host, port, options.access)
        opened = f", http://{f'[{host}]' if ':' in host else host}:{number}/"
    for address, begin in ((options.mqtt, mqtt), (options.zmq, zeromq)):
        if address is not None:
            stream.start(begin(stream, address, adapter))
    return opened


def _read(options: ServiceOptions, stream: Stream, adapter: Adapter | None, recording: list[Recorded] | None) -> None:
    """Read a recording or standard input in a separate thread, if requested."""
    from optloc.service.recording import replay
    from optloc.service.sources import standard_input
    from optloc.service.supervisor import LineSource, Watch

    if recording is not None:
        name = str(options.recording)

        def run(_: Watch) -> None:
            """Read the recording."""
            replay(recording, stream, options.speed, name, adapter)

        stream.start(LineSource(name, run, is_last=True, tries=0))  # a second attempt would repeat the first lines
    elif options.stdin:
        read, pending = _reader(sys.stdin)
        stream.start(standard_input(stream, read, adapter, pending))


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
    if site.arriving:
        line = {"event": "1", "station": site.stations[site.hearing[0]], "time_ns": 1_700_000_000_000_000_000}
        yield "arrivals: " + json.dumps(line)
    listed = ", ".join(site.name_of(i) for i in range(min(len(site.rows), 12)))
    yield f"z is: {listed}" + (" ..." if len(site.rows) > 12 else "")
    yield "an event is whole with " + (
        f"the arrivals of {', '.join(site.stations[i] for i in site.hearing[:12])}"
        + (" ..." if len(site.hearing) > 12 else "")
        if site.arriving and not site.others
        else f"all {len(site.rows)} rows"
    )


SOURCE_FAILED = 3
"""Exit code of a stream that ends while one of its sources does not work."""


def wait(stream: Stream, interrupted: Event) -> int:
    """Wait for the end of a stream and return its exit code; raise the error that ended the stream, if any.

    The code is `STOPPED` after Ctrl-C (`interrupted` is set), `READER_GONE` if the output was closed, `SOURCE_FAILED`
    if a source does not work, and 0 otherwise.
    """
    # on Windows, a wait without a timeout blocks signals
    while not stream.ended.wait(1.0):
        pass
    if stream.error is not None:
        raise stream.error
    if interrupted.is_set() or stream.failed:
        return STOPPED if interrupted.is_set() else READER_GONE
    return SOURCE_FAILED if stream.sources.failed else 0


@contextmanager
def _signal_handlers(stream: Stream) -> Iterator[Event]:
    """End a stream at SIGTERM or SIGINT, and reload its site at SIGHUP, within the block.

    Yield an event that SIGINT (Ctrl-C) sets, since the exit code then differs.
    """
    interrupted = Event()

    def stop(number: int, _: Any) -> None:
        """End the stream at a signal."""
        if number == signal.SIGINT:
            interrupted.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a second Ctrl-C interrupts at once
        stream.close()

    with _signals({"SIGTERM": stop, "SIGINT": stop, "SIGHUP": lambda *_: stream.reload()}):
        yield interrupted


@contextmanager
def _signals(handlers: dict[str, Callable[[int, Any], None]]) -> Iterator[None]:
    """Handle signals by functions within the block: `handlers` has the functions by the name of the signal.

    Signals that the operating system lacks are left out. Python allows handlers in the main thread only, so another
    thread sets none.
    """
    if current_thread() is not main_thread():
        yield
        return
    old = {name: signal.signal(getattr(signal, name), how) for name, how in handlers.items() if hasattr(signal, name)}
    try:
        yield
    finally:
        for name, how in old.items():
            signal.signal(getattr(signal, name), how)


# One processor suffices: batches of a stream are small. Without machine code, plain Python answers while a background
# process compiles, if permitted.
_ENVIRONMENT = {"OPTLOC_THREADS": "1", "OPTLOC_COMPILE": "child"}


@contextmanager
def _threads() -> Iterator[None]:
    """Set a short thread switch interval, and the environment of a stream unless variables are already set."""
    old, added = sys.getswitchinterval(), {name: _ENVIRONMENT[name] for name in _ENVIRONMENT.keys() - os.environ.keys()}
    sys.setswitchinterval(_SWITCH)
    os.environ.update(added)
    try:
        yield
    finally:
        sys.setswitchinterval(old)
        for name in added:
            os.environ.pop(name, None)


def _write(file: Any) -> Callable[[bytes], None]:
    """Return a function that writes bytes to a binary file at once, without a buffer that delays answers."""

    def write(data: bytes) -> None:
        file.write(data)
        file.flush()

    return write


def _reader(file: Any) -> tuple[Callable[[int], bytes], Callable[[], bool]]:
    """Return a function that reads available bytes, and a function that returns whether bytes are available.

    The first function takes the largest number of bytes. It reads the file descriptor without the lock of Python's
    buffer, since the end of the process would wait for this lock. Files in memory have no descriptor: their second
    function returns False.
    """
    try:
        descriptor = file.fileno()
    except (OSError, AttributeError, ValueError):
        return file.buffer.read1, bool  # in memory, as in tests

    def pending() -> bool:
        """Return whether the file has bytes that can be read without waiting."""
        try:
            return bool(select.select([descriptor], [], [], 0.0)[0])
        except (OSError, ValueError):
            return False  # on Windows, select works for sockets only

    def read(count: int) -> bytes:
        """Return at most `count` available bytes; wait for the first byte."""
        while True:
            try:
                return os.read(descriptor, count)
            except BlockingIOError:  # the writer of the pipe has set the mode that never waits
                select.select([descriptor], [], [])

    return read, pending


def _silent(_: str | bytes) -> None:
    """Ignore a line: the output of `--quiet`, and of a command without standard output."""


def _is_file(file: Any) -> bool:
    """Return whether an input is a regular file, or in memory: its data can wait, unlike the data of a pipe."""
    try:
        return stat.S_ISREG(os.fstat(file.fileno()).st_mode)
    except (OSError, AttributeError, ValueError):
        return True  # a stream without a file number is in memory, as in tests


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
