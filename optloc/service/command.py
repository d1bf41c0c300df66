"""`optloc live` and `optloc serve`: fixes from a stream, until it ends or is told to."""

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
from threading import Event, Thread, current_thread, main_thread
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optloc.cli import READER_GONE, STOPPED, Budget, Force, Method, Outside, ProblemPath, Quiet, Verbose, example
from optloc.files import claim, visible
from optloc.problem import InvalidProblem, nearest

if TYPE_CHECKING:
    from optloc.service.recording import Recorded
    from optloc.service.site import Site
    from optloc.service.sources import Adapter
    from optloc.service.stream import Stream

# The stream itself is imported inside the commands, so that --help answers at once.

# Seconds after which a thread that runs Python gives way: the first phase is not to wait 5 ms for the second.
_SWITCH = 5e-4

Replay = Annotated[
    Path | None,
    typer.Option("--replay", metavar="FILE", help="Read a recording, or the epochs of a problem file (.toml)."),
]
Speed = Annotated[
    float | None, typer.Option(metavar="N", help="How many times as fast as it was recorded; as fast as it goes.")
]
Wait = Annotated[str, typer.Option(metavar="TIME", help="How long after its first row an event closes.")]
Late = Annotated[str, typer.Option(metavar="drop|revise", help="Whether late rows make a new answer.")]
Phases = Annotated[
    str, typer.Option(metavar="two|one|fix", help="A fix at once and its proof later, both in one, or no proof.")
]
Deadline = Annotated[
    str | None, typer.Option(metavar="TIME", help="When a proof is given up; 1 s, never where a file is read.")
]
Shed = Annotated[
    bool | None,
    typer.Option("--shed/--no-shed", help="Skip proofs under load, or let rows wait; rows of a file wait."),
]
Part = Annotated[
    str, typer.Option("--partition", metavar="K/N", help="Answer the events of the Kth of N processes only.")
]
Format = Annotated[str, typer.Option("--format", metavar="NAME", help="ndjson, geojson, aircraft, cot or nmea.")]
State = Annotated[Path | None, typer.Option("--state", metavar="FILE", help="Keep a checkpoint, and go on from it.")]
Every = Annotated[str, typer.Option("--every", metavar="TIME", help="How often the checkpoint is written.")]
Record = Annotated[Path | None, typer.Option("--record", metavar="FILE", help="Keep the lines that are read.")]

Http = Annotated[
    str | None, typer.Option("--http", metavar="[HOST:]PORT", help="Take requests, too; this machine alone by default.")
]
Mqtt = Annotated[
    str | None, typer.Option("--mqtt", metavar="URL", help="Read a topic of a broker: mqtt://host:1883/topic.")
]
Zmq = Annotated[
    str | None,
    typer.Option("--zmq", metavar="URL", help="Read a socket: tcp://host:5555, or pull+tcp://127.0.0.1:5555."),
]
Adapt = Annotated[
    str | None, typer.Option("--adapter", metavar="chirpstack|mode-s", help="Lines are in the format of others.")
]

Model = Annotated[str, typer.Option("--model", metavar="NAME", help="Of tracks: as of [bold]optloc track[/bold].")]
Filter = Annotated[str, typer.Option("--filter", metavar="NAME", help="Of tracks, likewise.")]
Noise = Annotated[float | None, typer.Option("--noise", metavar="SD", help="Of tracks, likewise.")]
Gap = Annotated[float | None, typer.Option("--gap", metavar="SECONDS", help="Of tracks, likewise.")]
Track = Annotated[bool, typer.Option("--track", help="Answer the states of targets' tracks in the place of fixes.")]

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
    mqtt: Mqtt = None,
    zmq: Zmq = None,
    adapter: Adapt = None,
    track: Track = False,
    model: Model = "cv",
    filter_: Filter = "iekf",
    noise: Noise = None,
    gap: Gap = None,
    check: Annotated[bool, typer.Option("--check", help="Say what the stream would take, and end.")] = False,
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fix events as they come: lines of JSON in, fixes and their proofs out.

    The rows of FILE are the template of an event. Signals: TERM answers what is there and ends, HUP reads FILE anew.
    """
    if check:
        raise typer.Exit(run_check(file, method))
    settings = _settings(wait, late, phases, deadline, part, form) | {"state": state, "record": record}
    settings |= _tracking(model, filter_, noise, gap, track=track)
    settings["every"] = seconds_of(every, "--every")
    speed = inf if speed is None else speed
    asked = ServiceOptions(
        settings, method, replay, speed, shed, quiet, http, mqtt, zmq, adapter, stdin=not (mqtt or zmq)
    )
    raise typer.Exit(run_live(file, asked))


SERVED = example(
    "optloc serve site.toml",
    'curl -d \'{"event": "1", "z": [283.0, 1739.5, 1102.9, 524.3, 2344.4]}\' localhost:8200/fix',
    "optloc serve site.toml --http 0.0.0.0:8200 --mqtt mqtt://broker/toa/#",
)


def serve(
    file: ProblemPath,
    http: Annotated[
        str, typer.Option("--http", metavar="[HOST:]PORT", help="Where; this machine alone by default.")
    ] = "8200",
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
    outside: Outside = False,
    budget: Budget = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fix events that come by HTTP: /fix, /track, /ws, /health, /metrics, a map at /, fixes as GeoJSON and aircraft.

    Nothing is read from standard input, and nothing written to standard output.
    """
    settings = _settings(wait, late, "two", deadline, part, "ndjson") | {"state": state, "record": record}
    settings |= _tracking(model, filter_, noise, gap, track=track)
    settings["every"] = seconds_of(every, "--every")
    asked = ServiceOptions(
        settings, method, None, inf, True, quiet, http, mqtt, zmq, adapter, stdin=False, stdout=False
    )
    raise typer.Exit(run_live(file, asked))


