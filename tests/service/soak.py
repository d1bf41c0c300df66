"""Parts of the soak test: senders that send again what was not answered, a process that is killed, and its answers."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path

import numpy as np
from service.broker import Broker
from service.lines import balanced, line

# Seconds after which an event without an answer is sent again.
AGAIN = 4.0
# Largest size of a file of the process, bytes: a recording is then as on a full disk. Checkpoints are smaller.
ROOM = 2_500_000
# A program that runs its arguments with this limit.
LIMITED = f"""
import os, resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, ({ROOM}, {ROOM}))
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return taken.getsockname()[1]


def garbage(rng):
    """Return random bytes, or a line that was once good, with some bytes replaced; its event is none of the test's."""
    if rng.random() < 0.3:
        return rng.bytes(int(rng.integers(1, 200))).replace(b"\n", b"x")
    data = bytearray(line(event="g", z=[1.0, 2.0, None, 4.0, 5.0], target="t"))
    for _ in range(int(rng.integers(1, 4))):
        data[int(rng.integers(len(data)))] = int(rng.integers(256))
    return bytes(data).replace(b"\n", b"x").replace(b"event-", b"")


class Service:
    """The process under test: it is started, killed and ended; its answers and its lines of health are checked.

    answered: revisions of the answers of each event and phase, in their order. healths: number of checked accounts.
    """

    def __init__(self, folder, broker):
        self.folder, self.answered, self.healths, self.starts = folder, {}, 0, 0
        self.http, self.pull, self._broker, self._threads = free_port(), free_port(), broker, []
        self.last, self.alarms, self.errors = {}, set(), []
        self.up = threading.Event()  # whether the process reads

    def start(self):
        """Start the process, and wait until it is ready."""
        words = [sys.executable, "-c", LIMITED, "-m", "optloc.cli", "live", "site.toml"]
        words += ["--state", "s.state", "--every", "1 s"]
        words += ["--record", f"record{self.starts}.ndjson", "--http", str(self.http)]
        words += ["--mqtt", f"mqtt://127.0.0.1:{self._broker.port}/t", "--zmq", f"pull+tcp://127.0.0.1:{self.pull}"]
        self.starts += 1
        self.process = subprocess.Popen(words, cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        ready = threading.Event()
        self._threads = [
            threading.Thread(target=self._read_answers, args=(self.process.stdout,), daemon=True),
            threading.Thread(target=self._read_said, args=(self.process.stderr, ready), daemon=True),
        ]
        for each in self._threads:
            each.start()
        if not ready.wait(120.0):
            raise AssertionError(f"the process is not ready: {self.errors}")
        self.up.set()

    def kill(self):
        """Kill the process while it gets events, and read what it has written."""
        self.process.send_signal(signal.SIGKILL)
        self.up.clear()
        self._wait()

    def end(self):
        """End the process by a signal, and return its exit code."""
        self.process.send_signal(signal.SIGTERM)
        return self._wait()

    def _wait(self):
        code = self.process.wait(120.0)
        for each in self._threads:
            each.join(60.0)
        return code

    def memory(self):
        """Return the resident megabytes of the process."""
        return int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]) * 4096 / 1e6

    def health(self):
        """Return the health over HTTP, with its account checked; None if the process does not answer."""
        with (
            suppress(OSError, ValueError),
            urllib.request.urlopen(f"http://127.0.0.1:{self.http}/health", None, 5) as f,
        ):
            return self._check(json.loads(f.read()))
        return None

    def _check(self, health):
        try:
            balanced(health)
        except AssertionError as error:
            self.errors.append(f"the account does not balance: {error}")
        self.healths += 1
        self.alarms |= {(alarm["part"], alarm["name"]) for alarm in health["alarms"]}
        self.last = health
        return health

    def _read_answers(self, file):
        for each in file:
            if not each.endswith(b"\n"):
                continue  # a line that a kill has cut
            record = json.loads(each)
            if not str(record.get("event", "")).startswith("event-") or "note" in record:
                continue
            revisions = self.answered.setdefault((record["event"], record["phase"]), [])
            revisions.append(record.get("revision", 1))

    def _read_said(self, file, ready):
        for each in file:
            if each.startswith(b"ready: "):
                ready.set()
            elif each.startswith(b'{"health"'):
                with suppress(ValueError):  # a line that a kill has cut
                    self._check(json.loads(each)["health"])
            elif b"Traceback" in each:
                self.errors.append(each.decode())


