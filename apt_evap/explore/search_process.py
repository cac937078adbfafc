"""A process that computes for the page, and errors as sentences of the page."""

import contextlib
import multiprocessing
import signal
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any

from apt_evap._common.validation import short_text
from apt_evap.warnings import AptWarning


class ProcessEnded(RuntimeError):
    """Error for a process that ended before its result, as by the system when memory is short."""


class SearchProcess:
    """A process that calls one function at a time, and leaves this one to the page; it starts at once."""

    def __init__(self) -> None:
        context: Any = multiprocessing.get_context("spawn")
        self._pipe, pipe = multiprocessing.Pipe()
        self._process = context.Process(target=_serve, args=(pipe,), daemon=True)
        self._process.start()
        pipe.close()  # the pipe then ends with the process
        self._cancelled = False
        self.notes: list[str] = []
        """Texts of the warnings of the last call."""

    def __enter__(self) -> "SearchProcess":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """End the process; a call in another thread then raises a `ProcessEnded`."""
        self._cancelled = True
        self._process.terminate()

    def call(
        self,
        function: Callable[..., Any],
        arguments: Sequence[Any],
        options: Mapping[str, Any] = {},
        progress: Callable[[float], None] | None = None,
    ) -> Any:
        """Call a function there; with `progress`, it has an argument of this name, whose calls come here."""
        try:
            self._pipe.send((function, arguments, dict(options), progress is not None))
            while True:
                part, result, sentence, self.notes = self._pipe.recv()
                if part is None:
                    break
                if progress is not None:
                    progress(part)
        except (EOFError, OSError):
            killed = "the process of the search was killed, perhaps for want of memory"
            raise ProcessEnded("the search was cancelled" if self._cancelled else killed) from None
        if sentence:
            raise ValueError(sentence)
        return result


def _serve(pipe):
    """Call functions until the other process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the explorer, which then ends this process
    with contextlib.suppress(EOFError, OSError):
        while True:
            function, arguments, options, tells = pipe.recv()
            if tells:
                options["progress"] = lambda part: pipe.send((part, None, "", []))
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", AptWarning)
                try:
                    result, sentence = function(*arguments, **options), ""
                except Exception as error:
                    result, sentence = None, sentence_of(error)
            notes = [str(warning.message) for warning in caught if issubclass(warning.category, AptWarning)]
            pipe.send((None, result, sentence, notes))


def sentence_of(error: BaseException) -> str:
    """One sentence for the page (str); of an error that nobody expects, with its kind."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{short_text(str(error.filename))}: {error.strerror}"
    text = " ".join(str(error).split())
    expected = isinstance(error, ValueError | OSError | MemoryError | ProcessEnded)
    return text if text and expected else f"{type(error).__name__}: {text}".rstrip(": ")


def guarded(work: Callable[..., None], say: Callable[[str], None]) -> Callable[..., None]:
    """Function that does the same, and calls `say` with a sentence if an error ends it."""

    @wraps(work)
    def call(*arguments: Any) -> None:
        try:
            work(*arguments)
        except Exception as error:
            say(sentence_of(error))

    return call


def start_thread(work: Callable[[], None], say: Callable[[str], None]) -> None:
    """Do `work` in a thread; `say` gets a sentence, in this thread, if an error ends it."""
    threading.Thread(target=guarded(work, say), daemon=True).start()
