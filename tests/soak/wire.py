"""HTTP/1.1 over one persistent socket, minimal so that the measurement is of the server and not of the client."""
import json
import socket
from dataclasses import dataclass


class Broken(ConnectionError):
    """The connection ended before its response did."""


@dataclass
class Reply:
    """A complete response."""
    status: int
    headers: dict
    body: bytes

    def json(self):
        return json.loads(self.body)


def request_bytes(method, path, body=b"", media_type="application/json", headers=()):
    """Returns a request as bytes."""
    lines = [f"{method} {path} HTTP/1.1", "host: localhost", f"content-length: {len(body)}"]
    if body:
        lines.append(f"content-type: {media_type}")
    lines += [f"{name}: {value}" for name, value in headers]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body


def read_head(text):
    """Reads status and headers of a response from its first bytes, without the empty line at their end."""
    lines = text.decode("latin-1").split("\r\n")
    headers = {}
    for line in lines[1:]:
        name, _, value = line.partition(":")
        headers[name.lower()] = value.strip()
    return int(lines[0].split(" ", 2)[1]), headers


class Connection:
    """One connection to a server; opened again if the server closed it between two requests."""

    def __init__(self, address, timeout_s=60.0):
        self.address, self.timeout_s = address, timeout_s
        self.socket, self.rest, self.used = None, b"", False

    def close(self):
        if self.socket:
            self.socket.close()
        self.socket, self.rest, self.used = None, b"", False

    def open(self):
        self.close()
        self.socket = socket.create_connection(self.address, timeout=self.timeout_s)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data):
        """Sends a whole request and reads its response."""
        for _ in range(2):
            fresh = not self.used
            try:
                if self.socket is None:
                    self.open()
                self.socket.sendall(data)
                return self.read_reply()
            except OSError as error:
                self.close()
                # A persistent connection may have been closed meanwhile: retry once on a new one. No response had begun.
                if fresh or isinstance(error, (Broken, TimeoutError)):
                    raise
        raise Broken("closed twice")

    def call(self, method, path, body=None, media_type="application/json", headers=()):
        """Sends a request with a JSON body, or with raw bytes."""
        data = b"" if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
        return self.send(request_bytes(method, path, data, media_type, headers))

    def more(self):
        chunk = self.socket.recv(1 << 18)
        if not chunk:
            # Before the first byte, this is a connection that was closed while idle.
            raise Broken("the answer was cut off") if self.rest or not self.used else ConnectionResetError("closed while idle")
        self.rest += chunk

    def until(self, mark):
        while (at := self.rest.find(mark)) < 0:
            self.more()
        head, self.rest = self.rest[:at], self.rest[at + len(mark):]
        return head

    def exactly(self, count):
        if len(self.rest) < count:
            parts, have = [self.rest], len(self.rest)
            while have < count:
                chunk = self.socket.recv(1 << 18)
                if not chunk:
                    raise Broken("the answer was cut off")
                parts.append(chunk)
                have += len(chunk)
            self.rest = b"".join(parts)
        data, self.rest = self.rest[:count], self.rest[count:]
        return data

    def read_reply(self):
        status, headers = read_head(self.until(b"\r\n\r\n"))
        self.used = True
        if headers.get("transfer-encoding") == "chunked":
            body = b"".join(self.chunks())
        else:
            body = self.exactly(int(headers.get("content-length", 0)))
        if headers.get("connection") == "close":
            self.close()
        return Reply(status, headers, body)

    def chunks(self):
        """Yields the pieces of a chunked body."""
        while size := int(self.until(b"\r\n"), 16):
            yield self.exactly(size)
            self.exactly(2)
        self.exactly(2)

    def stream(self, path):
        """Yields the lines of a streamed response."""
        self.open()
        self.socket.sendall(request_bytes("GET", path))
        status, headers = read_head(self.until(b"\r\n\r\n"))
        if status != 200:
            raise Broken(f"{path} answered {status}")
        rest = b""
        for chunk in self.chunks():
            *lines, rest = (rest + chunk).split(b"\n")
            yield from lines
        self.close()


def expect(reply, *statuses):
    """Returns the response's JSON if it has one of these statuses."""
    if reply.status not in statuses:
        raise AssertionError(f"status {reply.status}, expected {statuses}: {reply.body[:400]!r}")
    return reply.json()
