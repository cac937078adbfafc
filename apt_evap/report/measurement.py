"""Part of a report: constants of a measurement with errors, and checks by observables that were not used."""

from collections.abc import Sequence
from typing import Any

from apt_evap.report.page import heading, paragraph, table


def measurement_section(constants: Sequence[Any], checks: Sequence[Any], command: str = "") -> str:
    """Section of a report with the constants of a measurement and their checks, as HTML.

    Parameters
    ----------
    constants, checks : sequence of Constant, and of Observed
        Those of a `twin.Measurement`.
    command : str
        Command line that reconstructs with these constants.

    Returns
    -------
    str
    """
    rows = [(each.name, each.text, each.depends) for each in constants]
    parts = [heading("Constants of this measurement"), table(rows, ("", "value", "known only together with"))]
    if checks:
        compared = [
            (each.name, f"{each.found:.4g}", f"{each.expected:.4g} ± {each.error:.2g}", f"{each.z:+.1f}", each.meaning)
            for each in checks
        ]
        parts.append(table(compared, ("check, not used above", "found", "expected", "z", "a deviation says")))
    parts.append(paragraph("Errors are standard errors by noise alone; z is the deviation in standard errors.", "note"))
    if command:
        parts.append(paragraph(f"Reconstruct with: {command}", "note"))
    return "\n".join(parts)
