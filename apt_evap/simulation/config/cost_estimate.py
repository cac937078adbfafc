"""Memory and hours that the run of a point needs, before it starts."""

import math

from apt_evap._common.codec import count, number, settings
from apt_evap._common.memory import copied_memory, needed_memory
from apt_evap.simulation.config.simulation_settings import Config
from apt_evap.specimen.tip import estimated_atoms

# Measured: resident memory of the program before a specimen is built, and after its pictures are drawn, 126 to 140 MB
# for R = 8, 12, 20 and 30 a.
_PROGRAM = 1.4e8  # bytes
_BYTES_PER_ION = 3_050  # measured: peak memory with 14,000 and 2,000 ions (R = 12 a); at the end parts are joined
# Milliseconds per ion of one thread, and their increase per factor e in the number of surface atoms: fits to the table
# of speeds in docs/accuracy_and_speed.rst within 7 %, from R = 20 to 120 a, times 2 for a slower or busy processor.
_REFERENCE = 21_591  # surface atoms
_WITH_RESPONSES = 2 * 1.30, 2 * 0.15
# Of other designs than the usual ones with 140 launches and 102 coefficients: processor times per ion of 30 launches
# are 0.70, 0.69 and 0.66 times as long (R = 20, 40 and 80 a); coefficients are three float32, twice at the end.
_LAUNCHES, _PER_LAUNCH = 140, 1 / 350
_COEFFICIENTS, _BYTES_PER_COEFFICIENT = 102, 24
_ONE_FLIGHT = 2 * 0.32, 2 * 0.10
_LEAST = 0.3  # [ms], of small tips
_START = 2 * 3e-5  # seconds per surface atom, from the same table
_START_OF_PROGRAM = 3.0  # seconds, with the pictures of the maps


@settings
class CostEstimate:
    """Estimated cost of a run.

    Approximate numbers; None if the specimen is not a tip of this package's own shape.
    """

    ions: int = count("Atoms to evaporate.", at_least=1)
    atoms: float | None = number("Atoms in memory.", default=None, at_least=0)
    surface_atoms: float | None = number("Atoms on the surface.", default=None, at_least=0)
    memory: float | None = number("Peak memory, within about 30 %.", default=None, at_least=0, unit="bytes")
    hours: float | None = number(
        "Time of one thread, within a factor of 3; finished points correct it (`status`).",
        default=None,
        at_least=0,
        unit="h",
    )

    def __str__(self) -> str:
        if self.memory is None or self.hours is None:
            return f"{self.ions:,} ions"
        return f"{self.ions:,} ions of {self.atoms:.2g} atoms, {self.memory / 1e9:.2g} GB, {hours_text(self.hours)}"


def hours_text(hours: float) -> str:
    """Text of a time in hours or minutes, str."""
    return f"{hours:.2g} h" if hours >= 1 else f"{60 * hours:.2g} min"


def estimate_cost(config: Config, threads: int) -> CostEstimate:
    """Estimate memory and time of the run of a file of settings."""
    try:
        atoms, surface = estimated_atoms(**config.tip)
    except TypeError:  # a specimen without apex_radius
        return CostEstimate(config.n_ions, None, None, None, None)
    memory = _PROGRAM + needed_memory(atoms, surface) + copied_memory(surface, threads)
    bytes_per_ion, flights, per_flight = _BYTES_PER_ION, max(1, len(config.emissions)), _ONE_FLIGHT
    if config.responses:
        designs = config.response_settings.designs
        launches = sum(len(design.launches) for design in designs)
        coefficients = sum(len(design.exponents) for design in designs)
        bytes_per_ion += _BYTES_PER_COEFFICIENT * (coefficients - _COEFFICIENTS)
        flights, per_flight = 1 + _PER_LAUNCH * (launches - _LAUNCHES), _WITH_RESPONSES
    memory += bytes_per_ion * config.n_ions
    base, slope = (flights * value for value in per_flight)
    per_ion = max(_LEAST, base + slope * math.log(surface / _REFERENCE))
    seconds = _START_OF_PROGRAM + _START * surface + 1e-3 * per_ion * config.n_ions
    return CostEstimate(config.n_ions, atoms, surface, memory, seconds / 3600)
