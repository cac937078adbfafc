"""What the shell does to a program: closed and full streams, encodings, Ctrl-C while it is being loaded."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from systems import IS_WINDOWS, SHELL

from apt_evap import cli
from apt_evap.detection.hits import Hits
from apt_evap.io.formats import write

HERE = str(Path(cli.__file__).parents[2])  # the package under test, installed or not
PROGRAM = "import sys; from apt_evap.cli.main import main; sys.exit(main())"
SMALL = '[tip]\nmaterial = "Ni"\napex_radius = "4 a"\nshank_length = "4 a"\n[simulation]\nions = 3\nresponses = false\n'
FULL = pytest.mark.skipif(IS_WINDOWS or not Path("/dev/full").exists(), reason="needs /dev/full")


@pytest.fixture
def folder(tmp_path):
    random = np.random.default_rng(1)
    x, y = random.uniform(-20, 20, (2, 50))
    write(tmp_path / "ions.epos", Hits(x=x, y=y, mass_to_charge=np.full(50, 58.0), pulse_id=np.arange(50)))
    (tmp_path / "small.toml").write_text(SMALL)
    return tmp_path


def shell(folder, redirection, *arguments, **environment):
    """Run the program with its streams redirected as a shell writes it; its code, stdout and stderr."""
    shell = ["sh", "-c", f'exec "$@" {redirection}', "sh"] if redirection else []
    done = subprocess.run(
        [*shell, sys.executable, "-c", PROGRAM, *arguments],
        cwd=folder,
        capture_output=True,
        env=os.environ | {"PYTHONPATH": HERE} | environment,
        timeout=120,
    )
    return done.returncode, *(
        stream.decode(errors="replace").replace(os.linesep, "\n") for stream in (done.stdout, done.stderr)
    )


@pytest.mark.slow
@SHELL
def test_a_run_without_stderr(folder):
    code, out, _ = shell(folder, "2>&-", "run", "small.toml")
    assert code == 0 and out.endswith("wrote small.h5\nwrote small.png\n")
    assert sorted(os.listdir(folder)) == ["ions.epos", "small.h5", "small.png", "small.toml"]


@pytest.mark.slow
@SHELL
@pytest.mark.parametrize("arguments", [("info", "ions.epos"), ("map", "ions.epos"), ("--version",)], ids=" ".join)
def test_commands_without_stdout(folder, arguments):
    assert shell(folder, "<&- >&- 2>&-" if arguments[0] == "map" else ">&-", *arguments) == (0, "", "")
    assert (folder / "ions_map.png").exists() == (arguments[0] == "map")


@pytest.mark.slow
@SHELL
def test_an_error_does_not_go_to_stdout_for_want_of_stderr(folder):
    assert shell(folder, "2>&-", "info", "none.epos") == (2, "", "")


@FULL
@pytest.mark.parametrize(
    "arguments",
    [("--version",), *(pytest.param(words, marks=pytest.mark.slow) for words in (("--help",), ("info", "ions.epos")))],
    ids=" ".join,
)
def test_a_full_stdout_is_an_error(folder, arguments):
    sentence = "apt-evap: error: cannot write to the standard output: No space left on device\n"
    assert shell(folder, ">/dev/full", *arguments) == (2, "", sentence)


@FULL
def test_a_full_stderr_is_no_error(folder):
    assert shell(folder, "2>/dev/full", "info", "none.epos") == (2, "", "")


@pytest.mark.slow
def test_a_terminal_that_knows_ascii_alone(folder):
    os.rename(folder / "ions.epos", folder / "Å.epos")
    code, out, err = shell(folder, "", "map", "Å.epos", PYTHONIOENCODING="ascii", PYTHONUTF8="1")
    assert (code, out, err) == (0, "wrote \\xc5_map.png\n", "")


@pytest.mark.slow
@pytest.mark.skipif(IS_WINDOWS, reason="Windows has no locale of ASCII")
def test_a_locale_without_degree_signs(folder):
    """The C locale without its mode of UTF-8: ASCII, and another handler of errors than other locales have."""
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0"}
    print_one = r"import apt_evap.cli._output as o; o.open_missing_streams(); o.put('20\u00b0 \u00b1 1 caf\udce9')"
    done = subprocess.run(
        [sys.executable, "-P", "-c", print_one],
        capture_output=True,
        env=os.environ | {"PYTHONPATH": HERE} | locale,
        timeout=120,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"20\\xb0 \\xb1 1 caf\\udce9\n", b"")
    os.rename(folder / "ions.epos", folder / "Å.epos")
    assert shell(folder, "", "map", "Å.epos", **locale)[::2] == (0, "")
    # a name in a settings file that this locale cannot write
    (folder / "small.toml").write_text(f'output = "Å.h5"\n{SMALL}', encoding="utf-8")
    code, _, err = shell(folder, "", "run", "small.toml", **locale)
    assert code == 2 and "path must be a file name in" in err


def test_ctrl_c_while_libraries_are_loaded(folder):
    """A library in place of h5py presses it as it is imported."""
    (folder / "h5py.py").write_text("import signal, time\nsignal.raise_signal(signal.SIGINT)\ntime.sleep(60)\n")
    path = os.pathsep.join([str(folder), HERE])
    found = shell(folder, "", "run", "small.toml", PYTHONPATH=path)
    go_on = "what is done is kept; to go on: apt-evap run small.toml --resume"
    assert found == (130, "", f"apt-evap: interrupted, {go_on}\n")


@pytest.mark.slow
def test_a_quiet_run_writes_nothing_to_stderr(folder):
    """In the development mode, which shows errors of finalisers in every version of Python."""
    mode = {"PYTHONDEVMODE": "1", "PYTHONWARNINGS": "ignore::DeprecationWarning"}  # other packages may have some
    assert shell(folder, "", "run", "small.toml", "--quiet", **mode) == (0, "", "")
    assert shell(folder, "", "info", "small.h5", **mode)[::2] == (0, "")
