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
# Designs other than the usual ones with 102 coefficients: coefficients are three float32, twice at the end.
_COEFFICIENTS, _BYTES_PER_COEFFICIENT = 102, 24
# Milliseconds of one thread per ion of a tip with _REFERENCE surface atoms: its event, the flights of its responses,
# and that of an emission; all with their increase per factor e in the number of surface atoms. Of 49 runs of 500 to
# 1,000 ions (nine materials, R = 8 to 100 a, both rules of charges, 30 and 140 launches, one to three emissions, fields
# of view, rates at 50 K) every second one was used for the fit: estimates over processor times are 0.81 to 1.25. Those
# of the other 24 are 0.85 to 1.13, but for 0.69 (R = 100 a at a constant potential) and three of 1.24 to 1.36 (R = 12 a
# with 30 launches, R = 40 a with one flight, half of the ions outside the field of view). AMD EPYC, while other
# programs ran. Flights of responses have become faster since, to 0.65, 0.71 and 0.74 of the time at R = 20, 40 and
# 80 a: their numbers are 0.7 of those of the fit.
_REFERENCE = 21_591  # surface atoms
_EVENT, _RESPONSES, _LAUNCH, _EMISSION, _GROWTH = 0.34, 0.19, 0.0016, 0.033, 0.087
# Seconds per atom in memory until the first ion: 1.6 to 3.4 us in the same 25 runs, 0.95 with silicon; 1.3 to 3.0 us in
# the other 24
_START = 2.15e-6
_START_OF_PROGRAM = 3.0  # seconds, with the pictures of the maps: 3.2 s with 200 ions of a tip of R = 6 a


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
        "Time of one thread, on a processor like the measured one within a third; finished points correct it "
        "(`status`).",
        default=None,
        at_least=0,
        unit="h",
    )

    def __str__(self) -> str:
        if self.memory is None or self.hours is None:
            return f"{self.ions:,} ions"
        return f"{self.ions:,} ions of {self.atoms:.2g} atoms, {self.memory / 1e9:.2g} GB, {hours_text(self.hours)}"


def hours_text(hours: float) -> str:
    """Text of a time in hours, minutes or seconds, str."""
    if hours >= 1:
        return f"{hours:.2g} h"
    return f"{60 * hours:.2g} min" if 60 * hours >= 1 else f"{3600 * hours:.0f} s"


def estimate_cost(config: Config, threads: int) -> CostEstimate:
    """Estimate memory and time of the run of a file of settings."""
    try:
        atoms, surface = estimated_atoms(**config.tip)
    except TypeError:  # a specimen without apex_radius
        return CostEstimate(config.n_ions, None, None, None, None)
    memory = _PROGRAM + needed_memory(atoms, surface) + copied_memory(surface, threads)
    bytes_per_ion, per_ion = _BYTES_PER_ION, _EVENT + _EMISSION * len(config.emissions)
    if config.responses:
        designs = config.response_settings.designs
        launches = sum(len(design.launches) for design in designs)
        coefficients = sum(len(design.exponents) for design in designs)
        bytes_per_ion += _BYTES_PER_COEFFICIENT * (coefficients - _COEFFICIENTS)
        per_ion += _RESPONSES + _LAUNCH * launches
    memory += bytes_per_ion * config.n_ions
    per_ion *= max(1 + _GROWTH * math.log(surface / _REFERENCE), 0.5)
    seconds = _START_OF_PROGRAM + _START * atoms + 1e-3 * per_ion * config.n_ions
    return CostEstimate(config.n_ions, atoms, surface, memory, seconds / 3600)
