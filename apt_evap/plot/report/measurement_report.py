"""Part of a report: constants of a measurement with errors, and checks by observables that were not used."""

from collections.abc import Sequence
from typing import Any

from apt_evap.plot.report.html_page import collapsed, paragraph, table


def measurement_section(constants: Sequence[Any], checks: Sequence[Any], command: str = "", doubt: str = "") -> str:
    """Folded section of a report with the constants of a measurement and their checks, as HTML."""
    rows = [(constant.name, constant.text, constant.depends) for constant in constants]
    parts = [table(rows, ("", "value", "known only together with"))] if rows else []
    if doubt:
        parts.append(paragraph(f"Constants that depend on the crystal are not given: {doubt}."))
    if checks:
        compared = [
            (
                check.name,
                check.found,
                check.predicted,
                check.meaning,
            )
            for check in checks
        ]
        parts.append(table(compared, ("check, not used above", "found", "expected", "a deviation says")))
    if rows:
        parts.append(paragraph("Errors are standard errors by noise; z is the deviation in standard errors.", "note"))
    if command:
        parts.append(paragraph(f"Reconstruct with: {command}", "note"))
    return collapsed("Constants of this measurement", "\n".join(parts))
