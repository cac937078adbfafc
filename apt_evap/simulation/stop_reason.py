"""Ends of runs, and the errors that contain the ions of an unfinished run."""

from enum import StrEnum


class StopReason(StrEnum):
    """Reason for the end of a run; files store its value. Any other text is the error that ended the run."""

    COMPLETE = ""
    """The run has all requested ions."""
    EXHAUSTED = "no atom is left that may evaporate"
    """No evaporable atom is left: the run is complete, but shorter than requested."""
    INTERRUPTED = "interrupted"
    """Ended by Ctrl-C."""
    TIME_OVER = "its time was over"
    """Ended by a time limit."""
    UNFINISHED = "unfinished"
    """The run was read from its checkpoints."""
