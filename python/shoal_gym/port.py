"""The server's end of the channel to its client, in the run's shared memory."""

import ctypes
import select
import time
from collections.abc import Callable
from typing import Any, TypeVar

import iceoryx2 as iox2

from . import protocol
from .protocol import Activity, Heartbeat, RequestHeader, ResponseHeader

POLLS = 200
"""Polls before a waiting process blocks: the client's next request comes soon, where it has a core to itself."""

SLEEP = 0.05
"""Seconds for which a process blocks before it looks at standard input and sends a heartbeat that is due."""

HEARTBEAT_INTERVAL = 0.5
"""Seconds between heartbeats."""

PROVEN = 1000
"""A server that has taken this many environment steps is able to work: if it fails later, it is started again each time."""

TIMEOUT = 10.0
"""Seconds for which a port may be refused: a predecessor that was killed has it until the launcher has cleaned up."""

REFUSALS = (
    iox2.RequestResponseOpenError,
    iox2.ServerCreateError,
    iox2.EventOpenError,
    iox2.ListenerCreateError,
    iox2.NotifierCreateError,
)
"""How iceoryx2 refuses a service or a port in it."""

TEMPORARY = frozenset(
    {
        # Every place is taken, perhaps by a process that was killed and is not cleaned up after yet.
        "ExceedsMaxNumberOfNodes",
        "ExceedsMaxSupportedServers",
        "ExceedsMaxSupportedListeners",
        "ExceedsMaxSupportedNotifiers",
        # A process was killed while it made the service; the launcher removes what is unfinished.
        "HangsInCreation",
        "Interrupt",
    }
)
"""Temporary refusals, by the names that iceoryx2's Python package gives them: nothing else tells them apart."""

T = TypeVar("T")


class Ended(Exception):
    """The launcher wants this process to end, or is gone."""


class Unreachable(Exception):
    """A port in the run's shared memory is unavailable."""


def make_port(attempt: Callable[[], T], check_end: Callable[[], None]) -> T:
    """Makes a port. After a temporary refusal this is tried again for a while, with ``check_end`` before each new try.
    Any other refusal is final.

    Raises ``Unreachable`` with the refusal."""
    deadline = time.monotonic() + TIMEOUT
    while True:
        try:
            return attempt()
        except REFUSALS as refusal:
            if str(refusal) not in TEMPORARY or time.monotonic() > deadline:
                raise Unreachable(f"cannot join the run's shared memory: {refusal!r}") from refusal
        check_end()
        time.sleep(0.005)


class Port:
    """The run's services are there before this process is started: it only opens them."""

    def __init__(
        self, config: str, run: str, index: int, incarnation: int, client: str, longest: int, control: int
    ) -> None:
        """``longest``: the most numbers in a response. ``control``: a descriptor; once it has something to read, or is
        closed at its other end, ``Ended`` is raised."""
        self._control = control
        iox2.set_log_level(iox2.LogLevel.Fatal)
        self._node = (
            iox2.NodeBuilder.new()
            .config(iox2.config.from_file(iox2.FilePath.new(config)))
            .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
            .create(iox2.ServiceType.Ipc)
        )
        self._server = make_port(
            lambda: self._service(protocol.requests(run, index))
            .request_response(iox2.Slice[ctypes.c_float], iox2.Slice[ctypes.c_float])
            .request_header(RequestHeader)
            .response_header(ResponseHeader)
            .open()
            .server_builder()
            .initial_max_slice_len(longest)
            .max_loaned_responses_per_request(2)
            .create(),
            self._check_end,
        )
        self._listener = make_port(
            lambda: self._service(protocol.event(run, f"env-server/{index}"))
            .event()
            .open()
            .listener_builder()
            .create(),
            self._check_end,
        )
        self._notifier = make_port(
            lambda: self._service(protocol.event(run, client)).event().open().notifier_builder().create(),
            self._check_end,
        )
        self._heartbeat_port: Any = None
        self._heartbeats = protocol.heartbeats(run)
        self._heartbeat = Heartbeat(
            role=protocol.ENV_SERVER,
            index=index,
            activity=Activity.WAITING_FOR_PEER,
            incarnation=incarnation,
        )
        self._last_heartbeat_at = -HEARTBEAT_INTERVAL

    def next_request(self) -> Any:
        """Waits for the next request."""
        while True:
            for _ in range(POLLS):
                request = self._server.receive()
                if request is not None:
                    return request
            self._check_end()
            self.beat(Activity.WAITING_FOR_PEER)
            try:
                self._listener.timed_wait(iox2.Duration.from_secs_f64(SLEEP))
            except iox2.ListenerWaitError as error:
                # The process was stopped and continued during the wait.
                if str(error) != "InterruptSignal":
                    raise

    def notify(self) -> None:
        """Wakes the client. A client that is not there looks for itself when it comes."""
        try:
            self._notifier.notify()
        except iox2.NotifierNotifyError:
            pass

    def announce_first_step(self) -> None:
        """Reports that the environments are about to do something that this process may not survive: at once if they have not
        made a step yet, so that the launcher can tell a process that dies in its first step from one that was waiting.
        """
        if self._heartbeat.steps == 0:
            self._last_heartbeat_at = -HEARTBEAT_INTERVAL
            self.beat(Activity.WORKING)

    def count(self, steps: int) -> None:
        """Counts further environment steps. The first ones, and those that prove it able to work, are reported at once: a
        fast process may fail before its next heartbeat.
        """
        if steps == 0:
            return
        if self._heartbeat.steps == 0 or self._heartbeat.steps < PROVEN <= self._heartbeat.steps + steps:
            self._last_heartbeat_at = -HEARTBEAT_INTERVAL
        self._heartbeat.steps += steps
        self.beat(Activity.WORKING)

    def beat(self, activity: Activity) -> None:
        """Tells the launcher that this process lives, if it is time to."""
        now = time.monotonic()
        if now - self._last_heartbeat_at < HEARTBEAT_INTERVAL:
            return
        self._last_heartbeat_at = now
        self._heartbeat.activity = activity
        try:
            # Outside of a run there is no launcher to tell.
            if self._heartbeat_port is None:
                self._heartbeat_port = (
                    self._service(self._heartbeats)
                    .publish_subscribe(Heartbeat)
                    .open()
                    .publisher_builder()
                    .create()
                )
            self._heartbeat_port.update_connections()
            self._heartbeat_port.send_copy(self._heartbeat)
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

    def _check_end(self) -> None:
        """Raises ``Ended`` once the launcher ends this process, or is gone itself."""
        if select.select([self._control], [], [], 0.0)[0]:
            raise Ended