class Sender:
    """Sends events by MQTT, ZeroMQ and HTTP in turn, with garbage between them, and again until they are answered."""

    def __init__(self, service, broker, z, rate, seed):
        import zmq

        self._service, self._broker, self._z, self._rate = service, broker, z, rate
        self._rng, self.sent, self._waiting = np.random.default_rng(seed), 0, {}
        self._socket = zmq.Context.instance().socket(zmq.PUSH)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(f"tcp://127.0.0.1:{service.pull}")
        self._again = zmq.Again
        self._flag, self.ends = zmq.NOBLOCK, threading.Event()

    def run(self):
        """Send new events until the end (a thread), and old events that have no answer."""
        due, last = 0.0, time.monotonic()
        while not self.ends.is_set():
            now = time.monotonic()
            # a process that starts gets no new events; it would need minutes for them on a busy machine
            due += self._rate * (now - last) * self._service.up.is_set()
            last = now
            while self.sent < due:
                self._send(f"event-{self.sent}")
                self.sent += 1
                if self._rng.random() < 0.1:
                    self._transmit(garbage(self._rng), int(self._rng.integers(2)))
            if self._service.up.is_set():
                self.repeat()
            time.sleep(0.01)

    def repeat(self):
        """Send events again that have no answer for some seconds, and forget the others; return how many wait."""
        now = time.monotonic()
        while self._waiting:
            name, when = next(iter(self._waiting.items()))
            if (name, "proof") in self._service.answered:
                del self._waiting[name]
            elif now - when > AGAIN:
                del self._waiting[name]
                self._send(name)
            else:
                break
        return len(self._waiting)

    def _send(self, name):
        number = int(name.partition("-")[2])
        self._waiting[name] = time.monotonic()
        way = number % 100
        self._transmit(line(event=name, z=self._z[number % len(self._z)]), 2 if way == 0 else way % 2)

    def _transmit(self, data, way):
        if way == 0:
            self._broker.publish(data)
        elif way == 1:
            with suppress(self._again):
                self._socket.send(data, self._flag)
        else:
            threading.Thread(target=self._post, args=(data,), daemon=True).start()

    def _post(self, data):
        address = f"http://127.0.0.1:{self._service.http}/fix"
        with suppress(OSError, urllib.error.HTTPError):
            urllib.request.urlopen(address, data, 20.0).close()


def soak(folder, z, seconds, kills, rate=400.0, seed=1):
    """Return the service after kills in the first half of a time, and its memory in megabytes in the second half.

    The broker restarts all the time. The memory is measured at a third of the second half and at its end.
    """
    broker = Broker()
    service = Service(folder, broker)
    service.start()
    sender = Sender(service, broker, z, rate, seed)
    thread = threading.Thread(target=sender.run, daemon=True)
    thread.start()
    breaks = seconds / 24.0

    def run_for(duration):
        """Restart the broker now and then, and check health, for some seconds."""
        began = broken = time.monotonic()
        while (now := time.monotonic()) < began + duration:
            if now > broken + breaks:
                broken = now
                broker.stop()
                time.sleep(1.0)
                broker.start()
            service.health()
            time.sleep(min(1.0, max(began + duration - now, 0.0)))

    for _ in range(kills):
        run_for(0.5 * seconds / kills)
        service.kill()
        service.start()
    run_for(seconds / 6.0)
    first = service.memory()
    run_for(seconds / 3.0)
    last = service.memory()
    sender.ends.set()
    thread.join(30.0)
    deadline = time.monotonic() + 120.0
    while sender.repeat() and time.monotonic() < deadline:
        time.sleep(0.05)
    code = service.end()
    broker.stop()
    return service, sender.sent, code, (first, last)


MINUTES = float(os.environ.get("OPTLOC_SOAK_MINUTES", "60"))
"""Length of the soak test, minutes."""
