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
        rows = [
            (element, f"{value:.2f} ± {composition.error[element]:.2f}", _span(composition, element))
            for element, value in composition.at_percent.items()
        ]
        rows += [
            (f"perhaps {element}", f"0 ± {composition.error[element]:.2f}", _span(composition, element))
            for element in composition.perhaps
        ]
        parts.append(table(rows, ("", "at.%", "with other names of the peaks")))
    figure = draw_spectrum(spectrum).figure
    parts.append(page.picture(figure, alt="mass spectrum with named peaks, unexplained ones marked"))
    parts += [paragraph(line, "note") for line in of_ions[1:]]
    return collapsed("Composition", "\n".join(parts))


def _span(composition, element):
    low, high = composition.span[element]
    return f"{low:.2f} to {high:.2f}" if high - low > max(composition.error[element], 0.005) else ""
