"""What travels between an actor and its environment server, and what a run's services are called."""

import ctypes
import enum


class RequestKind(enum.IntEnum):
    """What a request asks for."""

    DESCRIBE = 0
    RESET = 1
    RESET_TO_EVALUATION = 2
    STEP = 3
    SNAPSHOT = 4
    RESTORE = 5
    RESET_TO_TRAINING = 6


class ResponseStatus(enum.IntEnum):
    """How a request was taken."""

    ANSWERED = 0
    NOT_STARTED = 1
    REFUSED = 2
    INVALID = 3


class Activity(enum.IntEnum):
    """What a role is doing."""

    WORKING = 0
    WAITING_FOR_PEER = 1


ENV_SERVER = 0
"""The number that the role of an environment server travels as."""


class RequestHeader(ctypes.Structure):
    """Header of a request."""

    _fields_ = [
        ("kind", ctypes.c_uint32),
        ("episodes", ctypes.c_uint32),
        ("episode", ctypes.c_uint64),
    ]

    @staticmethod
    def type_name() -> str:
        return "ShoalEnvironmentRequest"


class ResponseHeader(ctypes.Structure):
    """Header of a response."""

    _fields_ = [
        ("status", ctypes.c_uint32),
        ("environments", ctypes.c_uint32),
        ("discrete_observations", ctypes.c_uint32),
        ("observation_width", ctypes.c_uint32),
        ("discrete_actions", ctypes.c_uint32),
        ("action_width", ctypes.c_uint32),
        ("time_limit", ctypes.c_uint32),
        ("state_width", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        return "ShoalEnvironmentResponse"


class Heartbeat(ctypes.Structure):
    """A role lives."""

    _fields_ = [
        ("role", ctypes.c_uint32),
        ("index", ctypes.c_uint32),
        ("activity", ctypes.c_uint32),
        ("faults", ctypes.c_uint32),
        ("incarnation", ctypes.c_uint64),
        ("steps", ctypes.c_uint64),
        ("policy_version", ctypes.c_uint64),
    ]

    @staticmethod
    def type_name() -> str:
        return "ShoalHeartbeat"


def requests(run: str, index: int) -> str:
    """The service in which server ``index`` is asked."""
    return f"shoal/{run}/env/{index}"


def event(run: str, role: str) -> str:
    """The service that wakes a process; ``role`` is its role and index, as ``actor/0``."""
    return f"shoal/{run}/bell/{role}"


def heartbeats(run: str) -> str:
    """The service of the roles' heartbeats."""
    return f"shoal/{run}/reports/heartbeats"
