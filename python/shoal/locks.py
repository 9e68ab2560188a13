"""The lock of a directory: a process that works on a run or a suite holds it."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from .errors import ShoalError


def is_locked(directory: Path) -> bool:
    """Whether a process holds the lock of this run or suite, as the launcher of a running run does.

    Raises :class:`ShoalError` if the directory cannot be opened.
    """
    try:
        descriptor = os.open(directory, os.O_RDONLY)
    except OSError as error:
        raise ShoalError(f"{directory} cannot be opened: {error.strerror}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False
