"""What becomes of a port that is refused. Run with ``python3 -m unittest discover -s tests`` here in ``python/``."""

import ctypes
import gc
import os
import pathlib
import tempfile
import time
import unittest
from typing import Any

import iceoryx2 as iox2

from shoal_gym import port
from shoal_gym.protocol import Heartbeat, RequestHeader, ResponseHeader


class MakePort(unittest.TestCase):
    def setUp(self) -> None:
        iox2.set_log_level(iox2.LogLevel.Fatal)
        self._root = tempfile.TemporaryDirectory()
        self.addCleanup(self._root.cleanup)
        self._prefix = f"shoal_test{os.getpid()}_"
        self.addCleanup(self._sweep)
        config = iox2.config.default()
        config.global_cfg.root_path = iox2.Path.new(self._root.name)
        config.global_cfg.prefix = iox2.FileName.new(self._prefix)
        self._node = iox2.NodeBuilder.new().config(config).create(iox2.ServiceType.Ipc)
        self._made: Any = None
        self._pauses = 0

    def _sweep(self) -> None:
        """iceoryx2 lets go of its files when nobody holds its objects, and leaves the one that counts nodes."""
        self._made = self._node = None
        gc.collect()
        for file in pathlib.Path("/dev/shm").glob(f"{self._prefix}*"):
            file.unlink()

    def _builder(self, header: Any = RequestHeader) -> Any:
        return (
            self._node.service_builder(iox2.ServiceName.new("test"))
            .request_response(iox2.Slice[ctypes.c_float], iox2.Slice[ctypes.c_float])
            .request_header(header)
            .response_header(ResponseHeader)
        )

    def _pause(self) -> None:
        self._pauses += 1

    def _refused_at_once(self, attempt: Any, name: str) -> None:
        begun = time.monotonic()
        with self.assertRaisesRegex(port.Unreachable, name):
            port.make_port(attempt, self._pause)
        self.assertEqual(self._pauses, 0)
        self.assertLess(time.monotonic() - begun, port.TIMEOUT / 2)

    def test_a_port_is_made_once_its_holder_is_gone(self) -> None:
        self._made = self._builder().max_servers(1).create()
        holders = [self._made.server_builder().create()]

        def pause() -> None:
            self._pause()
            if self._pauses == 3:
                holders.clear()
                gc.collect()

        made = port.make_port(lambda: self._builder().open().server_builder().create(), pause)
        self.assertIsNotNone(made)
        self.assertEqual(self._pauses, 3)
        del made

    def test_a_missing_service_is_refused_at_once(self) -> None:
        self._refused_at_once(lambda: self._builder().open(), "DoesNotExist")

    def test_a_service_of_another_type_is_refused_at_once(self) -> None:
        self._made = self._builder().create()
        other = lambda: self._builder(ResponseHeader).open()  # noqa: E731
        self._refused_at_once(other, "IncompatibleRequestOrResponseType")

    def test_an_error_that_is_no_refusal_is_not_hidden(self) -> None:
        def fail() -> None:
            raise ValueError("a mistake in the program")

        with self.assertRaises(ValueError):
            port.make_port(fail, self._pause)
        self.assertEqual(self._pauses, 0)


class Heartbeats(unittest.TestCase):
    def test_a_server_says_at_once_that_it_works_and_that_it_is_proven(self) -> None:
        told: list[int] = []

        class Sink:
            def update_connections(self) -> None:
                pass

            def send_copy(self, heartbeat: Any) -> None:
                told.append(heartbeat.steps)

        served = port.Port.__new__(port.Port)
        served._heartbeat = Heartbeat()
        served._heartbeat_port, served._last_heartbeat_at = Sink(), -port.HEARTBEAT_INTERVAL
        for _ in range(300):
            served.count(4)
        self.assertEqual(told, [4, port.PROVEN])



if __name__ == "__main__":
    unittest.main()
