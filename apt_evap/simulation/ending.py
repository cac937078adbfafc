"""Ends of runs, and the errors that contain the ions of an unfinished run."""

from enum import StrEnum
from typing import TYPE_CHECKING

from apt_evap._common.files import FileError

if TYPE_CHECKING:
    from apt_evap.simulation.run import Run


class Ending(StrEnum):
    """Reason for the end of a run; files store its value. Any other text is the error that ended the run."""

    COMPLETE = ""
    """The run has all requested ions."""
    EXHAUSTED = "no atom is left that may evaporate"
    """No evaporable atom is left: the run is complete, but shorter than requested."""
    INTERRUPTED = "interrupted"
    """Ended by Ctrl-C, or by a time limit."""
    UNFINISHED = "unfinished"
    """The run was read from its checkpoints."""


class RunInterrupted(RuntimeError):
    """Error that ended a run after its first ions; raised from the original error.

    Parameters
    ----------
    message : str
        Description of the error.
    run : Run
        The ions before the error.
    """

    def __init__(self, message: str, run: "Run") -> None:
        super().__init__(message)
        self.run = run


class RunNotSaved(FileError):
    """Error for a completed run that cannot be written.

    Parameters
    ----------
    message : str
        Reason.
    run : Run
        The complete run.
    """

    def __init__(self, message: str, run: "Run") -> None:
        super().__init__(message)
        self.run = run
