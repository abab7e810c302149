"""A client of a Foxglove server, which takes all messages and shows nothing: the app's place in `bench loop`.

    python -m gripper_force.qualification.bench.foxglove_client ws://127.0.0.1:8765

It prints ``subscribed`` once it asked for all topics, and ends with the server. It speaks as much of the WebSocket
protocol (RFC 6455) as a server on the same machine needs.
"""

import base64
import json
import os
import socket
import struct
import sys
from typing import BinaryIO, Final
from urllib.parse import urlsplit

_WAIT_S: Final = 10.0
"""Longest wait for the server's first answers."""

_TEXT, _CLOSE, _PING, _PONG = 1, 8, 9, 10


def main(url: str) -> None:
    """Connects, subscribes to every topic, and reads until the server ends.

    Raises:
        OSError: The server does not answer, or not as a Foxglove server.
    """
    address = urlsplit(url)
    with socket.create_connection((address.hostname or "", address.port or 0), _WAIT_S) as connection:
        _shake_hands(connection, stream := connection.makefile("rb"), address.netloc)
        while message := _next_message(stream):
            opcode, data = message
            if opcode == _TEXT and (channels := json.loads(data).get("channels")):
                wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
                _send(connection, _TEXT, json.dumps({"op": "subscribe", "subscriptions": wanted}).encode())
                print("subscribed", flush=True)  # noqa: T201
                connection.settimeout(None)
            elif opcode == _PING:
                _send(connection, _PONG, data)
            elif opcode == _CLOSE:
                return


def _shake_hands(connection: socket.socket, stream: BinaryIO, host: str) -> None:
    lines = (
        "GET / HTTP/1.1",
        f"Host: {host}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Protocol: foxglove.sdk.v1",
    )
    connection.sendall("\r\n".join([*lines, "", ""]).encode())
    status = stream.readline()
    if status.split()[1:2] != [b"101"]:
        raise ConnectionError(f"no Foxglove server at {host}: {status!r}")
    while stream.readline().strip():
        pass


def _next_message(stream: BinaryIO) -> tuple[int, bytes] | None:
    """Returns the kind and the content of the next message; None at the end."""
    if len(head := stream.read(2)) < 2:
        return None
    size = head[1] & 0x7F
    if size >= 126:
        size = (
            struct.unpack("!H", stream.read(2))[0] if size == 126 else struct.unpack("!Q", stream.read(8))[0]
        )
    return head[0] & 0x0F, stream.read(size)


def _send(connection: socket.socket, opcode: int, data: bytes) -> None:
    size = bytes([0x80 | len(data)]) if len(data) < 126 else b"\xfe" + struct.pack("!H", len(data))
    mask = os.urandom(4)  # a client must mask what it sends
    masked = bytes(byte ^ mask[i % 4] for i, byte in enumerate(data))
    connection.sendall(bytes([0x80 | opcode]) + size + mask + masked)


if __name__ == "__main__":
    main(sys.argv[1])
