"""Text files: tables of numbers, compressed and of other encodings; formats that are not read."""

import bz2
import gzip
import lzma

import numpy as np
import pytest
from ion_files import ENV, RNG, epos, ions_of, tapsim_table

from apt_evap._common.files import FileError
from apt_evap.io._texts import read_numbers
from apt_evap.io.formats import read, read_ranges


def test_tables_of_numbers(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("# x y\n1 2\n\n3,4e0\n 5\t-6 \n")
    columns = read_numbers(path, "a table", ("x", "y"))
    assert {name: values.tolist() for name, values in columns.items()} == {"x": [1, 3, 5], "y": [2, 4, -6]}
    for text, message in (
        ("1 2\n1 two\n", r"line 2: expected 2 numbers \(x, y\) as in a table, got '1 two'"),
        ("1 2 3\n", "line 1: expected 2 numbers"),
        ("1 nan\n", "line 1: expected 2 numbers"),
        ("1 2_0\n", "line 1: expected 2 numbers"),
        ("1 \u0662\n", "line 1: expected 2 numbers"),
        ("# nothing\n", "has no numbers, expected a table"),
        ("", r"is empty \(0 bytes\), expected a table"),
    ):
        path.write_text(text)
        with pytest.raises(FileError, match=rf"a\.txt'.* {message}"):
            read_numbers(path, "a table", ("x", "y"))


@pytest.mark.filterwarnings("ignore:.*are they in mm:apt_evap.warnings.DataWarning")
@pytest.mark.parametrize(("suffix", "compress"), [(".gz", gzip), (".bz2", bz2), (".xz", lzma)])
def test_compressed_ranges_and_tables(tmp_path, suffix, compress):
    for name, text in (("a.rng", RNG), ("a.env", ENV), ("a.rrng", "[Ranges]\nRange1=1 2 Ni:1\n")):
        for encoding in ("utf-8", "utf-16"):
            (tmp_path / name).write_bytes(text.encode(encoding))
            (tmp_path / f"{name}{suffix}").write_bytes(compress.compress(text.encode(encoding)))
            assert read_ranges(tmp_path / f"{name}{suffix}").names == read_ranges(tmp_path / name).names
    for binary in (False, True):
        data = tapsim_table(40, binary)[0]
        (tmp_path / "a.tapsim").write_bytes(data)
        (tmp_path / f"a{suffix}").write_bytes(compress.compress(data))
        np.testing.assert_array_equal(read(tmp_path / f"a{suffix}").x, read(tmp_path / "a.tapsim").x)
    (tmp_path / f"a.epos{suffix}").write_bytes(compress.compress(epos(ions_of([1, 2]))))
    with pytest.raises(FileError, match=rf"a\.epos{suffix}' is compressed: decompress it to read it as 'a\.epos'"):
        read(tmp_path / f"a.epos{suffix}")


@pytest.mark.parametrize(
    ("name", "advice"), [("a.ops", "convert it to .epos"), ("a.rhit", "from AP Suite"), ("a.rrng", "--ranges read it")]
)
def test_other_files_of_the_field_are_refused_with_advice(tmp_path, name, advice):
    (tmp_path / name).write_bytes(bytes(100))
    with pytest.raises(FileError, match=rf"{name}' cannot be read as ions; .*{advice}"):
        read(tmp_path / name)
