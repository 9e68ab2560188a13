"""The server's end of the conversation with an actor, in the run's shared memory."""

import ctypes
import select
import sys
import time
from collections.abc import Callable
from typing import Any, TypeVar

import iceoryx2 as iox2

from . import protocol
from .protocol import Activity, Heartbeat, RequestHeader, ResponseHeader

POLLS = 200
"""Polls before a waiting process blocks: the client's next request comes soon, where it has a core to itself."""

NAP = 0.05
"""Seconds a process blocks before it looks after its connections."""

BEAT = 0.5
"""Seconds between heartbeats."""

T = TypeVar("T")


class Ended(Exception):
    """The launcher wants this process to end, or is no more."""


class Port:
    """Services of the run are made by others: this only opens them, and waits until they are there."""

    def __init__(
        self, config: str, run: str, index: int, incarnation: int, client: str, longest: int
    ) -> None:
        """``longest``: the most numbers in a response."""
        iox2.set_log_level(iox2.LogLevel.Fatal)
        self._node = (
            iox2.NodeBuilder.new()
            .config(iox2.config.from_file(iox2.FilePath.new(config)))
            .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
            .create(iox2.ServiceType.Ipc)
        )
        self._server = self._claim(
            lambda: self._service(protocol.conversation(run, index))
            .request_response(iox2.Slice[ctypes.c_float], iox2.Slice[ctypes.c_float])
            .request_header(RequestHeader)
            .response_header(ResponseHeader)
            .open()
            .server_builder()
            .initial_max_slice_len(longest)
            .max_loaned_responses_per_request(2)
            .create()
        )
        self._bell = self._claim(
            lambda: self._service(protocol.bell(run, f"env-server/{index}"))
            .event()
            .open()
            .listener_builder()
            .create()
        )
        self._ringer = self._claim(
            lambda: self._service(protocol.bell(run, client)).event().open().notifier_builder().create()
        )
        self._heart: Any = None
        self._heartbeats = protocol.heartbeats(run)
        self._heartbeat = Heartbeat(
            role=protocol.ENV_SERVER,
            index=index,
            activity=Activity.WAITING_FOR_PEER,
            incarnation=incarnation,
        )
        self._beaten = -BEAT

    def next_request(self) -> Any:
        """Waits for the next request."""
        while True:
            for _ in range(POLLS):
                request = self._server.receive()
                if request is not None:
                    return request
            self._look_out()
            self.beat(Activity.WAITING_FOR_PEER)
            self._bell.timed_wait(iox2.Duration.from_secs_f64(NAP))

    def ring(self) -> None:
        """Wakes the client. One that is not there looks for itself when it comes."""
        try:
            self._ringer.notify()
        except iox2.NotifierNotifyError:
            pass

    def count(self, steps: int) -> None:
        """Counts so many environment steps more."""
        self._heartbeat.steps += steps
        self.beat(Activity.WORKING)

    def beat(self, activity: Activity) -> None:
        """Tells the launcher that this process lives, if it is time to."""
        now = time.monotonic()
        if now - self._beaten < BEAT:
            return
        self._beaten = now
        self._heartbeat.activity = activity
        try:
            # Outside of a run there is no launcher to tell.
            if self._heart is None:
                self._heart = (
                    self._service(self._heartbeats)
                    .publish_subscribe(Heartbeat)
                    .open()
                    .publisher_builder()
                    .create()
                )
            self._heart.update_connections()
            self._heart.send_copy(self._heartbeat)
        except (
            iox2.PublishSubscribeOpenError,
            iox2.PublisherCreateError,
            iox2.ConnectionFailure,
            iox2.LoanError,
            iox2.SendError,
        ):
            # A heartbeat must not stop the work it tells of.
            pass

    def _service(self, name: str) -> Any:
        return self._node.service_builder(iox2.ServiceName.new(name))

    def _claim(self, attempt: Callable[[], T]) -> T:
        """Tries until a service is there, and a predecessor that died has let go of its place."""
        warned = time.monotonic()
        while True:
            try:
                return attempt()
            except Exception as reason:  # Every error of iceoryx2 has a class of its own.
                self._look_out()
                if time.monotonic() - warned > 10.0:
                    warned = time.monotonic()
                    print(f"still waiting for the run's services: {reason!r}", file=sys.stderr, flush=True)
                time.sleep(0.005)

    @staticmethod
    def _look_out() -> None:
        """Raises ``Ended`` once standard input says or ends something."""
        if select.select([sys.stdin], [], [], 0.0)[0]:
            raise Ended