def _settings(wait: str, late: str, phases: str, deadline: str | None, part: str, form: str) -> dict[str, Any]:
    """Return what options say as arguments of `optloc.service.stream.Settings`."""
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
    """Return how tracks are made, as arguments of `optloc.service.stream.Settings`."""
    if (model, name, noise, gap) == ("cv", "iekf", None, None):
        return {"track": track}
    from optloc.cli import TrackOptions, dynamics_of, rules
    from optloc.service.tracks import Following
    from optloc.tracking import Rules, filter_of

    dynamics = dynamics_of(TrackOptions(model, noise=noise))
    return {"track": track, "following": Following(dynamics, filter_of(name), rules(Rules().gate, gap))}


@dataclass(frozen=True, slots=True)
class ServiceOptions:
    """What the options of the command say.

    Parameters
    ----------
    settings : Settings
        How the stream answers; whether it sheds proofs under load is seen from its source.
    method : str
        How events are solved.
    recording : Path, optional
        What is read instead of standard input.
    speed : float
        How many times as fast as it was recorded.
    shed : bool, optional
        Whether proofs are skipped under load; by default where rows come by themselves.
    quiet : bool
        Whether health is left unsaid.
    http, mqtt, zmq, adapter : str, optional
        As the options.
    stdin, stdout : bool
        Whether lines come from standard input where there is no recording, and answers go to standard output.
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


def run_live(file: Path, asked: ServiceOptions) -> int:
    """Run a stream until its source ends or a signal comes, and return the exit code."""
    from optloc.service.recording import read_recording
    from optloc.service.site import read_site
    from optloc.service.sources import adapter_of
    from optloc.service.stream import Settings, Stream

    if not asked.speed > 0.0:
        raise InvalidProblem(f"the speed is {asked.speed:g}", "--speed", "give a positive number")
    site = read_site(file, asked.method)
    adapter = None if asked.adapter is None else adapter_of(asked.adapter, site.stations)
    recording = None if asked.recording is None else read_recording(asked.recording)
    # what stands in a file has waited already: nothing is lost by waiting once more
    waits = recording is not None or (asked.stdin and _is_file(sys.stdin))
    shed = not waits if asked.shed is None else asked.shed
    given = asked.settings | ({"deadline": inf} if not shed and asked.settings.get("deadline") is None else {})
    settings = Settings(shed=shed, **{key: value for key, value in given.items() if value is not None})
    claim(settings.record, inputs=[file])
    say = _silent if asked.quiet else _say
    write = _write(sys.stdout.buffer) if asked.stdout else _silent
    with _threads(), ExitStack() as stops:
        stream = Stream(site, settings, write, say, again=file, replayed=recording is not None)
        stops.callback(stream.close)  # where a source cannot be opened
        if settings.track and stream.untracked:
            raise InvalidProblem(stream.untracked, "--track", "leave it out")
        interrupted = stops.enter_context(_obeying(stream))  # before anything is read
        places = _open(asked, stream, adapter, stops)
        say(f"ready: {site.title!r}, {len(site.rows)} rows of {len(site.stations)} stations{places}")
        _read(asked, stream, adapter, recording)
        code = wait(stream, interrupted)
    say(json.dumps({"health": stream.health()}))
    return code


def _open(asked: ServiceOptions, stream: Stream, adapter: Adapter | None, stops: ExitStack) -> str:
    """Open the sources that are none of files, and return what is said of them."""
    from optloc.service import serve as requests
    from optloc.service.sources import mqtt, zeromq

    said = ""
    if asked.http is not None:
        host, _, port = asked.http.rpartition(":")
        if not port.isdecimal():
            raise InvalidProblem(f"{asked.http!r} is no port", "--http", "write 8200, or 0.0.0.0:8200")
        host = host.strip("[]") or requests.HOST
        number, stop = requests.serve(stream, host, int(port))
        stops.callback(stop)
        said = f", http://{f'[{host}]' if ':' in host else host}:{number}/"
    for address, begin in ((asked.mqtt, mqtt), (asked.zmq, zeromq)):
        if address is not None:
            stops.callback(begin(stream, address, adapter))
    return said


def _read(asked: ServiceOptions, stream: Stream, adapter: Adapter | None, recording: list[Recorded] | None) -> None:
    """Read a recording or standard input in a thread of its own, if that is wanted."""
    from optloc.service.recording import replay
    from optloc.service.stream import read_lines

    if recording is not None:
        lines = recording if adapter is None else [each._replace(data=adapter(each.data)) for each in recording]
        _begin(lambda: replay(lines, stream, asked.speed, str(asked.recording)), stream)
    elif asked.stdin:
        read, pending = _reader(sys.stdin)
        _begin(lambda: read_lines(read, stream, "stdin", adapter, pending), stream)


def run_check(file: Path, method: str) -> int:
    """Say what a stream of a site takes and answers."""
    from optloc.service.site import read_site

    site = read_site(file, method)
    for line in told(site):
        typer.echo(visible(line))
    return 0


def told(site: Site) -> Iterator[str]:
    """Yield what a stream of a site takes, with a line of each sort that would be answered."""
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


def wait(stream: Stream, interrupted: Event) -> int:
    """Return the exit code of a stream when it has ended."""
    # with a timeout: on Windows a wait without one hears no signals
    while not stream.ended.wait(1.0):
        pass
    if stream.error is not None:
        raise stream.error
    return STOPPED if interrupted.is_set() else READER_GONE if stream.failed else 0


@contextmanager
def _obeying(stream: Stream) -> Iterator[Event]:
    """Let signals end a stream, or have it read its site anew; what is yielded is set by Ctrl-C."""
    interrupted = Event()

    def stop(number: int, _: Any) -> None:
        if number == signal.SIGINT:
            interrupted.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a second Ctrl-C does not wait
        stream.close()

    with _signals({"SIGTERM": stop, "SIGINT": stop, "SIGHUP": lambda *_: stream.reload()}):
        yield interrupted


@contextmanager
def _signals(wanted: dict[str, Callable[[int, Any], None]]) -> Iterator[None]:
    """Handle signals, those that the system has, as long as the block lasts."""
    if current_thread() is not main_thread():
        yield
        return
    old = {name: signal.signal(getattr(signal, name), how) for name, how in wanted.items() if hasattr(signal, name)}
    try:
        yield
    finally:
        for name, how in old.items():
            signal.signal(getattr(signal, name), how)


# One processor does: batches of a stream are small. And who has no machine code yet is answered by plain Python while a
# process in the background makes it, where that may be.
_ENVIRONMENT = {"OPTLOC_THREADS": "1", "OPTLOC_COMPILE": "child"}


@contextmanager
def _threads() -> Iterator[None]:
    """Let threads give way quickly, and the environment be that of a stream where it says nothing else."""
    old, own = sys.getswitchinterval(), {name: _ENVIRONMENT[name] for name in _ENVIRONMENT.keys() - os.environ.keys()}
    sys.setswitchinterval(_SWITCH)
    os.environ.update(own)
    try:
        yield
    finally:
        sys.setswitchinterval(old)
        for name in own:
            os.environ.pop(name, None)


def _begin(source: Callable[[], None], stream: Stream) -> None:
    """Read a source in a thread of its own, and let the stream end behind it."""

    def run() -> None:
        try:
            source()
        finally:
            stream.close()

    Thread(target=run, name="optloc input", daemon=True).start()


def _write(file: Any) -> Callable[[bytes], None]:
    def write(data: bytes) -> None:
        file.write(data)
        file.flush()

    return write


def _reader(file: Any) -> tuple[Callable[[int], bytes], Callable[[], bool]]:
    """Return what reads as soon as there is something, without a lock that the end of the process would wait for.

    And what says whether there is something.
    """
    try:
        number = file.fileno()
    except (OSError, AttributeError, ValueError):
        return file.buffer.read1, bool  # in memory, as in tests

    def pending() -> bool:
        try:
            return bool(select.select([number], [], [], 0.0)[0])
        except (OSError, ValueError):
            return False  # Windows says so of sockets only

    return lambda count: os.read(number, count), pending


def _say(line: str) -> None:
    typer.echo(visible(line), err=True)


def _silent(_: str | bytes) -> None:
    pass


def _is_file(file: Any) -> bool:
    """Return whether a stream is a file, which waits for its reader."""
    try:
        return stat.S_ISREG(os.fstat(file.fileno()).st_mode)
    except (OSError, AttributeError, ValueError):
        return True  # what has no number, as in tests, is in memory


def part_of(text: str) -> tuple[int, int]:
    """Return which of how many processes this is, from "2/4"; raise InvalidProblem where that is not said."""
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise InvalidProblem(f"{text!r} is no part", "--partition", "write 1/4 for the first of four processes")
    return int(number) - 1, int(count)


def seconds_of(text: str, where: str) -> float:
    """Return a time such as "50 ms" in seconds; raise InvalidProblem for a number without a unit."""
    from optloc.files import Units

    value = Units("time").plain(text, None, where)
    if not value >= 0.0:
        raise InvalidProblem(f"{text!r} is negative", where, "give a time such as '50 ms'")
    return float(value)


def one_of(word: str, known: tuple[str, ...], where: str) -> str:
    """Return a word that is known; raise InvalidProblem naming the option."""
    if word not in known:
        raise InvalidProblem(f"{word!r} is unknown", where, nearest(word, known))
    return word
