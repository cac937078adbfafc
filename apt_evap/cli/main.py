"""Entry point of `apt-evap`: signals, warnings, errors and exit codes."""

import contextlib
import os
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from apt_evap.cli._output import (
    INTERRUPTED,
    TERMINATED,
    discard_stdout,
    flush,
    open_missing_streams,
    say,
)
from apt_evap.warnings import AptWarning


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    open_missing_streams()
    with warnings.catch_warnings(), _drawing_into_files(), _terminated_like_interrupted() as terminated:
        warnings.simplefilter("default", AptWarning)  # a command prints its warnings, whatever the filters
        warnings.showwarning = _say_warning
        try:
            code = _execute(arguments)
            flush()
            if code == INTERRUPTED:
                _say_how_to_go_on(arguments)
            return TERMINATED if terminated and code == INTERRUPTED else code
        except KeyboardInterrupt:
            # `python -m` would end itself by SIGINT, whatever the code is, if exec of a text was interrupted, by which
            # libraries make functions; another text resets this
            exec("")
            _say_how_to_go_on(arguments)
            return TERMINATED if terminated else INTERRUPTED
        except BrokenPipeError:  # the reader of the output has closed the pipe
            discard_stdout()
            return 1
        except MemoryError as error:
            say("error", str(error) or "not enough memory")
        except (ValueError, OSError) as error:
            say("error", error)
        except RuntimeError as error:
            from apt_evap.simulation.recorder import RunInterrupted  # help must not wait for it

            if not isinstance(error, RunInterrupted):
                raise
            say("error", error)
        return 2


def _say_warning(message, category, *_, **__):
    """Print a warning; what to know about a result is a note."""
    from apt_evap.warnings import WorkflowWarning

    say("note" if issubclass(category, WorkflowWarning) else "warning", message)


_PAUSE, _LAST = 0.02, 100  # s until a signal during an import comes again, and how often: 2 s, all imports take 1 s
_KEEPING = ("run", "sweep", "dataset", "twin", "paper")  # commands that go on from what they have done


def _say_how_to_go_on(arguments):
    """Print what an interrupted command has left, and the command that goes on."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    command = next((word for word in words if not word.startswith("-")), "")
    if command == "run":  # --force would begin anew
        words = [word for word in words if word not in ("--force", "--resume")] + ["--resume"]
    kept, what = ("what is done is kept", "go on") if command in _KEEPING else ("nothing is kept", "start again")
    line = f"interrupted, {kept}; to {what}: {shlex.join(['apt-evap', *words])}"
    with contextlib.suppress(OSError):  # stderr is closed
        print(f"apt-evap: {line}", file=sys.stderr)


def _execute(arguments):
    """Run a command. Its module and all it needs are imported here, where Ctrl-C is handled."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    module = import_module("apt_evap.cli.parser")
    command = next((word for word in arguments if word in module.COMMANDS), "")
    try:
        options = module.make_parser(command).parse_args(arguments)
        options.arguments = arguments
    except SystemExit as stop:  # --help and --version
        return stop.code or 0
    return import_module(f"apt_evap.cli.{options.command}").execute(options)


@contextmanager
def _drawing_into_files() -> Iterator[None]:
    """Let matplotlib, in this process and those that it starts, draw without a screen and with its default settings.

    The backend of a notebook, for example, is inherited by its terminals, and cannot be imported in every environment;
    a matplotlibrc of the user may need LaTeX.
    """
    settings = {"MPLBACKEND": "agg", "APT_EVAP_DEFAULT_STYLE": "1"}
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _imports(frame):
    """Whether a module is being imported, where what the signal raises may be lost.

    Modules of Cython with memory views have an ``except:`` in their beginning, libraries for what they need not have.
    """
    while frame is not None:
        if "importlib._bootstrap" in frame.f_code.co_filename:
            return True
        frame = frame.f_back
    return False


@contextmanager
def _terminated_like_interrupted() -> Iterator[list[int]]:
    """Handle SIGTERM like Ctrl-C; yields a list that contains the signal after its arrival."""
    signals: list[int] = []
    later: list[threading.Timer] = []
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield signals
        return

    def interrupt(number: int, frame: Any) -> None:
        signals.append(number)
        handler = signal.getsignal(signal.SIGINT)
        if handler in (signal.default_int_handler, signal.SIG_IGN, None) and len(signals) < _LAST and _imports(frame):
            with contextlib.suppress(RuntimeError):  # no thread can be started
                later[:] = [threading.Timer(_PAUSE, signal.raise_signal, [number])]
                later[0].daemon = True
                later[0].start()
                return
        (handler if callable(handler) else signal.default_int_handler)(signal.SIGINT, frame)

    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield signals
    finally:
        for timer in later:
            timer.cancel()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


if __name__ == "__main__":  # python -m apt_evap.cli.main, as python -m apt_evap
    sys.exit(main())
