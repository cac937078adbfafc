"""Numbers as text, with as many digits as their error allows."""

import math


def decimals_for(error: float) -> int:
    """Decimal places for a number with an error; negative ones are tens and hundreds."""
    power = math.floor(math.log10(error))
    return (1 if error < 3.55 * 10.0**power else 0) - power


def rounded_text(value: float, error: float, digits: int = 3) -> str:
    """Number with the digits that an error allows, or with some digits if the error is not known."""
    if not (math.isfinite(error) and error > 0 and math.isfinite(value)):
        if not 1 <= abs(value) < 1e6:
            return f"{value:.{digits}g}"
        places = digits - 1 - math.floor(math.log10(abs(value)))
        return f"{round(value, places):.{max(places, 0)}f}"
    places = decimals_for(error)
    return f"{round(value, places):z.{max(places, 0)}f}"
