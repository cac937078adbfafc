"""`apt-evap completion`: the script, in the shell that it is for."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from apt_evap.cli.main import main

COMPLETE = """
source ./script
COMP_WORDS=("$@"); COMP_CWORD=$(( $# - 1 )); COMPREPLY=()
entry=$(complete -p apt-evap | sed 's/.*-F \\([^ ]*\\).*/\\1/')
$entry apt-evap "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


def completed(*words):
    done = subprocess.run(
        ["bash", "--norc", "-c", COMPLETE, "bash", "apt-evap", *words], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_bash_completes(tmp_path, monkeypatch, capsys):
    pytest.importorskip("shtab")
    monkeypatch.chdir(tmp_path)
    assert main(["completion", "bash"]) == 0
    Path("script").write_text(capsys.readouterr().out)
    for name in ("ni111.h5", "other.epos"):
        Path(name).touch()
    Path("study").mkdir()
    assert {"run", "map", "compare", "examples"} < completed("")
    assert completed("comp") == {"compare", "completion", "composition"}
    assert completed("compare", "--me") == {"--means", "--mechanism"}
    assert completed("compare", "--mechanism", "") == {"roll-up", "lateral", "combined"}
    assert completed("map", "ni") == {"ni111.h5"}
    assert completed("map", "ni111.h5", "-o", "oth") == {"other.epos"}
    assert completed("examples", "--to", "") == {"study"}  # folders only
    assert completed("completion", "z") == {"zsh"}


@pytest.mark.parametrize("shell", ["zsh", "fish", "tcsh"])
def test_other_shells_accept_their_script(shell, tmp_path, capsys):
    pytest.importorskip("shtab")
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "apt-evap" in script and "--mechanism" in script
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    (tmp_path / "script").write_text(script)
    done = subprocess.run([shell, "-n", str(tmp_path / "script")], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""


def test_without_shtab(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert (
        "completion needs shtab, which is not installed: pip install 'apt_evap[completion]'" in capsys.readouterr().err
    )
