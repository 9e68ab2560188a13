"""The server's loop: answers the requests of one client by stepping its environments."""

import ctypes
import sys
from collections.abc import Callable
from typing import Any

import iceoryx2 as iox2
import numpy as np
from numpy.typing import NDArray

from .environments import Blocks, Environments
from .port import Port
from .protocol import RequestKind, ResponseHeader, ResponseStatus
from .spaces import Invalid


def longest(environments: Environments) -> int:
    """The most numbers in a response: of a step, or of a description."""
    observation, action = environments.observation, environments.action
    return max(Blocks.length(len(environments), observation.width), 2 * (observation.width + action.width))


def serve(environments: Environments, port: Port) -> None:
    """Answers requests until the port ends."""
    server = Server(environments)
    while True:
        request = port.next_request()
        if request.user_header().contents.kind != RequestKind.DESCRIBE:
            port.announce_first_step()
        server.answer(request)
        port.notify()
        port.count(server.stepped())


class Server:
    """What a server knows between two requests."""

    def __init__(self, environments: Environments) -> None:
        self._environments = environments
        self._started = False
        self._stepped = 0

    def stepped(self) -> int:
        """Environment steps since this was asked last."""
        steps, self._stepped = self._stepped, 0
        return steps

    def answer(self, request: Any) -> None:
        """Answers a request of any kind."""
        header = request.user_header().contents
        match header.kind:
            case RequestKind.DESCRIBE:
                bounds = self._environments.observation.bounds() + self._environments.action.bounds()
                self._respond(request, np.concatenate(bounds) if bounds else np.empty(0, np.float32))
            case RequestKind.RESET:
                self._begin(request, self._environments.begin_next)
            case RequestKind.RESET_TO_TRAINING:
                self._begin(request, lambda blocks: self._environments.begin_training(header.episode, blocks))
            case RequestKind.RESET_TO_EVALUATION:
                self._begin(
                    request,
                    lambda blocks: self._environments.begin_evaluation(header.episode, header.episodes, blocks),
                )
            case RequestKind.STEP | RequestKind.SNAPSHOT if not self._started:
                self._send(self._loan(request, 0), ResponseStatus.NOT_STARTED)
            case RequestKind.STEP:
                self._step(request)
            case _:
                # Gymnasium's environments cannot say their state: there are no snapshots.
                self._send(self._loan(request, 0), ResponseStatus.REFUSED)

    def _begin(self, request: Any, begin: Callable[[Blocks], None]) -> None:
        response, blocks = self._loan_blocks(request)
        try:
            begin(blocks)
        except Invalid as reason:
            del response, blocks
            self._invalid(request, reason)
            return
        self._started = True
        self._send(response, ResponseStatus.ANSWERED)

    def _step(self, request: Any) -> None:
        environments = self._environments
        actions = _numbers(request.payload())
        if len(actions) != len(environments) * environments.action.width:
            self._refuse(request, f"{len(actions)} numbers for the actions of {len(environments)} environments")
            return
        try:
            chosen = environments.action.decode(actions)
        except ValueError as reason:
            self._refuse(request, str(reason))
            return
        response, blocks = self._loan_blocks(request)
        try:
            environments.step(chosen, blocks)
        except Invalid as reason:
            del response, blocks
            self._invalid(request, reason)
            return
        self._stepped += len(environments)
        self._send(response, ResponseStatus.ANSWERED)

    def _invalid(self, request: Any, reason: Invalid) -> None:
        """The episodes end here: the client begins new ones."""
        print(f"error: {reason}", file=sys.stderr, flush=True)
        self._started = False
        self._send(self._loan(request, 0), ResponseStatus.INVALID)

    def _refuse(self, request: Any, reason: str) -> None:
        print(f"a request was refused: {reason}", file=sys.stderr, flush=True)
        self._send(self._loan(request, 0), ResponseStatus.REFUSED)

    def _respond(self, request: Any, numbers: NDArray[np.float32]) -> None:
        response = self._loan(request, len(numbers))
        _numbers(response.payload())[:] = numbers
        self._send(response, ResponseStatus.ANSWERED)

    def _loan(self, request: Any, length: int) -> Any:
        return request.loan_slice_uninit(length)

    def _loan_blocks(self, request: Any) -> tuple[Any, Blocks]:
        count, width = len(self._environments), self._environments.observation.width
        response = self._loan(request, Blocks.length(count, width))
        return response, Blocks.of(_numbers(response.payload()), count, width)

    def _send(self, response: Any, status: ResponseStatus) -> None:
        environments = self._environments
        response.user_header()[0] = ResponseHeader(
            status=status,
            environments=len(environments),
            discrete_observations=environments.observation.discrete,
            observation_width=environments.observation.width,
            discrete_actions=environments.action.discrete,
            action_width=environments.action.width,
            time_limit=environments.time_limit,
            state_width=0,
        )
        response.assume_init().send()


def _numbers(payload: iox2.Slice) -> NDArray[np.float32]:
    """A view of what lies in shared memory."""
    # A `Slice` of iceoryx2 0.10.0 counts bytes where it says elements, and its `as_memory_view` reaches too far.
    count = payload.len() // ctypes.sizeof(ctypes.c_float)
    return np.frombuffer((ctypes.c_float * count).from_address(payload.as_ptr()), dtype=np.float32)
