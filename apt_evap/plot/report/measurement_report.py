"""Part of a report: constants of a measurement with errors, and checks by observables that were not used."""

from collections.abc import Sequence
from typing import Any

from apt_evap.plot.report.html_page import heading, paragraph, table


def measurement_section(constants: Sequence[Any], checks: Sequence[Any], command: str = "", picture: str = "") -> str:
    """Section of a report with the constants of a measurement and their checks, as HTML.

    Parameters
    ----------
    constants, checks : sequence of Constant, and of Observed
        Those of a `Measurement`.
    command : str
        Command line that reconstructs with these constants.
    picture : str
        Picture of the map with its poles, as HTML.

    Returns
    -------
    str
    """
    rows = [(constant.name, constant.text, constant.depends) for constant in constants]
    parts = [heading("Constants of this measurement"), picture, table(rows, ("", "value", "known only together with"))]
    if checks:
        compared = [
            (
                check.name,
                f"{check.value:.4g}",
                f"{check.expected:.4g} ± {check.error:.2g}, z = {check.z:+.1f}",
                check.meaning,
            )
            for check in checks
        ]
        parts.append(table(compared, ("check, not used above", "found", "expected", "a deviation says")))
    parts.append(paragraph("Errors are standard errors by noise alone; z is the deviation in standard errors.", "note"))
    if command:
        parts.append(paragraph(f"Reconstruct with: {command}", "note"))
    return "\n".join(parts)
