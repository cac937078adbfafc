"""Part of a report: the mass spectrum of the measured ions and their composition, first what is unexplained."""

from apt_evap.plot.report.html_page import Page, collapsed, paragraph, table
from apt_evap.plot.spectra import spectrum as draw_spectrum
from apt_evap.spectra.mass_spectrum import Spectrum


def composition_section(page: Page, spectrum: Spectrum) -> str:
    """Folded section with the composition of a spectrum, its picture and its ions, as HTML for a page."""
    composition = spectrum.composition
    of_ions = str(spectrum).splitlines()[: -len(str(composition).splitlines()) + 1 or None]
    parts = [paragraph(of_ions[0])]
    if composition.refused:
        parts.append(paragraph(f"no composition: {composition.refused}", "doubt"))
    else:
        rows = [(name, f"{value or 0} ± {error}", span) for name, value, error, span in composition.rows()]
        parts.append(table(rows, ("", "at.%", "with other names of the peaks")))
    figure = draw_spectrum(spectrum).figure
    parts.append(page.picture(figure, alt="mass spectrum with named peaks, unexplained ones marked"))
    parts += [paragraph(line, "note") for line in of_ions[1:]]
    return collapsed("Composition", "\n".join(parts))
