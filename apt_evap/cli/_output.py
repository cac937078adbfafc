"""Output of the commands: lines and JSON on stdout, notes and errors on stderr."""

import argparse
import contextlib
import errno
import json
import os
import sys
from collections.abc import Iterator
from typing import Any

INTERRUPTED, TERMINATED = 130, 143  # 128 + number of SIGINT and SIGTERM, as in shells


def open_missing_streams() -> None:
    """Open streams that the caller has closed, and let stdout escape what it cannot encode, in any locale."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            # otherwise the next file would get a free number below 3, and output for a stream would go into it
            while (number := os.open(os.devnull, os.O_RDWR)) < 3:
                pass
            setattr(sys, name, open(number, "r" if name == "stdin" else "w"))
    # in the C locale it is "surrogateescape", which knows the bytes of file names, but no other characters
    if getattr(sys.stdout, "errors", None) in ("strict", "surrogateescape") and hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")


def discard_stdout() -> None:
    """Discard the buffer of stdout, to avoid an error message at exit."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # stdout is not a file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def _to_stdout() -> Iterator[None]:
    """Let messages of errors name the standard output."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        if sys.platform == "win32" and error.errno == errno.EINVAL:  # what Windows says of a closed pipe
            raise BrokenPipeError from error
        discard_stdout()
        raise OSError(f"cannot write to the standard output: {error.strerror or error}") from error


def put(text: str) -> None:
    """Print on stdout without delay."""
    with _to_stdout():
        print(text, flush=True)


def flush() -> None:
    """Write the buffer of stdout; errors as in `put`."""
    with _to_stdout():
        sys.stdout.flush()


def say(kind: str, message: object) -> None:
    """Print one line on stderr: an error, a warning or a note."""
    text = str(message).replace("\\\\", "\\") if os.sep == "\\" else str(message)  # paths as they are typed
    with contextlib.suppress(OSError):  # stderr is closed
        print(f"apt-evap: {kind}:", *text.split(), file=sys.stderr, flush=True)


def tell(options: argparse.Namespace, line: str) -> None:
    """Print a line for readers, unless --quiet or --json is given."""
    if not (options.quiet or options.json):
        put(line)


def tell_json(options: argparse.Namespace, content: dict[str, Any]) -> None:
    """Print a dict as one line for programs, if --json is given."""
    if options.json:
        put(json.dumps(content, allow_nan=False))
