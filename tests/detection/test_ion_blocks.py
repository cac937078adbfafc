"""Answers of a file that is read block by block are those of the file that is read whole, bit by bit."""

import json
import platform
import subprocess
import sys
import tracemalloc
from contextlib import contextmanager

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli._spectrum_of_file import _alone
from apt_evap.cli.main import main
from apt_evap.cli.parser import make_parser
from apt_evap.detection import ion_blocks
from apt_evap.detection.hits import Hits
from apt_evap.io import formats
from apt_evap.io.measured_file import MeasuredFile
from apt_evap.plot import spectra
from apt_evap.reconstruction import cap_geometry
from apt_evap.reconstruction.reconstruct import reconstruct

pytestmark = pytest.mark.filterwarnings("ignore::apt_evap.warnings.AptWarning")
N = 8_000
SIZES = (101, 977, 5_000, 1 << 20)  # blocks that part many pulses, nine blocks, two, one


def rows_of(n=N, seed=3):
    """Rows of an .epos: ions on a disc with peaks of mass, pairs in a tenth of the pulses."""
    random = np.random.default_rng(seed)
    radius, angle = 30 * np.sqrt(random.random(n)), 2 * np.pi * random.random(n)
    mass = random.choice([26.98, 13.49, 27.98, 1.008], n, p=[0.6, 0.2, 0.15, 0.05])
    mass = np.where(random.random(n) < 0.1, random.uniform(0.6, 90, n), mass * random.normal(1, 4e-4, n))
    voltage = np.linspace(3000, 5000, n)
    rows = np.zeros((n, 11), ">u4")
    values = rows.view(">f4")
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    columns = (0.8 * x, 0.8 * y, np.linspace(0, 50, n), mass, 90 * np.sqrt(mass / 4), voltage, voltage / 5, x, y)
    for at, column in enumerate(columns):
        values[:, at] = column
    rows[:, 9], rows[:, 10] = random.geometric(0.02, n), 1
    first = np.flatnonzero(random.random(n - 1) < 0.1)
    first = first[np.diff(first, prepend=-2) > 1]
    rows[first, 10], rows[first + 1, 10], rows[first + 1, 9] = 2, 0, 0
    return rows


def with_change(change):
    """Rows with a change of their numbers, and of those as float32."""
    rows = rows_of()
    change(rows, rows.view(">f4"))
    return rows.tobytes()


def _strays(rows, values):
    values[5::700, 7], values[5::700, 8] = -190.0, -190.0
    values[9, 7] = 4e29


def _not_finite(rows, values):
    values[3::500, 7], values[4::900, 8], values[8::1000, 3], values[11, 0] = np.nan, np.inf, np.nan, np.inf


def _quantised(rows, values):
    values[:, 7:9] = np.rint(values[:, 7:9] / 0.06) * 0.06


def _negative(rows, values):
    values[7::300, 3], values[:5, 5] = -3.0, -20.0


def _of_every_ion(rows, values):
    rows[1:, 10] = np.where(rows[1:, 10] == 0, 2, rows[1:, 10])


def _none(rows, values):
    pass


FILES = {
    "plain": with_change(_none),
    "strays": with_change(_strays),
    "not finite": with_change(_not_finite),
    "strays and not finite": with_change(lambda rows, values: (_strays(rows, values), _not_finite(rows, values))),
    "quantised": with_change(_quantised),
    "negative": with_change(_negative),
    "kilovolts": with_change(lambda rows, values: values[:, 5:7].__itruediv__(1000)),
    "centimetres": with_change(lambda rows, values: values[:, 7:9].__itruediv__(10)),
    "too small": with_change(lambda rows, values: values[:, 7:9].__itruediv__(1000)),
    "too large": with_change(lambda rows, values: values[:, 7:9].__imul__(30)),
    "columns of zeros": with_change(lambda rows, values: rows.__setitem__((slice(None), [0, 1, 2, 4, 6, 9]), 0)),
    "pulses of every ion": with_change(_of_every_ion),
    "pulses that are not consistent": with_change(lambda rows, values: rows.__setitem__((slice(100, 103), 10), 9)),
    "truncated": with_change(_none)[:-60],
}


def files(*telling):
    """Names of all files: those that are not telling are slow."""
    return [pytest.param(name, marks=[pytest.mark.slow] * (name not in telling)) for name in FILES]


