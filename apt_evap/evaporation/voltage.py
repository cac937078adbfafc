"""The applied voltage."""

from typing import Any

from apt_evap._common.validation import check_number


def check_voltage(voltage: Any) -> float:
    """Return the applied voltage [V], > 0 and <= 1 MV; ValueError otherwise."""
    return check_number(voltage, "voltage", above=0, at_most=1e6, unit="V")
