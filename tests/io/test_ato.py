"""The .ato format of Rouen."""

import numpy as np
import pytest

from apt_evap._common.files import FileError, TruncatedFile
from apt_evap.io.formats import read


def ato(n=40_000, order="<", version=3):
    rows = np.random.default_rng(6).uniform(1, 100, (n, 14)).astype(f"{order}f4")
    return np.array([0, version], f"{order}u4").tobytes() + rows.tobytes(), rows


@pytest.mark.parametrize("order", "<>")
def test_positions_and_masses(tmp_path, order):
    content, rows = ato(order=order)
    (tmp_path / "a.ato").write_bytes(content)
    hits = read(tmp_path / "a.ato")
    np.testing.assert_array_equal(hits.mass_to_charge, rows[:, 3])
    np.testing.assert_allclose(hits.positions, rows[:, :3] / 10, rtol=2e-7)  # Angstrom
    assert hits.columns == ("mass_to_charge", "positions")
    assert read(tmp_path / "a.ato", columns="positions").columns == ("positions",)
    (tmp_path / "a.ato").write_bytes(content[:-3])
    with pytest.raises(TruncatedFile, match=r"a\.ato' ends in the middle of an ion: 39999 complete ions .* 53 further"):
        read(tmp_path / "a.ato")
    np.testing.assert_array_equal(read(tmp_path / "a.ato", partial=True).mass_to_charge, rows[:-1, 3])


@pytest.mark.parametrize(("content", "got"), [(ato(2, version=5)[0], "version 5"), (b"", "none"), (bytes(64), "none")])
def test_other_versions_are_refused(tmp_path, content, got):
    (tmp_path / "a.ato").write_bytes(content)
    with pytest.raises(FileError, match=rf"a\.ato' must have the version 3 of \.ato in its header, got {got}"):
        read(tmp_path / "a.ato")
    (tmp_path / "a.ato").write_bytes(ato(1)[0][:20])
    with pytest.raises(TruncatedFile, match="0 complete ions"):
        read(tmp_path / "a.ato", partial=True)
