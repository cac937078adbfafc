"""The applied voltage."""

from typing import Any

from apt_evap._common.validation import check_number


def check_voltage(voltage: Any) -> float:
    """Return the applied voltage [V], above 0 and up to 1 MV, or say what is wrong (ValueError)."""
    return check_number(voltage, "voltage", above=0, at_most=1e6, unit="V")
