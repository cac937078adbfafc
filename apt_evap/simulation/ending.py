"""How runs end, and the errors that carry what had been done."""

from enum import StrEnum
from typing import TYPE_CHECKING

from apt_evap._common.files import FileError

if TYPE_CHECKING:
    from apt_evap.simulation.run import Run


class Ending(StrEnum):
    """Why a run ended; its value is what files say. Any other text is the error that ended it."""

    COMPLETE = ""
    """It has all ions that were asked for."""
    EXHAUSTED = "no atom is left that may evaporate"
    """It is complete, though shorter than asked for."""
    INTERRUPTED = "interrupted"
    """By Ctrl-C, or the end of its time."""
    UNFINISHED = "unfinished"
    """It was read from its checkpoints."""


class RunInterrupted(RuntimeError):
    """An error ended a run after some of its ions; raised from that error.

    Parameters
    ----------
    message : str
        What happened.
    run : Run
        The ions done before.
    """

    def __init__(self, message: str, run: "Run") -> None:
        super().__init__(message)
        self.run = run


class RunNotSaved(FileError):
    """A run that has ended cannot be written.

    Parameters
    ----------
    message : str
        Why.
    run : Run
        The whole run.
    """

    def __init__(self, message: str, run: "Run") -> None:
        super().__init__(message)
        self.run = run
