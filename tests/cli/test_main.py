import importlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from systems import MODES, PIPES, TERMINAL

from apt_evap import __version__, cli, plot
from apt_evap.cli import _progress
from apt_evap.cli import main as cli_main
from apt_evap.cli.main import main
from apt_evap.cli.parser import EXIT_CODES
from apt_evap.detection.hits import Hits
from apt_evap.emission.perturbations import Combined, LateralVelocity, RollUp, Unperturbed
from apt_evap.io.formats import write
from apt_evap.simulation.run import load
from apt_evap.workflows import simulate_file

HERE = str(Path(cli.__file__).parents[2])  # the package under test, installed or not
NO_PICTURES = pytest.mark.usefixtures("blank_pictures")
PROGRAM = "import sys; from apt_evap.cli.main import main; sys.exit(main())"
SMALL = """
[tip]
material = "Ni"
axis = [1, 1, 1]
apex_radius = "6 a"
shank_length = "6 a"

[simulation]
ions = 60
seed = 1
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.toml").write_text(SMALL)
    return tmp_path


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A run, made once by the command line."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "small.toml").write_text(SMALL)
    assert main(["run", str(folder / "small.toml"), "-o", str(folder / "small.h5"), "--quiet"]) == 0
    return folder / "small.h5"


@pytest.fixture
def measured(folder):
    """An .epos of 4,000 ions on a comb of 0.5 mm, a tenth of them in pulses of two."""
    random = np.random.default_rng(1)
    x, y = 0.5 * random.integers(-40, 41, (2, 4000))
    pulse_id = np.arange(4000)
    pulse_id[1:400:2] -= 1
    voltage = np.linspace(3000, 5000, 4000)
    write("ions.epos", Hits(x=x, y=y, voltage=voltage, mass_to_charge=np.full(4000, 58.0), pulse_id=pulse_id))
    return folder / "ions.epos"


def failed(capsys, *arguments):
    """The sentence of a command that fails."""
    before = sorted(os.listdir())
    assert main([str(argument) for argument in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and re.fullmatch(r"apt-evap: error: [^\n]+\n", err)
    assert sorted(os.listdir()) == before
    return err.replace(os.sep, "/")


# ---- run -------------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("rough_layout")
def test_run_writes_run_and_picture_and_says_so(folder, capsys):
    assert main(["run", "small.toml", "--threads", "1"]) == 0
    out, err = capsys.readouterr()
    assert err == ""  # no bar where there is no terminal
    run = load("small.h5")
    hit, missed, never_left, _ = run.hits(Unperturbed()).counts.values()
    assert f"unperturbed: {hit} hit the detector, {missed} missed it, {never_left} never left" in out
    assert "60 ions in" in out and out.endswith("wrote small.h5\nwrote small.png\n")
    assert len(run) == 60 and run.seed == 1 and run.ended == ""
    assert run.provenance["config"] == "small.toml"
    assert np.ptp(imread("small.png")[..., :3]) > 0.5
    assert sorted(os.listdir()) == ["small.h5", "small.png", "small.toml"]


@NO_PICTURES
def test_options_go_before_the_file(folder, capsys):
    arguments = ["run", "small.toml", "-o", "other.h5", "--ions", "20", "--seed", "5", "--map", "other.svg", "--quiet"]
    assert main(arguments) == 0
    assert capsys.readouterr() == ("", "")
    run = load("other.h5")
    assert len(run) == 20 and run.seed == 5
    assert sorted(os.listdir()) == ["other.h5", "other.svg", "small.toml"]


@NO_PICTURES
def test_the_output_of_the_file_is_the_default(folder):
    (folder / "small.toml").write_text('output = "named.h5"\n' + SMALL)
    assert main(["run", "small.toml", "--ions", "5", "--quiet"]) == 0
    assert (folder / "named.h5").exists() and (folder / "named.png").exists()


@NO_PICTURES
def test_run_foretells_its_time_and_says_what_it_does_before_the_first_ion(folder, capsys, monkeypatch):
    told_before = []

    def simulation(config, **options):
        told_before.append(capsys.readouterr().out)
        raise ValueError("stopped here")

    monkeypatch.setattr("apt_evap.simulation.config.simulation_file.Config.simulation", simulation)
    assert main(["run", "small.toml", "--ions", "50"]) == 2
    (told,) = told_before
    assert (
        "50 ions of " in told and " GB, " in told and re.search(r", \d+ s of one thread\n", told) and "surface" in told
    )


def test_the_bar_of_a_run_fits_a_terminal(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with _progress.ProgressBar() as bar:
        bar(200_000, 1_000_000)
        bar(600_000, 1_000_000)
        bar.bar.refresh()
        text = str(bar.bar)
    assert len(text) <= 80 and "60%" in text and "600000 of 1000000" in text
    assert len(text.split("|")[1]) >= 20


@pytest.mark.usefixtures("blank_pictures")
def test_the_run_is_that_of_python_whatever_the_threads(folder, made):
    assert main(["run", "small.toml", "--threads", "2", "--quiet"]) == 0
    one, two = load(made), load("small.h5")
    for perturbation in (Unperturbed(), RollUp(0.2)):
        assert np.array_equal(one.hits(perturbation).x, two.hits(perturbation).x)


@NO_PICTURES
def test_without_responses_the_perturbations_of_the_maps_are_flown(folder, capsys):
    (folder / "small.toml").write_text(SMALL + 'responses = false\n[[maps.panels]]\nperturbation = "RollUp:0.2"\n')
    assert main(["run", "small.toml"]) == 0
    assert "roll-up, 0.2 eV: " in capsys.readouterr().out
    run = load("small.h5")
    assert run.responses is None and run.perturbations == (RollUp(0.2),)
    assert main(["map", "small.h5"]) == 0 and main(["info", "small.h5"]) == 0


def datasets(path):
    """Every dataset of a file but its time, by name."""
    found = {}

    def note(name, item):
        if isinstance(item, h5py.Dataset) and name not in ("entry1/start_time", "entry1/simulation/provenance"):
            found[name] = np.asarray(item[()])

    with h5py.File(path) as file:
        file.visititems(note)
    return found


@pytest.mark.slow
@NO_PICTURES
def test_a_run_is_made_longer_by_resume(folder, made, capsys):
    assert main(["run", "small.toml", "--ions", "25", "--quiet"]) == 0
    assert main(["run", "small.toml", "--checkpoint", "0"]) == 0  # with --resume or without, the run goes on
    out = capsys.readouterr().out
    assert "resumed at 25 of 60 ions\n" in out and "60 ions, 35 of them new, in" in out
    assert "wrote small.h5" in out
    before = (folder / "small.h5").stat()
    assert main(["run", "small.toml"]) == 0
    told = "small.h5 is complete: nothing to do, overwrite=True (--force) begins again\n"
    out = capsys.readouterr().out
    assert out.endswith(told) and "of one thread" not in out and "building" not in out  # as nothing is simulated
    assert main(["run", "small.toml", "--resume", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["wrote"] is None and told["ions"] == 60
    assert (folder / "small.h5").stat().st_mtime_ns == before.st_mtime_ns
    one, two = datasets(made), datasets("small.h5")
    assert one.keys() == two.keys() and "entry1/atom_probe/hit_finding/hit_positions" in one
    assert [name for name in one if one[name].tobytes() != two[name].tobytes()] == []
    assert load("small.h5").provenance["config"] == "small.toml"
    assert sorted(os.listdir()) == ["small.h5", "small.png", "small.toml"]
    assert "seed is 1 in the stored run, 2 in the new one" in failed(
        capsys, "run", "small.toml", "--resume", "--seed", "2", "--quiet"
    )
    fewer = "(--ions) must be >= 60, the number of ions of the run in 'small.h5', got 50: overwrite=True (--force)"
    assert fewer in failed(capsys, "run", "small.toml", "--ions", "50", "--quiet")


@NO_PICTURES
def test_an_unfinished_run_is_resumed_or_replaced_as_requested(folder, made, capsys):
    assert main(["run", "small.toml", "--ions", "25", "--quiet"]) == 0
    load("small.h5").ended_by("unfinished").save("small.h5.unfinished")
    os.unlink("small.h5")
    message = failed(capsys, "run", "small.toml", "--seed", "2", "--quiet")
    assert "'small.h5' cannot be resumed with other settings (seed" in message and "(--force) replaces it" in message
    assert main(["info", "small.h5.unfinished"]) == 0
    told = capsys.readouterr().out
    assert "unfinished run of 25 ions" in told and "the same command goes on" in told
    assert "No such file or directory; an unfinished run is in 'small.h5.unfinished'" in failed(
        capsys, "info", "small.h5"
    )
    assert main(["run", "small.toml", "--quiet", "--ions", "30"]) == 0
    assert len(load("small.h5")) == 30
    os.rename("small.h5", "small.h5.unfinished")
    assert main(["run", "small.toml", "--quiet", "--force", "--ions", "5"]) == 0
    assert len(load("small.h5")) == 5
    assert sorted(os.listdir()) == ["small.h5", "small.png", "small.toml"]


@pytest.mark.slow
@NO_PICTURES
def test_a_run_is_replaced_with_force_only_and_so_are_files_of_others(folder, capsys):
    quick = ["run", "small.toml", "--ions", "5", "--quiet"]
    assert main(quick) == 0
    created = (folder / "small.h5").stat().st_mtime_ns, (folder / "small.png").stat().st_mtime_ns
    assert main(quick) == 0
    with_seed = (
        "small.h5' cannot be resumed with other settings (seed is 1 in the stored run, 2 in the new one): "
        "overwrite=True (--force) replaces it"
    )
    assert with_seed in failed(capsys, *quick, "--seed", "2")
    assert created == ((folder / "small.h5").stat().st_mtime_ns, (folder / "small.png").stat().st_mtime_ns)
    assert main([*quick[:-1], "--force"]) == 0
    assert "replaced small.h5\nreplaced small.png\n" in capsys.readouterr().out
    assert created[0] < (folder / "small.h5").stat().st_mtime_ns
    assert created[1] < (folder / "small.png").stat().st_mtime_ns
    load("small.h5").ended_by("interrupted").save("small.h5")
    assert main(quick) == 0  # goes on

    (folder / "small.png").write_bytes(b"a photograph")
    assert "'small.png' exists and was not made by apt-evap: --force overwrites it" in failed(capsys, *quick)
    with h5py.File("small.h5", "w") as other:
        other["measured"] = [1, 2]
    assert "'small.h5' exists and was not made by apt-evap" in failed(capsys, *quick)
    (folder / "small.h5").write_bytes(b"text")
    assert "'small.h5' exists and was not made by apt-evap" in failed(capsys, *quick)
    assert (folder / "small.h5").read_bytes() == b"text"
    assert main([*quick, "--force"]) == 0
    assert len(load("small.h5")) == 5


def test_what_cannot_be_written_is_said_before_computing(folder, capsys, monkeypatch):
    monkeypatch.setattr(simulate_file, "config_of", checked := Counting(simulate_file.config_of))
    assert "cannot write 'none/a.h5': No such file or directory" in failed(
        capsys, "run", "small.toml", "-o", "none/a.h5"
    )
    assert "cannot write 'none/a.png'" in failed(capsys, "run", "small.toml", "--map", "none/a.png")
    (folder / "folder.h5").mkdir()
    assert "cannot write 'folder.h5': Is a directory" in failed(capsys, "run", "small.toml", "-o", "folder.h5")
    assert "with the suffix .h5, got 'a.hdf'" in failed(capsys, "run", "small.toml", "-o", "a.hdf")
    assert "a picture is a .png, .pdf, .svg file, got 'a.jpg'" in failed(capsys, "run", "small.toml", "--map", "a.jpg")
    assert [config.simulated for config in checked.given] == [False] * 5


class Counting:
    """Reads configs and notes whether a simulation was built of them."""

    def __init__(self, read):
        self.read, self.given = read, []

    def __call__(self, *arguments, **options):
        self.given.append(Noting(self.read(*arguments, **options)))
        return self.given[-1]


class Noting:
    def __init__(self, config):
        self.config, self.simulated = config, False

    def __getattr__(self, name):
        if name == "simulation":
            self.simulated = True
        return getattr(self.config, name)


def test_wrong_configs_are_one_sentence(folder, made, capsys):
    def wrong(old, new):
        (folder / "wrong.toml").write_text(SMALL.replace(old, new))
        return failed(capsys, "run", "wrong.toml", "--quiet")

    assert "'wrong.toml', [tip]: no key is named 'apex' (did you mean 'apex_radius'?)" in wrong("apex_radius", "apex")
    assert "'wrong.toml', [tip]: apex_radius must be a finite number [nm] >=" in wrong("6 a", "1 a")
    assert "'wrong.toml', [simulation]: ions must be an integer >= 1, got 'many'" in wrong("60", '"many"')
    assert "GB are free; give a depth" in wrong("6 a", "90000 a")
    assert "'wrong.toml' is not a TOML file" in wrong("=", ":")
    assert "cannot read 'none.toml'" in failed(capsys, "run", "none.toml")
    assert f"'{made.as_posix()}' is a run: see apt-evap info" in failed(capsys, "run", made)


@pytest.mark.slow
@NO_PICTURES
def test_a_run_that_ends_early_says_why(folder, capsys):
    (folder / "small.toml").write_text(SMALL.replace("6 a", "3 a") + "responses = false\n")
    assert main(["run", "small.toml", "--ions", "100000"]) == 0
    run = load("small.h5")
    assert 0 < len(run) < 100_000 and run.ended
    assert f"apt-evap: note: the run ended early: {run.ended}; its {len(run):,} ions" in (capsys.readouterr().err)


def test_a_failing_picture_leaves_the_run(folder, capsys, monkeypatch):
    def break_down(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", break_down)
    assert main(["run", "small.toml", "--ions", "5", "--quiet"]) == 2
    err = capsys.readouterr().err
    assert "no maps are drawn, the run is in 'small.h5': cannot write 'small.png': No space left on device" in err
    assert sorted(os.listdir()) == ["small.h5", "small.toml"]


def test_memory_and_interrupts_are_no_tracebacks_but_bugs_are(folder, capsys, monkeypatch):
    def raising(error):
        def run(*_, **__):
            raise error

        monkeypatch.setattr("apt_evap.simulation.simulation.Simulation.run", run)

    raising(MemoryError())
    assert "not enough memory" in failed(capsys, "run", "small.toml", "--quiet")
    raising(KeyboardInterrupt())
    assert main(["run", "small.toml", "--quiet"]) == 130
    go_on = "to go on: apt-evap run small.toml --quiet --resume"
    assert capsys.readouterr().err == f"apt-evap: interrupted, what is done is kept; {go_on}\n"
    raising(ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        main(["run", "small.toml", "--quiet"])
    assert os.listdir() == ["small.toml"]


@pytest.mark.slow
@NO_PICTURES
def test_progress_without_a_terminal_is_plain_lines(folder, capsys, monkeypatch):
    monkeypatch.setattr(_progress, "SECONDS_BETWEEN_LINES", 0.0)
    (folder / "small.toml").write_text(SMALL + "responses = false\n")
    assert main(["run", "small.toml", "--ions", "600", "--threads", "1"]) == 0
    line = re.search(r"\n(3\d\d) of 600 ions \((\d\d%)\), [\d.,]+ ions/s, \d+ s left\n", capsys.readouterr().err)
    assert line and line[2] == f"{int(line[1]) / 600:.0%}"
    assert main(["run", "small.toml", "--ions", "600", "--threads", "1", "--quiet"]) == 0
    assert capsys.readouterr().err == ""


@NO_PICTURES
def test_a_run_that_misses_the_detector_says_so(folder, capsys):
    (folder / "small.toml").write_text(SMALL + "[detector]\nwidth = 60\n")
    assert main(["run", "small.toml"]) == 0
    note = (
        r"note: (\d+) of 60 ions miss the detector, which is 60 mm wide at 100 mm: use a larger width or a "
        r"smaller distance"
    )
    assert int(re.search(note, capsys.readouterr().err)[1]) > 30


@TERMINAL
@pytest.mark.parametrize(
    ("sent", "code"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)]
)
def test_ctrl_c_and_sigterm_keep_what_is_done(folder, sent, code):
    import termios

    terminal, end = os.openpty()
    termios.tcsetwinsize(end, (24, 100))
    (folder / "small.toml").write_text(SMALL.replace("6 a", "8 a"))
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "run", "small.toml", "--ions", "5000", "--threads", "1"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": HERE},
        stdout=subprocess.PIPE,
        stderr=end,
        text=True,
    )
    os.close(end)
    seen = b""
    try:
        # the bar has started once it counts ions
        while not re.search(rb"[1-9]\d* of 5000", seen):
            assert process.poll() is None
            seen += os.read(terminal, 1000)
        process.send_signal(sent)
        deadline = time.monotonic() + 60
        while process.poll() is None and time.monotonic() < deadline:
            try:
                seen += os.read(terminal, 1000)
            except OSError:  # Linux says so that the other end is closed
                break
        out, _ = process.communicate(timeout=60)
    finally:
        process.kill()
        os.close(terminal)
    assert process.returncode == code
    run = load(folder / "small.h5")
    assert run.ended == "interrupted" and 0 < len(run) < 5000
    said = f"interrupted; {len(run):,} of 5,000 ions are in 'small.h5': --resume continues"
    assert said.encode() in seen
    assert b"Traceback" not in seen and out.endswith("wrote small.h5\nwrote small.png\n")
    assert sorted(os.listdir(folder)) == ["small.h5", "small.png", "small.toml"]


def test_an_interrupted_exec_of_a_library_does_not_change_the_exit_code(tmp_path):
    (tmp_path / "program.py").write_text(
        "import sys\nfrom apt_evap.cli import main\n"
        "main._execute = lambda _: exec('raise KeyboardInterrupt')\nsys.exit(main.main(['info', 'a']))\n"
    )
    environment = os.environ | {"PYTHONPATH": HERE}
    ended = subprocess.run(
        [sys.executable, "-m", "program"], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert ended.returncode == 130 and "apt-evap info a" in ended.stderr


def test_a_signal_during_an_import_is_not_lost(tmp_path, monkeypatch, capsys):
    """As in the beginning of modules of Cython."""
    (tmp_path / "swallowing.py").write_text(
        "import signal, time\ntry:\n    signal.raise_signal(signal.SIGTERM)\n    time.sleep(0.1)\nexcept:\n    pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))

    def execute(_):
        importlib.import_module("swallowing")
        for _ in range(500):
            time.sleep(0.01)
        return 0

    monkeypatch.setattr(cli_main, "_execute", execute)
    assert main(["info", "a"]) == 143 and "swallowing" in sys.modules
    assert "interrupted, nothing is kept; to start again: apt-evap info a" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_the_command_that_goes_on_does(folder, monkeypatch, capsys, sent):
    """What is printed after an interrupt is run as it stands, and gives the run that was asked for first."""

    def progress(quiet):
        return lambda ions, n_ions: signal.raise_signal(sent) if 0 < ions < n_ions else None

    ions = 1_200  # several chunks, so that some are left at the interrupt
    with monkeypatch.context() as patched:
        patched.setattr("apt_evap.cli._progress.run_progress", progress)
        code = main(["run", "small.toml", "--ions", str(ions), "--threads", "1", "--force"])
    assert code == (143 if sent == signal.SIGTERM else 130)
    told = capsys.readouterr().err
    assert 0 < len(load("small.h5")) < ions
    (command,) = re.findall(r"^apt-evap: interrupted, what is done is kept; to go on: (.*)$", told, re.MULTILINE)
    assert command == f"apt-evap run small.toml --ions {ions} --threads 1 --resume"
    assert main(shlex.split(command)[1:]) == 0
    assert len(load("small.h5")) == ions


def test_other_commands_start_again(folder, monkeypatch, capsys):
    def read(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("apt_evap.cli._files.read_file", read)
    assert main(["map", "a b.epos", "--bins", "32"]) == 130
    told = capsys.readouterr().err
    assert told == "apt-evap: interrupted, nothing is kept; to start again: apt-evap map 'a b.epos' --bins 32\n"


# ---- map -------------------------------------------------------------------------------------------------------------


def drawn_by(monkeypatch, *arguments):
    """Maps and titles that a command draws."""
    drawn = {}

    def note(maps, titles, **options):
        drawn.update(maps=maps, titles=titles)
        return original(maps, titles, **options)

    original = plot.detector_maps
    monkeypatch.setattr(plot, "detector_maps", note)
    assert main([str(argument) for argument in arguments]) == 0
    monkeypatch.setattr(plot, "detector_maps", original)
    return drawn["maps"], drawn["titles"]


@pytest.mark.usefixtures("rough_layout")
def test_map_of_a_run_shows_the_whole_detector(folder, made, monkeypatch, capsys):
    maps, titles = drawn_by(monkeypatch, "map", made)
    assert capsys.readouterr().out == "wrote small_map.png\n" and (folder / "small_map.png").exists()
    assert titles == ["unperturbed", "roll-up, 0.155 ± 0.155 eV"]
    run = load(made)
    assert maps[0].ions == run.hits(Unperturbed()).counts[0]
    for each in maps:
        assert each.extent == (-150, 150, -150, 150) and each.mask.all()
        # few ions: smaller bins, the same smoothing
        assert each.values.shape == (128, 128) and each.smoothing == pytest.approx(300 / 32)


@NO_PICTURES
def test_map_of_a_run_under_any_perturbation(folder, made, monkeypatch):
    wanted = ["--perturbation", "LateralVelocity:0.3", "--perturbation", "Combined:0.3,0.1,0.75"]
    maps, titles = drawn_by(monkeypatch, "map", made, *wanted, "--bins", "16", "--smooth", "0", "-o", "a.pdf")
    run = load(made)
    same = [run.hits(LateralVelocity(0.3)).counts[0], run.hits(Combined(0.3, 1)).counts[0]]
    assert maps[0].counts.sum() == same[0] and len(titles) == 2
    assert maps[0].values.shape == (16, 16) and maps[0].smoothing == 0
    assert drawn_by(monkeypatch, "map", made, "-o", "a.pdf")[1] != titles  # overwrites its own


@pytest.mark.slow
def test_a_run_is_drawn_with_the_maps_of_its_config(folder, monkeypatch):
    panels = (
        '[maps]\nbins = 24\nsmoothing = 20\n[[maps.panels]]\ntitle = "side"\nperturbation = "LateralVelocity:0.3"\n'
    )
    (folder / "small.toml").write_text(SMALL + panels)
    ran = drawn_by(monkeypatch, "run", "small.toml", "--quiet")
    again = drawn_by(monkeypatch, "map", "small.h5")
    for maps, titles in (ran, again):
        assert titles == ["side"] and maps[0].values.shape == (24, 24) and maps[0].smoothing == 20
    assert (folder / "small.png").read_bytes() == (folder / "small_map.png").read_bytes()
    (maps, _) = drawn_by(monkeypatch, "map", "small.h5", "--bins", "30")
    assert maps[0].values.shape == (30, 30) and maps[0].smoothing == 10


@NO_PICTURES
def test_map_of_measured_ions_keeps_to_their_comb(measured, monkeypatch):
    (only,), titles = drawn_by(monkeypatch, "map", measured)
    assert titles == ["ions.epos"] and only.position_step == pytest.approx((0.5, 0.5))
    # 4,000 ions: a tooth of the comb each, smoothed as bins of a 64th of its 81 teeth
    assert only.bin_size == pytest.approx((0.5, 0.5)) and only.smoothing == pytest.approx(81 * 0.5 / 64)


@NO_PICTURES
def test_what_was_written_is_told_as_json_or_not_at_all(folder, capsys):
    assert main(["run", "small.toml", "--json", "--map", "small.svg"]) == 0
    out, err = capsys.readouterr()
    told = json.loads(out)
    run = load("small.h5")
    assert out.count("\n") == 1 and err == ""
    assert (told["wrote"], told["picture"], told["ions"], told["ended"]) == ("small.h5", "small.svg", 60, "as planned")
    assert [told[key] for key in ("hit", "missed", "never_left")] == list(run.hits(Unperturbed()).counts.values())[:3]
    assert main(["map", "small.h5", "--json", "--perturbation", "RollUp:0.2", "--bins", "16"]) == 0
    told = json.loads(capsys.readouterr().out)
    on_it = int(np.count_nonzero(run.hits(RollUp(0.2)).detected))
    assert told["wrote"] == "small_map.png" and Path(told["wrote"]).exists()
    (only,) = told["maps"]
    assert (only["title"], only["ions"], only["bins"]) == ("roll-up, 0.2 eV", on_it, [16, 16])
    assert main(["map", "small.h5", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert "not allowed with argument" in failed(capsys, "map", "small.h5", "--quiet", "--json")


@NO_PICTURES
def test_map_errors(measured, made, capsys):
    write("ions.pos", Hits(positions=np.zeros((3, 3)), mass_to_charge=np.ones(3)))
    assert (
        "'ions.pos' has no detector coordinates x and y, which a map needs, only mass_to_charge, positions"
        in failed(capsys, "map", "ions.pos")
    )
    assert "--perturbation needs a run (.h5), 'ions.epos' contains measured ions" in failed(
        capsys, "map", "ions.epos", "--perturbation", "Unperturbed"
    )
    assert "did you mean 'RollUp'" in failed(capsys, "map", made, "--perturbation", "Rollup:0.1")
    assert "energy, got nothing; an example is RollUp:0.155,0.155" in failed(
        capsys, "map", made, "--perturbation", "RollUp"
    )
    assert "argument --bins: must be an integer from 1 to 16384, got '0'" in failed(capsys, "map", made, "--bins", "0")
    assert "argument --smooth: must be a number [mm] >= 0, got 'nan'" in failed(capsys, "map", made, "--smooth", "nan")
    assert "exists and was not made by apt-evap" not in failed(capsys, "map", "none.epos")
    Path("ions_map.png").write_bytes(b"a photograph")
    assert "'ions_map.png' exists and was not made by apt-evap" in failed(capsys, "map", "ions.epos")
    assert main(["map", "ions.epos", "--force"]) == 0


# ---- info ------------------------------------------------------------------------------------------------------------


def test_info_of_a_run(made, capsys):
    assert main(["info", str(made), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    run = load(made)
    counts = run.hits(Unperturbed()).counts
    assert told["kind"] == "simulated run" and told["version"] == __version__ and told["ended"] == "as planned"
    assert told["ions"] == told["species"]["Ni"] == 60 and told["seed"] == 1 and told["voltage"] == 1000
    assert [told["outcomes"][key] for key in ("hit", "missed", "never_left")] == list(counts.values())[:3]
    assert told["tip"]["axis"] == [1, 1, 1] and told["tip"]["material"]["name"] == "Ni"
    assert told["responses"]["flagged"] == run.flagged.sum() and told["perturbations_flown"] == []
    low, high = told["field_before_leaving"]
    # six digits are kept
    assert low == pytest.approx(run.fields.min(), rel=1e-5) and high == pytest.approx(run.fields.max(), rel=1e-5)
    assert main(["info", str(made)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^ions +60$", text, re.M) and re.search(r"^  apex radius \[nm\] +2\.112$", text, re.M)
    assert re.search(r"^field before leaving \[V/nm\] +[\d.]+ to [\d.]+ at 1000 V \(only its ratio", text, re.M)


def test_info_of_measured_ions(measured, capsys):
    assert main(["info", "ions.epos", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["ions"] == told["detected"] == 4000
    assert told["columns"]["x"] == [-20, 20] and told["columns"]["voltage"] == [3000, 5000]
    assert told["detector_extent"] == [40, 40] and told["detector_quantum"] == [0.5, 0.5]
    assert told["multi_hit_share"] == 0.1 and told["largest_multi_hit"] == 2
    assert main(["info", "ions.epos"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^  voltage \[V\] +3000 to 5000$", text, re.M)
    assert re.search(r"^detector extent \[mm\] +40 x 40$", text, re.M)
    assert re.search(r"^absent or zero throughout +time_of_flight   pulse_voltage   positions   pulses$", text, re.M)


def test_info_of_what_cannot_be_read(measured, made, capsys):
    measured.write_bytes(measured.read_bytes()[:-10])
    assert "ions.epos' ends in the middle of an ion: 3999 complete ions" in (text := failed(capsys, "info", measured))
    assert "partial=True (--partial) reads the complete ions" in text
    assert main(["info", "ions.epos", "--partial", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ions"] == 3999
    Path("cut.h5").write_bytes(made.read_bytes()[:5000])
    assert "'cut.h5' is damaged" in failed(capsys, "info", "cut.h5")
    Path("empty.epos").write_bytes(b"")
    assert "'empty.epos' is empty" in failed(capsys, "info", "empty.epos")
    assert "cannot read 'none.h5'" in failed(capsys, "info", "none.h5")
    error = failed(capsys, "info", "small.toml")
    assert "format of 'small.toml' must be one of " in error and "got suffix '.toml'" in error


def test_warnings_of_readers_are_one_line(measured, capsys):
    content = bytearray(measured.read_bytes())
    content[43] = 0  # the ions of the first pulse
    measured.write_bytes(content)
    assert main(["info", "ions.epos", "--json"]) == 0
    out, err = capsys.readouterr()
    assert "multi_hit_share" not in json.loads(out)
    assert re.fullmatch(r"apt-evap: warning: 'ions.epos': pulses unknown[^\n]+\n", err)


# ---- maps in .npz files ----------------------------------------------------------------------------------------------


@NO_PICTURES
def test_map_and_info_of_a_map(folder, monkeypatch, capsys):
    edges = np.linspace(-20, 20, 41)
    values = np.random.default_rng(1).poisson(5.0, (40, 40))
    np.savez("counts.npz", counts=values, x_edges_mm=edges, y_edges_mm=edges)
    np.savez("density.npz", d=values / 5, x=edges / 10, y=edges / 10)
    (only,), titles = drawn_by(monkeypatch, "map", "counts.npz")
    assert titles == ["counts.npz"] and only.smoothing == 1.0 and only.ions == values.sum()
    named = ["density.npz", "--arrays", "d,x,y", "--unit", "cm"]
    ((only,), _) = drawn_by(monkeypatch, "map", *named)
    assert np.array_equal(only.values, values / 5) and only.smoothing == 0
    capsys.readouterr()
    assert main(["info", *named, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["kind"] == "detector map of densities" and told["ions"] is None and told["bins"] == [40, 40]
    assert told["x"] == [-20, 20] and told["values"] == [values.min() / 5, values.max() / 5]
    assert main(["info", "counts.npz"]) == 0
    assert re.search(r"^bin size \[mm\] +1 x 1$", capsys.readouterr().out, re.M)
    assert "--bins is only for ions, 'counts.npz' is a map: its bins are 40 x 40" in failed(
        capsys, "map", "counts.npz", "--bins", "20"
    )
    assert "--mass is for ions, got 'counts.npz'" in failed(capsys, "info", "counts.npz", "--mass", "1,2")
    assert "'counts.npz' contains a map" in failed(capsys, "map", "counts.npz", "--perturbation", "Unperturbed")


# ---- a selection of ions ---------------------------------------------------------------------------------------------


@pytest.fixture
def mixed(folder):
    """1,000 ions of 28 and 58 Da in turn, the voltage rising with their number."""
    random = np.random.default_rng(2)
    n = np.arange(1000)
    x, y = random.uniform(-20, 20, (2, 1000))
    write("mixed.epos", Hits(x=x, y=y, voltage=3000.0 + n, mass_to_charge=np.where(n % 2, 58.0, 28.0), pulse_id=n))
    (folder / "mixed.rrng").write_text("[Ranges]\nRange1=27.5 28.5 Si:1\nRange2=57.5 58.5 Ni:1\n")
    return x.astype(np.float32), y.astype(np.float32)


@NO_PICTURES
def test_ions_are_selected(mixed, monkeypatch, capsys):
    x, y = mixed

    def ions(*options):
        capsys.readouterr()
        assert main(["info", "mixed.epos", "--json", *options]) == 0
        told = json.loads(capsys.readouterr().out)
        assert told.get("selected_of") == 1000
        return told["ions"]

    assert ions("--mass", "27,29") == ions("--mass", ",28.5") == 500
    assert ions("--voltage", "3100,3200") == ions("--ions", "900,") == 100
    assert ions("--circle", "10") == np.count_nonzero(np.hypot(x, y) <= 10)
    assert ions("--circle", "10,5,-5") == np.count_nonzero(np.hypot(x - 5, y + 5) <= 10)
    assert ions("--ranges", "mixed.rrng", "--species", "Si,Ni") == 1000
    both = ["--ranges", "mixed.rrng", "--species", "Si", "--ions", "0,100", "--voltage", "3050,"]
    assert ions(*both) == 25  # the ions of the file are counted, not those of the species
    (only,), titles = drawn_by(monkeypatch, "map", "mixed.epos", *both)
    assert only.ions <= 25 and titles == ["mixed.epos, Si, 25 of 1,000 ions"]


@NO_PICTURES
def test_ions_of_a_run_are_selected(folder, made, monkeypatch, capsys):
    run = load(made)
    maps, _ = drawn_by(monkeypatch, "map", made, "--ions", "20,", "--perturbation", "Unperturbed")
    assert maps[0].ions == run.hits(Unperturbed())[20:].counts[0]
    capsys.readouterr()
    assert main(["info", str(made), "--ions", "20,", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["kind"], told["ions"]) == ("simulation, Unperturbed()", 40)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--mass", "29,27"], "argument --mass: must be two increasing numbers, such as 27,29.5, got '29,27'"),
        (["--circle", "1,2"], "argument --circle: must be a radius or R,X,Y such as 15,0,-2 [mm], got '1,2'"),
        (["--species", "Si"], "--species needs --ranges"),
        (["--ranges", "mixed.rrng", "--species", "Sn"], "--species: the ranges of 'mixed.rrng' have no species 'Sn'"),
        (["--mass", "1,2"], "the options select none of the 1,000 ions of 'mixed.epos'"),
    ],
)
def test_selections_that_are_refused(mixed, capsys, options, sentence):
    assert sentence in failed(capsys, "info", "mixed.epos", *options)


def test_a_selection_by_a_missing_column_is_refused(folder, capsys):
    write("ions.pos", Hits(positions=np.zeros((3, 3)), mass_to_charge=np.ones(3)))
    assert "--voltage: ions.pos has no column 'voltage', only mass_to_charge, positions" in failed(
        capsys, "info", "ions.pos", "--voltage", "1,2"
    )


# ---- the program -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "the following arguments are required: COMMAND (see apt-evap --help)"),
        (["fly"], "invalid choice: 'fly'"),
        (["mpa"], "invalid choice: 'mpa' (did you mean 'map'?)"),
        (["run"], "the following arguments are required: CONFIG.toml (see apt-evap run --help)"),
        (["run", "small.toml", "--ions", "0"], "argument --ions: must be an integer >= 1, got '0'"),
        (["run", "small.toml", "--threads", "x"], "argument --threads: must be an integer >= 1, got 'x'"),
        (["run", "small.toml", "--colour"], "unrecognized arguments: --colour (see apt-evap run --help)"),
        (["info", "a.epos", "--byte-order", "up"], "argument --byte-order: invalid choice: 'up'"),
    ],
)
def test_wrong_arguments_are_one_sentence(folder, capsys, arguments, sentence):
    assert sentence in failed(capsys, *arguments)


@pytest.mark.parametrize("module", ["apt_evap", "apt_evap.cli.main"])
def test_the_command_line_is_a_module(module):
    told = subprocess.run([sys.executable, "-m", module, "--version"], capture_output=True, text=True)
    assert (told.returncode, told.stdout) == (0, f"apt-evap {__version__}\n")


def test_version_and_help(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"apt-evap {__version__}\n"
    for command in ([], ["run"], ["map"], ["info"]):
        assert main([*command, "--help"]) == 0
        helped = capsys.readouterr().out
        assert re.search(r"^ *(example: )?apt-evap (run|map|info) \S+\.\w+", helped, re.M)
        assert max(map(len, helped.splitlines())) <= 120
    assert main(["--help"]) == 0
    helped = capsys.readouterr().out
    for line in EXIT_CODES.splitlines():
        assert line in helped


@pytest.mark.slow
def test_a_reader_of_the_output_may_leave(made):
    read, write_end = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, "info", str(made)],
        cwd=made.parent,
        stdout=write_end,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": HERE},
    )
    os.close(write_end)
    assert done.returncode == 1 and done.stderr == b""


# ---- told before anything is computed --------------------------------------------------------------------------------


def test_maps_that_cannot_be_drawn_are_told_before_the_simulation(folder, capsys):
    (folder / "broad.toml").write_text(SMALL + "[maps]\nsmoothing = 500.0\n")
    assert "'broad.toml', [maps]: smoothing must be a finite number [mm] <= 300 (the width of the detector)" in (
        failed(capsys, "run", "broad.toml")
    )


def test_a_smoothing_broader_than_the_detector(made, folder, capsys):
    assert "smoothing must be a finite number [mm] <= 300 (the width of the detector), got 400.0" in failed(
        capsys, "map", made, "--smooth", "400"
    )


def test_a_selection_too_small_for_a_map_names_the_option(mixed, capsys):
    assert "--ions leaves one ion on the detector: a map needs more" in failed(
        capsys, "map", "mixed.epos", "--ions", "3,4"
    )
    write("one.epos", Hits(x=np.ones(3), y=np.ones(3), pulse_id=np.arange(3)))
    assert "'one.epos' has 3 ions at one place on the detector" in failed(capsys, "map", "one.epos")


@MODES
def test_files_that_cannot_be_read_are_not_said_to_be_somebody_elses(capsys, monkeypatch):
    """Of a run that another user may not read, --force would not be the advice."""
    with tempfile.TemporaryDirectory() as name:  # not pytest's, which nobody else may enter
        monkeypatch.chdir(name)
        os.chmod(name, 0o777)
        Path("small.toml").write_text(SMALL)
        Path("q.h5").write_bytes(b"a run")
        os.chmod("q.h5", 0)
        failed(capsys, "run", "small.toml", "-o", "q.h5")  # imports what the other user may not read
        user = os.geteuid()
        if user == 0:
            os.seteuid(65534)  # root may read everything
        try:
            assert "cannot read 'q.h5': Permission denied" in failed(capsys, "run", "small.toml", "-o", "q.h5")
        finally:
            os.seteuid(user)


@PIPES
@pytest.mark.parametrize("name", ["pipe.h5", "pipe.png"])
def test_an_output_that_is_no_regular_file_is_refused(folder, capsys, name):
    os.mkfifo(name)
    option = "-o" if name.endswith(".h5") else "--map"
    assert f"cannot write '{name}': Not a regular file" in failed(capsys, "run", "small.toml", option, name)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["module://matplotlib_inline.backend_inline", "nope"])
def test_pictures_do_not_need_the_backend_of_the_shell(made, folder, backend):
    """A terminal of a notebook sets a backend, which other environments do not have."""
    environment = os.environ | {"MPLBACKEND": backend, "PYTHONPATH": HERE}
    done = subprocess.run(
        [sys.executable, "-P", "-c", PROGRAM, "map", str(made), "-o", "map.png", "--quiet"],
        env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert imread("map.png").ndim == 3


def test_a_command_leaves_the_environment_as_it_is(made, monkeypatch, capsys):
    monkeypatch.setenv("MPLBACKEND", "module://mine")
    before = dict(os.environ)
    assert main(["info", str(made)]) == 0
    assert dict(os.environ) == before


@pytest.mark.usefixtures("rough_layout")
def test_a_picture_is_drawn_before_its_file_is_opened(made, folder, monkeypatch):
    """A kill while it is drawn, which takes a second, leaves nothing behind."""
    seen = []
    draw = Figure.savefig

    def watched(figure, *arguments, **options):
        draw(figure, *arguments, **options)
        seen.extend(os.listdir())

    monkeypatch.setattr(Figure, "savefig", watched)
    before = os.listdir()
    assert main(["map", str(made), "-o", "map.png", "--quiet"]) == 0
    assert seen == before and imread("map.png").ndim == 3


@pytest.mark.usefixtures("blank_pictures")
def test_a_table_that_has_no_effect_is_told(folder, capsys):
    text = SMALL + "responses = false\n[responses]\nheight = 0.1\n"
    (folder / "a.toml").write_text(text.replace("ions = 60", "ions = 5"))
    assert main(["run", "a.toml", "--quiet"]) == 0
    assert "[responses]" in capsys.readouterr().err


def test_ranges_are_summarised(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "r.rrng").write_text("[Ranges]\nRange1=27.5 28.5 Si:1\nRange2=57.5 58.5 Ni:1\nRange3=13.8 14.2 Si:1\n")
    assert main(["info", "r.rrng", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["ranges"] == 3 and told["mass_to_charge"] == [13.8, 58.5]
    assert told["species"] == {"Si": ["27.5 to 28.5", "13.8 to 14.2"], "Ni": ["57.5 to 58.5"]}
    assert main(["info", "r.rrng"]) == 0 and "57.5 to 58.5" in capsys.readouterr().out
    assert main(["info", "r.rrng", "--ions", "0,10"]) == 2 and "r.rrng" in capsys.readouterr().err
    (tmp_path / "empty.rrng").write_text("[Ranges]\n")
    assert main(["info", "empty.rrng"]) == 2 and "empty.rrng" in capsys.readouterr().err
