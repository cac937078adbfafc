"""How the commands speak: lines and JSON on stdout, notes and errors on stderr."""

import argparse
import contextlib
import json
import os
import sys
from collections.abc import Iterator
from typing import Any

INTERRUPTED, TERMINATED = 130, 143  # 128 + SIGINT and SIGTERM, as shells count


def open_missing_streams() -> None:
    """Give the process the streams that its caller has closed, and stdout an answer to characters it cannot encode."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            # a number below 3 that is free would go to the next file, and stray output into it
            while (number := os.open(os.devnull, os.O_RDWR)) < 3:
                pass
            setattr(sys, name, open(number, "r" if name == "stdin" else "w"))
    if getattr(sys.stdout, "errors", None) == "strict" and hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")


def discard_stdout() -> None:
    """Drop what is buffered for stdout, so that it does not complain at exit."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # no file behind it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def _to_stdout() -> Iterator[None]:
    """Say of what goes wrong that it was the output, and not a file."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        discard_stdout()
        raise OSError(f"cannot write to the standard output: {error.strerror or error}") from error


def put(text: str) -> None:
    """Print on stdout at once.

    Raises
    ------
    OSError
        If it takes no more; BrokenPipeError if its reader has left.
    """
    with _to_stdout():
        print(text, flush=True)


def flush() -> None:
    """Print what others have left in the buffer of stdout; raises as `put`."""
    with _to_stdout():
        sys.stdout.flush()


def say(kind: str, message: object) -> None:
    """Print one line on stderr: an error, a warning or a note."""
    with contextlib.suppress(OSError):  # nobody is left to tell
        print(f"apt-evap: {kind}:", *str(message).split(), file=sys.stderr, flush=True)


def tell(options: argparse.Namespace, line: str) -> None:
    """Print a line for people, where neither --quiet nor --json is given."""
    if not (options.quiet or options.json):
        put(line)


def tell_json(options: argparse.Namespace, content: dict[str, Any]) -> None:
    """Print a dict as one line for programs, where --json is given."""
    if options.json:
        put(json.dumps(content, allow_nan=False))
