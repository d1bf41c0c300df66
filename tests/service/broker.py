"""A small broker of MQTT 3.1.1 (OASIS, 2014) for tests, which can stop and start again at the same port.

It knows the packets CONNECT, SUBSCRIBE, PUBLISH (QoS 0 and 1), PINGREQ and DISCONNECT, and sends each message to all
subscribers, whatever their topics are.
"""

import socket
import threading
import time
from contextlib import suppress


class Broker:
    """Broker with one thread for each client. topics: topics of all subscriptions. refuses: whether CONNECT fails."""

    def __init__(self):
        self.port, self.topics, self.refuses = 0, [], False
        self._lock, self._clients, self._listener = threading.Lock(), [], None
        self.start()

    def start(self):
        """Accept clients, at the port of the first start."""
        self._listener = socket.create_server(("127.0.0.1", self.port), reuse_port=False)
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def stop(self):
        """Close all connections, and accept no more."""
        # a thread in accept() keeps the port until it is woken
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            clients, self._clients = self._clients, []
        for client in clients:
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
            client.close()

    @property
    def subscribers(self):
        """Return the number of clients that have subscribed."""
        return len(self._clients)

    def publish(self, payload, topic=b"t"):
        """Send a message to all subscribers."""
        packet = len(topic).to_bytes(2, "big") + topic + payload
        with self._lock:
            for client in self._clients:
                with suppress(OSError):
                    client.sendall(b"\x30" + _length(len(packet)) + packet)

    def _accept(self, listener):
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client):
        with suppress(OSError, EOFError), client:
            while True:
                kind, body = _packet(client)
                if kind >> 4 == 1:
                    client.sendall(b"\x20\x02\x00" + (b"\x05" if self.refuses else b"\x00"))
                elif kind >> 4 == 8:
                    self.topics.append(body[4 : 4 + body[3]])
                    client.sendall(b"\x90\x03" + body[:2] + b"\x00")
                    with self._lock:
                        self._clients.append(client)
                elif kind >> 4 == 3:
                    size = int.from_bytes(body[:2], "big")
                    rest = body[2 + size :]
                    if kind & 6:
                        client.sendall(b"\x40\x02" + rest[:2])
                        rest = rest[2:]
                    self.publish(rest, body[2 : 2 + size])
                elif kind >> 4 == 12:
                    client.sendall(b"\xd0\x00")
                elif kind >> 4 == 14:
                    break
        with self._lock:
            self._clients = [each for each in self._clients if each is not client]


def _length(size):
    """Return a size as the variable bytes of a packet."""
    out = b""
    while True:
        size, low = divmod(size, 128)
        out += bytes([low | (128 if size else 0)])
        if not size:
            return out


def _packet(client):
    """Return the first byte and the body of the next packet; raise EOFError at the end of the connection."""
    kind, size, shift = _read(client, 1)[0], 0, 0
    while True:
        low = _read(client, 1)[0]
        size |= (low & 127) << shift
        shift += 7
        if not low & 128:
            return kind, _read(client, size)


def _read(client, count):
    data = b""
    while len(data) < count:
        piece = client.recv(count - len(data))
        if not piece:
            raise EOFError
        data += piece
    return data


def wait_for(true, seconds=30.0):
    """Wait until a condition is true; fail after some seconds."""
    until = time.monotonic() + seconds
    while not true() and time.monotonic() < until:
        time.sleep(0.01)
    assert true()