OPTIONS = {
    "truncated": ["--partial"],
    "centimetres": ["--unit", "cm"],
    "kilovolts": ["--voltage-unit", "kV"],
}


@pytest.fixture
def blocks_of(monkeypatch):
    """Read all files in blocks of this number of ions, or whole for None."""

    def chosen(rows):
        monkeypatch.setattr(formats, "LARGE", 1 << 60 if rows is None else 0)
        for module in (formats, ion_blocks):
            monkeypatch.setattr(module, "ROWS", rows or 1)

    return chosen


def answers(capsys, *words):
    """Exit code, output and errors of a command."""
    code = main([*words])
    out = capsys.readouterr()
    return code, out.out, out.err


@pytest.mark.parametrize("name", files("strays and not finite", "kilovolts", "pulses of every ion", "truncated"))
def test_blocks_give_the_answers_of_the_whole_file(tmp_path, monkeypatch, capsys, blocks_of, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.epos").write_bytes(FILES[name])
    words = ["a.epos", *OPTIONS.get(name, ())]
    whole = []
    for rows in (None, *SIZES):
        blocks_of(rows)
        given = [
            answers(capsys, "info", *words, "--json"),
            answers(capsys, "export", *words, "-o", "b.epos", "--force"),
        ]
        given.append((tmp_path / "b.epos").read_bytes())
        given.append(answers(capsys, "export", *words, "-o", "b.pos", "--force"))
        given.append((tmp_path / "b.pos").read_bytes() if (tmp_path / "b.pos").exists() else b"")
        if rows is None:
            whole = given
            assert json.loads(given[0][1])["ions"] == N - (2 if name == "truncated" else 0)
            text = answers(capsys, "info", *words)
        assert given == whole, rows
    blocks_of(SIZES[0])
    assert answers(capsys, "info", *words) == text


@contextmanager
def map_of(words):
    """Map that a command draws."""
    from apt_evap.cli._maps_of_file import maps_of_file

    (drawn,), titles, title, crystal, _ = maps_of_file(make_parser().parse_args(["map", *words]))
    yield drawn, (titles, title, crystal)


@pytest.mark.parametrize("bins", [[], ["--bins", "50"]])
@pytest.mark.parametrize("name", files("strays and not finite", "quantised", "centimetres", "truncated"))
def test_blocks_give_the_map_of_the_whole_file(tmp_path, monkeypatch, blocks_of, name, bins):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.epos").write_bytes(FILES[name])
    words = ["a.epos", *OPTIONS.get(name, ()), *bins]
    expected = None
    for rows in (None, *SIZES):
        blocks_of(rows)
        with map_of(words) as (drawn, titles):
            given = {
                key: value.tobytes() if isinstance(value, np.ndarray) else value for key, value in vars(drawn).items()
            }
            given["titles"] = titles
        expected = expected or given
        assert given == expected, rows
    assert expected["detected"] > 0


@pytest.mark.usefixtures("hashed_pictures", "spectra_once")
@pytest.mark.parametrize("name", [*files("plain", "negative")[:3], "negative"])
def test_blocks_give_the_spectrum_of_the_whole_file(tmp_path, monkeypatch, capsys, blocks_of, name):
    """The picture, too; what is said of pulses and voltages, which a spectrum does not need, may be missing."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.epos").write_bytes(FILES[name])
    words = ["a.epos"] if name == "plain" else ["a.epos", "--element", "Al,H"]  # all elements are tried once
    whole = None
    for rows in (None, 977, *[1 << 20] * (name == "plain")):
        blocks_of(rows)
        given = [answers(capsys, "spectrum", *words, "-o", "s.png", "--json")[:2], (tmp_path / "s.png").read_bytes()]
        given.append(answers(capsys, "composition", "a.epos", "--element", "Al,H", "--json")[:2])
        whole = whole or given
        assert given == whole, rows
    assert json.loads(whole[0][1])["ions"]
    assert json.loads(whole[2][1])["composition"]


@pytest.mark.parametrize("rows", [1, 7, 101, 1000])
def test_the_sample_of_blocks_is_that_of_all_ions(monkeypatch, rows):
    monkeypatch.setattr(ion_blocks, "SAMPLE", 300)
    x, y = np.random.default_rng(1).random((2, 1000))
    field = ion_blocks.Field(len(x))
    for start in range(0, len(x), rows):
        field.add(x[start : start + rows], y[start : start + rows])
    assert all(map(np.array_equal, field.sample, (x[::3], y[::3])))


@pytest.mark.slow
@pytest.mark.usefixtures("hashed_pictures", "spectra_once")
def test_losses_of_blocks_are_those_of_the_whole_file(tmp_path, monkeypatch, capsys, blocks_of):
    """Isotopes that are lost in pulses of several ions, which a note beside every composition says."""
    monkeypatch.chdir(tmp_path)
    rows = np.concatenate([rows_of(seed=seed) for seed in range(5)]).astype(">u4")
    random = np.random.default_rng(2)
    mass = random.choice([62.93, 64.93], len(rows), p=[0.69, 0.31]) * random.normal(1, 3e-4, len(rows))
    second = rows[:, 10] == 0
    mass[second] = np.where(random.random(second.sum()) < 0.8, 64.93, 62.93) * random.normal(1, 3e-4, second.sum())
    mass[::4] = 26.98 * random.normal(1, 3e-4, len(mass[::4]))
    rows.view(">f4")[:, 3] = mass
    (tmp_path / "a.epos").write_bytes(rows.tobytes())
    given = []
    for size in (None, *SIZES[1:]):
        blocks_of(size)
        for command in ("composition", "spectrum"):
            given.append(answers(capsys, command, "a.epos", "--element", "Cu,Al"))
        (tmp_path / "a_spectrum.png").unlink()  # otherwise it is replaced
    assert "dead time" in given[0][2]
    assert all(one[2] == given[0][2] for one in given)
    assert all(one == given[at % 2] for at, one in enumerate(given))


def test_a_pos_is_read_in_blocks(tmp_path, monkeypatch, capsys, blocks_of):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.pos").write_bytes(np.ascontiguousarray(rows_of()[:, :4]).tobytes())
    given = []
    for rows in (None, *SIZES):
        blocks_of(rows)
        given.append((answers(capsys, "info", "a.pos"), answers(capsys, "export", "a.pos", "-o", "b.epos", "--force")))
        given[-1] += ((tmp_path / "b.epos").read_bytes(),)
    assert all(one == given[0] for one in given)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_file(tmp_path, monkeypatch, blocks_of):
    monkeypatch.chdir(tmp_path)
    blocks_of(1 << 12)
    peaks = {}
    for copies in (12, 50):
        (tmp_path / "a.epos").write_bytes(FILES["plain"] * copies)
        for command, more in (("info", []), ("export", ["-o", "b.epos", "--force"]), ("map", ["-o", "a.png"])):
            words = [command, "a.epos", *more]
            if command == "map":

                def work(words=words):
                    with map_of(words[1:2]):
                        pass
            else:

                def work(words=words):
                    assert main([*words]) == 0

            work()
            tracemalloc.start()
            work()
            peaks[command, copies] = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
    for command in ("info", "export", "map"):
        # 304,000 ions more, which would be 13 MB
        assert peaks[command, 50] - peaks[command, 12] < 1.5e6, command


@pytest.mark.parametrize("name", ["plain", "strays"])
def test_which_ions_are_alone_in_their_pulse_is_known_in_blocks(tmp_path, blocks_of, name):
    blocks_of(700)
    (tmp_path / "a.epos").write_bytes(FILES[name])
    blocks = formats.ion_blocks(tmp_path / "a.epos", ("mass_to_charge",), further=("x", "y", "pulse_id"))
    gathered = blocks.gathered("mass_to_charge", alone=("pulse_id", _alone)).extra["alone"]
    _, pulse, ions = np.unique(ae.read(tmp_path / "a.epos").pulse_id, return_inverse=True, return_counts=True)
    np.testing.assert_array_equal(gathered, ions[pulse] == 1)
    assert 0.5 < gathered.mean() < 0.95


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries keep freed memory by other rules")
def test_blocks_use_the_memory_of_the_blocks_before(tmp_path):
    """New pages for the blocks of a million ions: 20,500 if freed memory is returned to the system, else 131."""
    (tmp_path / "a.epos").write_bytes(rows_of(1_000_000).tobytes())
    lines = (
        "import resource",
        "from apt_evap.detection.detector_map import DetectorMap",
        "from apt_evap.io import formats",
        "formats.LARGE = 0",
        "def pages(): return resource.getrusage(resource.RUSAGE_SELF).ru_minflt",
        "DetectorMap.from_blocks(formats.ion_blocks('a.epos', ('x', 'y')), bins=256)  # imports",
        "before = pages()",
        "DetectorMap.from_blocks(formats.ion_blocks('a.epos', ('x', 'y')), bins=256)",
        "print(pages() - before)",
    )
    run = subprocess.run([sys.executable, "-c", "\n".join(lines)], cwd=tmp_path, capture_output=True, text=True)
    assert int(run.stdout) < 2_000, run.stderr


def test_only_plain_answers_are_made_of_blocks(tmp_path, blocks_of):
    """Selections, other formats and small files are read whole."""
    path = tmp_path / "a.epos"
    path.write_bytes(FILES["plain"])
    blocks_of(1000)
    assert len(MeasuredFile(str(path)).blocks(("x", "y"))) == N
    for options in ({"mass": (1, 20)}, {"ions": (0, 10)}, {"distance": 90.0}, {"peaks": "Al"}, {"circle": (9, (0, 0))}):
        assert MeasuredFile(str(path), **options).blocks() is None
    blocks_of(1)  # pulses are larger
    assert MeasuredFile(str(path)).blocks() is None
    blocks_of(None)
    assert MeasuredFile(str(path)).blocks() is None


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_counts_of_a_picture_are_those_of_numpy(dtype):
    """Also of m/n at edges of bins, and far outside."""
    random = np.random.default_rng(1)
    for width in (0.02, 0.05, 0.1):
        edges = width * np.arange(np.floor(3.3 / width), np.ceil(61.7 / width) + 1)
        mass = np.concatenate([random.uniform(0, 90, 300_000), edges, np.nextafter(edges, 0), [1e30, -5.0]]).astype(
            dtype
        )
        assert np.array_equal(spectra._counts_between(mass, edges), np.histogram(mass.astype(float), edges)[0])
    for values in (mass, mass[np.abs(mass) < 1e3]):
        expected = np.unique(np.floor(values.astype(float)), return_counts=True)
        assert all(np.array_equal(*pair) for pair in zip(spectra._in_daltons(values), expected, strict=True))


@pytest.mark.usefixtures("hashed_pictures")
@pytest.mark.parametrize("name", [*files("plain", "negative")[:3], "negative"])
def test_blocks_give_the_reconstruction_of_the_whole_file(tmp_path, monkeypatch, capsys, blocks_of, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.epos").write_bytes(FILES[name])
    constants = ["--element", "Al", "--distance", "90", "--efficiency", "0.5"]
    if name == "negative":  # voltages
        constants += ["--radius", "30"]
    whole = None
    for rows in (None, 977, 5_000):
        blocks_of(rows)
        code, told, notes = answers(capsys, "reconstruct", "a.epos", *constants, "-o", "r.pos", "--force")
        given = [(code, told), [line for line in notes.splitlines() if "are not used" in line]]
        given += [(tmp_path / file).read_bytes() for file in ("r.pos", "r.png")]
        (tmp_path / "r.png").unlink()  # otherwise it is replaced
        whole = whole or given
        assert given == whole, rows
    assert whole[0][0] == 0
    assert " nm, are not used" in whole[1][0]


def test_positions_in_parts_are_those_of_all_ions(monkeypatch):
    """A reconstruction computes positions of some ions at a time: no bit depends on it."""
    random = np.random.default_rng(2)
    x, y = random.uniform(-20, 20, (2, 5000)).astype(np.float32)
    hits = Hits(x=x, y=y, voltage=np.linspace(3e3, 5e3, 5000))
    found = {}
    for part in (1 << 20, 1 << 15, 777, 3):
        monkeypatch.setattr(cap_geometry, "_PART", part)
        for projection in ("equidistant", "compressed", "bas"):
            kind = {"protocol": "bas"} if projection == "bas" else {"protocol": "cap", "projection": projection}
            result = reconstruct(hits, element="Al", distance=90.0, **kind)
            near, rim = result.core
            bits = (result.positions.tobytes(), result.depths.tobytes(), near.tobytes(), rim)
            found.setdefault(projection, set()).add(bits)
    assert [len(bits) for bits in found.values()] == [1, 1, 1]
