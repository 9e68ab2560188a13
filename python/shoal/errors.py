"""The error of this package."""

from __future__ import annotations


class ShoalError(RuntimeError):
    """The program refused or failed, or a file of a run cannot be used.

    The message is the program's error line, or names the file and what is wrong with it. ``exit_code`` is that of the
    program, or ``None`` if no program was started.
    """

    def __init__(self, message: str, exit_code: int | None = None) -> None:
        super().__init__(message)
        self.exit_code = exit_code
