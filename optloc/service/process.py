"""The process of a service: it connects a stream to its sources, its output and signals, until the stream ends."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf
from pathlib import Path
from threading import Event, current_thread, main_thread
from typing import Any

from optloc.cli import READER_GONE, STOPPED
from optloc.files import claim
from optloc.problem import InvalidProblem
from optloc.service.adapters import Adapter, adapter_of
from optloc.service.brokers import mqtt, zeromq
from optloc.service.http_options import AccessRules, address_of
from optloc.service.recording import Recorded, read_recording, replay
from optloc.service.serve import serve
from optloc.service.site import SiteOptions, read_site
from optloc.service.standard_error import standard_error
from optloc.service.standard_input import input_of, is_file, standard_input
from optloc.service.stream import Settings, Stream
from optloc.service.supervisor import LineSource, Watch

SOURCE_FAILED = 3
"""Exit code of a stream that ends while one of its sources does not work."""

# Thread switch interval, s: the first phase must not wait 5 ms for the second.
_SWITCH = 5e-4
# One processor suffices: batches of a stream are small. Without machine code, plain Python answers while a background
# process compiles, if permitted.
_ENVIRONMENT = {"OPTLOC_THREADS": "1", "OPTLOC_COMPILE": "child"}


@dataclass(frozen=True, slots=True)
class ServiceOptions:
    """Options of the commands `live` and `serve`.

    Parameters
    ----------
    settings : dict
        Arguments of `optloc.service.stream.Settings` except `shed`, which depends on the source.
    method : str
        Method of the fixes.
    recording : Path, optional
        File to read instead of standard input.
    speed : float
        Replay speed relative to the recording.
    shed : bool, optional
        Whether proofs are skipped under load; None means yes, unless the source can wait.
    quiet : bool
        Whether messages and health are not printed.
    http, mqtt, zmq, adapter : str, optional
        Values of the options of these names.
    stdin : bool
        Whether lines come from standard input if there is no recording.
    stdout : bool
        Whether answers go to standard output.
    stated : SiteOptions, optional
        Options on the wave and the height.
    access : AccessRules, optional
        Rules of access to HTTP.
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


def run_stream(file: Path, options: ServiceOptions) -> int:
    """Run a stream until its source ends or a signal arrives, and return the exit code, as in `wait`.

    `file` is the problem file of the site. All threads of the stream have ended after the return, and after an error.
    """
    if not options.speed > 0.0:
        raise InvalidProblem(f"the speed is {options.speed:g}, not positive", "--speed", "give a positive number")
    site = read_site(file, options.method, options.stated)
    adapter = None if options.adapter is None else adapter_of(options.adapter, site.stations)
    recording = None if options.recording is None else read_recording(options.recording)
    settings = _settings_of(options)
    claim(settings.record, inputs=[file])
    with (
        _stream_environment(),
        standard_error(quiet=options.quiet) as (say, messages),
        Stream(site, settings, _writer(options), say, site_file=file, replayed=recording is not None) as stream,
        _signal_handlers(stream) as interrupted,  # before the first line is read
    ):
        stream.watch_output(messages)
        if settings.track and stream.track_refusal:
            raise InvalidProblem(stream.track_refusal, "--track", "remove this option")
        opened = _start_servers(options, stream, adapter)
        say(f"ready: {site.title!r}, {len(site.rows)} rows of {len(site.stations)} stations{opened}")
        _start_reading(options, stream, adapter, recording)
        code = wait(stream, interrupted)
        failed = stream.sources.failed
        if failed:
            say(f"The stream ends with exit code {code}, because these sources do not work: {', '.join(failed)}.")
        say(json.dumps({"health": stream.health()}))
    return code


def _settings_of(options: ServiceOptions) -> Settings:
    """Return the settings of a stream; options that are None have their default values."""
    # lines of a file can wait, so no proof needs to be skipped, and no proof needs a deadline
    waits = options.recording is not None or (options.stdin and is_file(sys.stdin))
    shed = not waits if options.shed is None else options.shed
    given = {key: value for key, value in options.settings.items() if value is not None}
    return Settings(shed=shed, **({} if shed else {"deadline": inf}) | given)


def _start_servers(options: ServiceOptions, stream: Stream, adapter: Adapter | None) -> str:
    """Start the HTTP, MQTT and ZeroMQ sources, and return the address of HTTP for the ready message; "" without one."""
    opened = ""
    if options.http is not None:
        host, port = address_of(options.http)
        number, _ = serve(stream, host, port, options.access)
        opened = f", http://{f'[{host}]' if ':' in host else host}:{number}/"
    for address, source in ((options.mqtt, mqtt), (options.zmq, zeromq)):
        if address is not None:
            stream.start(source(stream, address, adapter))
    return opened


def _start_reading(
    options: ServiceOptions, stream: Stream, adapter: Adapter | None, recording: list[Recorded] | None
) -> None:
    """Read a recording or standard input in a separate thread, if requested."""
    if recording is not None:
        name = str(options.recording)

        def run(_: Watch) -> None:
            """Read the recording."""
            replay(recording, stream, options.speed, name, adapter)

        stream.start(LineSource(name, run, is_last=True, tries=0))  # a second attempt would repeat the first lines
    elif options.stdin:
        stream.start(standard_input(stream, input_of(sys.stdin), adapter))


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


@contextmanager
def _stream_environment() -> Iterator[None]:
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


def _writer(options: ServiceOptions) -> Callable[[bytes], None]:
    """Return a function that writes bytes to standard output at once, or ignores them if the answers go elsewhere."""
    if not options.stdout:
        return lambda data: None
    file = sys.stdout.buffer

    def write(data: bytes) -> None:
        """Write bytes without a buffer that delays answers."""
        file.write(data)
        file.flush()

    return write
