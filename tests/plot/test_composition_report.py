"""Composition in the report of a measurement: of all its ions, and what is unexplained comes first."""

import numpy as np
import pytest
from made_spectra import made

import apt_evap as ae
from apt_evap.io.measured_file import MeasuredFile
from apt_evap.plot.report.composition_report import composition_section
from apt_evap.plot.report.html_page import Page
from apt_evap.workflows.measured_source import MeasuredSource, source_of

pytestmark = pytest.mark.usefixtures("spectra_once")


@pytest.fixture
def hits():
    """Nickel and aluminium, and a peak that no ion has."""
    alloy = made({("Ni", 2): 9, ("Al", 1): 1}, 20_000).mass_to_charge
    lone = 91.4 * np.random.default_rng(1).normal(1, 4e-4, 400)
    return ae.Hits(mass_to_charge=np.append(alloy, lone))


def test_the_section_says_first_what_is_unexplained(hits):
    page, spectrum = Page("a"), ae.spectrum(hits)
    text = composition_section(page, spectrum)
    at = [text.index(part) for part in ("unexplained: ", "<table>", "<th>Ni</th>", "<th>Al</th>", "<img ", "Ni²⁺")]
    assert at == sorted(at) and "at 91.399 Da" in text[: at[1]]
    assert f"{spectrum.composition['Ni']:.2f} ± {spectrum.composition.error['Ni']:.2f}" in text
    few = composition_section(page, ae.spectrum(hits[:150]))
    assert "no composition: " in few and "<table>" not in few


def test_the_spectrum_of_a_report_has_all_ions_of_the_file(hits, tmp_path):
    path = tmp_path / "a.pos"
    ae.write(path, ae.Hits(mass_to_charge=hits.mass_to_charge, positions=np.zeros((len(hits), 3))))
    every = ae.spectrum(ae.read(path)).composition.at_percent
    selected = MeasuredFile(str(path), mass=(20.0, 40.0), peaks="Ni")
    for source in (source_of(path), MeasuredSource(lambda note: hits[:9], path, selected)):
        assert source.spectrum(hits[:9]).composition.at_percent == every
    assert source_of(hits).spectrum(hits).composition.at_percent == ae.spectrum(hits).composition.at_percent
    assert MeasuredFile(str(path), ions=(0, 5000)).spectrum().hits.mass_to_charge.shape == (5000,)
    places = ae.Hits(x=[0.0], y=[0.0])
    assert source_of(places).spectrum(places) is None
    ranges = ae.spectrum(hits).ranges()
    ae.io.write_rrng(tmp_path / "a.rrng", ranges)
    ranged = MeasuredFile(str(path), ranges=str(tmp_path / "a.rrng"), species="Ni").spectrum()
    assert ranged.ranged and {ion.formula for ion in ranged.ions} == {"Ni", "Al"}
