"""Foxglove (https://docs.foxglove.dev/docs/sdk): a server that sends the messages of a log to the Foxglove app.

The messages are those of a log file, so `FOXGLOVE_LAYOUT` arranges both alike.
"""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Final

import foxglove
from foxglove.websocket import (
    Capability,
    ChannelView,
    Client,
    PlaybackCommand,
    PlaybackControlRequest,
    PlaybackState,
    PlaybackStatus,
    ServerListener,
)

from gripper_force.errors import DataError
from gripper_force.runtime.log_codecs import CODECS
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import available_ns
from gripper_force.types import NS_PER_MS, NS_PER_S, Record

_WAIT_S: Final = 0.1
_CLOCK_NS: Final = 20 * NS_PER_MS
"""The app's clock is set this often."""

_MIN_SPEED: Final = 0.01


class FoxgloveViewer(ServerListener):  # type: ignore[misc]  # the SDK is not checked
    """Server for the Foxglove app.

    Args:
        name: Name shown in the app.
        port: TCP port on this machine; 0: a free one.
        log: A complete log, which the app can play, pause and search; None for a live view.

    Attributes:
        url: Address for *Open connection* in the app.
        app_url: Address that opens the app in a browser.

    Raises:
        DataError: The port is in use.
    """

    def __init__(self, name: str, port: int, log: LogReader | None = None) -> None:
        context = self._context = foxglove.Context()
        self._channels = {
            record_type: foxglove.Channel(
                codec.topic,
                schema=foxglove.Schema(name=codec.schema_name, encoding="protobuf", data=codec.schema),
                message_encoding="protobuf",
                context=context,
            )
            for record_type, codec in CODECS.items()
        }
        self._changed = threading.Condition()
        self._subscribed = self._stopped = False
        self._plays, self._speed, self._seek_ns = log is None, 1.0, -1
        self._clock_ns = self._now_ns = 0
        times = None
        if log is not None:
            begin_ns = log.start_ns + log.utc_offset_ns
            times = begin_ns, begin_ns + log.duration_ns
            self._now_ns = begin_ns
        try:
            self._server = foxglove.start_server(
                name=name,
                port=port,
                capabilities=[Capability.Time],
                server_listener=self,
                context=context,
                playback_time_range=times,
            )
        except (OSError, RuntimeError) as error:
            raise DataError(
                f"can't serve Foxglove at port {port}: {error}; choose another with --port"
            ) from error
        self.url = f"ws://127.0.0.1:{self._server.port}"
        self.app_url = self._server.app_url() or ""

    def wait_for_app(self, poll: Callable[[], bool] = lambda: True) -> None:
        """Waits until the app has subscribed to its topics, or ``poll`` returns False."""
        with self._changed:
            while not self._subscribed and poll():
                self._changed.wait(_WAIT_S)
            while self._subscribed and self._changed.wait(_WAIT_S):
                pass  # it subscribes to one topic after the other

    def show(self, log: LogReader, record: Record) -> None:
        """Sends the next record of a log."""
        t_ns = available_ns(record) + log.utc_offset_ns
        data = CODECS[type(record)].encode(record, log.utc_offset_ns)
        self._channels[type(record)].log(data, log_time=t_ns)
        self._now_ns = t_ns
        if abs(t_ns - self._clock_ns) >= _CLOCK_NS:
            self._clock_ns = t_ns
            self._server.broadcast_time(t_ns)

    def play(self, log: LogReader) -> None:
        """Plays a complete log as the app asks for, until `close` is called or an exception arrives.

        Raises:
            LogError: The log is damaged.
        """
        while not self._stopped:
            with self._changed:
                self._seek_ns, begin_ns = -1, self._seek_ns
            for record in self._from(log, begin_ns):
                self.show(log, record)
            with self._changed:
                if self._seek_ns < 0 and not self._stopped:
                    self._plays = False
                    self._server.broadcast_playback_state(self._state(ended=True))
                while self._seek_ns < 0 and not self._stopped:
                    self._changed.wait(_WAIT_S)
                    if self._plays and self._seek_ns < 0:  # at the end: from the beginning
                        self._seek_ns = 0

    def close(self) -> None:
        """Stops the server."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._server.stop()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Notes that the app is there."""
        with self._changed:
            self._subscribed = True
            self._changed.notify_all()

    def on_playback_control_request(self, playback_control_request: PlaybackControlRequest) -> PlaybackState:
        """Handles a request of the app's play bar."""
        request = playback_control_request
        with self._changed:
            self._plays = request.playback_command == PlaybackCommand.Play
            self._speed = max(request.playback_speed, _MIN_SPEED)
            if request.seek_time is not None:
                self._seek_ns = self._now_ns = request.seek_time
            self._changed.notify_all()
            return self._state(did_seek=request.seek_time is not None, request_id=request.request_id)

    def _from(self, log: LogReader, begin_ns: int) -> Iterator[Record]:
        """Yields the records from a time on, each when it is due, until the app asks for another time."""
        last_ns = due_s = None
        for record in log.records():
            t_ns = available_ns(record) + log.utc_offset_ns
            if t_ns < begin_ns:
                continue
            with self._changed:
                if not self._plays:
                    last_ns = None
                while not (self._plays or self._interrupted):
                    self._changed.wait(_WAIT_S)
                if last_ns is None or due_s is None:
                    last_ns, due_s = t_ns, time.monotonic()
                due_s += max(t_ns - last_ns, 0) / NS_PER_S / self._speed
                last_ns = max(t_ns, last_ns)
                while (wait_s := due_s - time.monotonic()) > 0 and self._plays and not self._interrupted:
                    self._changed.wait(wait_s)
                if self._interrupted:
                    return
            yield record

    @property
    def _interrupted(self) -> bool:
        return self._stopped or self._seek_ns >= 0

    def _state(
        self, *, ended: bool = False, did_seek: bool = False, request_id: str | None = None
    ) -> PlaybackState:
        status = PlaybackStatus.Playing if self._plays else PlaybackStatus.Paused
        return PlaybackState(
            status=PlaybackStatus.Ended if ended else status,
            current_time=self._now_ns,
            playback_speed=self._speed,
            did_seek=did_seek,
            request_id=request_id,
        )
