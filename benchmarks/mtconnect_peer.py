"""An MTConnect agent as a program: each line of its standard input is the next value of all data items.

Usage: mtconnect_peer.py COUNT

It prints its port. A stream (``sample``) gets a document of all items at each change, without a pause, and an empty
document as a heartbeat.
"""

from __future__ import annotations

import queue
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Final

from common import tell

HEARTBEAT_S: Final = 0.5
TIME: Final = "2026-01-01T00:00:00.123Z"


class Agent(ThreadingHTTPServer):
    """The data items with their values, and the streams."""

    daemon_threads = True

    def __init__(self, count: int) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.count, self.value, self.next = count, -1.0, count + 1
        self.lock = threading.Lock()
        self.streams: set[queue.SimpleQueue[bytes]] = set()

    def change(self, value: float) -> None:
        """Give all data items a value, and queue it for the streams."""
        with self.lock:
            self.value, self.next = value, self.next + self.count
            document = self.document()
            for stream in self.streams:
                stream.put(document)

    def document(self, *, empty: bool = False) -> bytes:
        """Return the present state, or a document without observations."""
        first = self.next - self.count
        items = "" if empty else "".join(
            f'<Position dataItemId="v{n}" timestamp="{TIME}" sequence="{first + n}">{self.value}</Position>\n'
            for n in range(self.count)
        )  # fmt: skip
        inside = f'<ComponentStream component="Path" componentId="p"><Samples>{items}</Samples></ComponentStream>'
        body = f'<DeviceStream name="m" uuid="m">{inside}</DeviceStream>'
        header = f'firstSequence="1" lastSequence="{self.next - 1}" nextSequence="{self.next}"'
        return _document("Streams", header, body).encode()

    def devices(self) -> bytes:
        """Return the device model."""
        items = "".join(f'<DataItem id="v{n}" category="SAMPLE" type="POSITION"/>' for n in range(self.count))
        body = f'<Device id="d" name="m" uuid="m"><DataItems>{items}</DataItems></Device>'
        return _document("Devices", "", body).encode()


def _document(kind: str, header: str, body: str) -> str:
    return (
        f'<?xml version="1.0"?>\n<MTConnect{kind} xmlns="urn:mtconnect.org:MTConnect{kind}:2.0"><Header instanceId="1" '
        f'version="2.0" {header}/><{kind}>{body}</{kind}></MTConnect{kind}>\n'
    )


class Handler(BaseHTTPRequestHandler):
    """Answers probe, current and sample."""

    server: Agent

    def do_GET(self) -> None:
        """Answer a request."""
        verb = self.path.split("?")[0].strip("/")
        if verb == "sample":
            self._stream()
            return
        with self.server.lock:
            found = self.server.devices() if verb == "probe" else self.server.document()
        self._head("text/xml", len(found))
        self.wfile.write(found)

    def _head(self, kind: str, length: int | None) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.end_headers()

    def _stream(self) -> None:
        own: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        with self.server.lock:
            self.server.streams.add(own)
        try:
            self._head("multipart/x-mixed-replace;boundary=part", None)
            while True:
                try:
                    found = own.get(timeout=HEARTBEAT_S)
                except queue.Empty:
                    with self.server.lock:
                        found = self.server.document(empty=True)
                head = f"--part\r\nContent-type: text/xml\r\nContent-length: {len(found)}\r\n\r\n".encode()
                self.wfile.write(head + found + b"\r\n")
        except OSError:  # the client has gone
            pass
        finally:
            with self.server.lock:
                self.server.streams.discard(own)

    def log_message(self, *_: object) -> None:
        """Log nothing."""


def main() -> None:
    agent = Agent(int(sys.argv[1]))
    threading.Thread(target=agent.serve_forever, daemon=True).start()
    tell(agent.server_address[1])
    for line in sys.stdin:
        agent.change(float(line))
        tell(True)
    agent.shutdown()


if __name__ == "__main__":
    main()
