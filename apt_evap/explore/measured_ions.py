"""Measured ions of a file, and the part of them that the maps show, by their masses and their place in the sequence."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from apt_evap.detection.hits import Hits
from apt_evap.spectra.mass_spectrum import Spectrum, spectrum

NUMBERED = "\0"
"""Place in the text that reads a file where the rows are those of the file."""


@dataclass(frozen=True)
class IonSelection:
    """Ions that the maps show.

    Parameters
    ----------
    element : str, optional
        Only the ions in the peaks of this element.
    mass : tuple of float, optional
        Only the ions of these m/n, low <= m/n < high [Da]; a bound of None is open. Not with `element`.
    ions : tuple of int, optional
        First ion, and the one after the last, in the order of the file; a bound of None is open.
    """

    element: str | None = None
    mass: tuple[float | None, float | None] | None = None
    ions: tuple[float | None, float | None] | None = None

    def __post_init__(self):
        if self.ions is not None:  # whole numbers, also from the text of a command
            bounds = (bound if bound is None or bound != int(bound) else int(bound) for bound in self.ions)
            object.__setattr__(self, "ions", tuple(bounds))


class MeasuredIons:
    """Measured ions and their selection.

    Parameters
    ----------
    hits : Hits
        All ions of the file.
    distance : float, optional
        Nominal flight length [mm], for ions with times of flight and no masses.
    time_zero : float
        Time that is subtracted from the times of flight [ns].
    selection : IonSelection
        What is shown at the start.

    Raises
    ------
    ValueError
        If the selection has no ions.
    """

    def __init__(
        self, hits: Hits, distance: float | None = None, time_zero: float = 0.0, selection: IonSelection | None = None
    ) -> None:
        self.all, self.distance, self.time_zero = hits, distance, time_zero
        self.selection = IonSelection()
        self.hits = hits
        """The ions that are shown."""
        if selection is not None:
            self.select(selection)

    @property
    def number(self) -> int:
        """Number of the ions of the file, as far as it is known."""
        ion = self.all.ion
        return len(self.all) if ion is None or not len(ion) else int(ion.max()) + 1

    @property
    def lacks_distance(self) -> bool:
        """Whether masses only need a flight length."""
        return self.all.mass_to_charge is None and self.distance is None and not self.lacks_times

    @property
    def has_masses(self) -> bool:
        """Whether masses are known, or can be computed."""
        return self.all.mass_to_charge is not None or self._computes

    @property
    def lacks_times(self) -> bool:
        """Whether there are no times of flight, or no voltages."""
        return self.all.time_of_flight is None or self.all.voltage is None

    def spectrum(self, elements: Sequence[str] | None = None) -> Spectrum:
        """Spectrum of all ions; as for `apt_evap.spectrum`."""
        return spectrum(self.all, elements, **self._flight())

    def select(self, selection: IonSelection) -> Hits:
        """Show a part of the ions, and return it.

        Raises
        ------
        ValueError
            If masses are not known, or no ions, or too few of the element, remain; the selection is then as before.
        """
        hits = self.all if selection.ions is None else self.all.window(ion=selection.ions)
        if selection.element is not None:
            hits = spectrum(hits, selection.element, **self._flight()).select(selection.element)
        elif selection.mass is not None:
            if self._computes:
                hits = hits.with_masses(self.distance, self.time_zero)  # type: ignore[arg-type]
            hits = hits.window(mass_to_charge=selection.mass)
        if not len(hits):
            raise ValueError(f"no ion of {self.all.source!r} is selected")
        self.selection, self.hits = selection, hits
        return hits

    @property
    def arguments(self) -> list[str]:
        """Arguments of ``apt-evap`` that select the same ions."""
        arguments = []
        if self._computes:
            arguments += [f"--distance={self.distance!r}"] + ([f"--t0={self.time_zero!r}"] if self.time_zero else [])
        for name in ("ions", "mass"):
            if (bounds := getattr(self.selection, name)) is not None:
                arguments.append(f"--{name}={','.join('' if bound is None else repr(bound) for bound in bounds)}")
        if self.selection.element is not None:
            arguments.append(f"--element={self.selection.element}")
        return arguments

    def code(self, code: str) -> str:
        """Python expression of the same ions, from the one that reads the file.

        The ions of the sequence are selected at `NUMBERED`, before other selections change their numbers.
        """
        window = "" if self.selection.ions is None else f".window(ion={self.selection.ions!r})"
        code = code.replace(NUMBERED, window) if NUMBERED in code else code + window
        if self.selection.element is not None:
            words = [
                code,
                repr(self.selection.element),
                *(f"{name}={value!r}" for name, value in self._flight().items()),
            ]
            return f"ae.spectrum({', '.join(words)}).select({self.selection.element!r})"
        if self.selection.mass is not None:
            if self._computes:
                code += f".with_masses({self.distance!r}, {self.time_zero!r})"
            code += f".window(mass_to_charge={self.selection.mass!r})"
        return code

    @property
    def _computes(self):
        """Whether masses follow from the times of flight."""
        return self.all.mass_to_charge is None and self.distance is not None and not self.lacks_times

    def _flight(self) -> dict[str, Any]:
        return {"distance": self.distance, "time_zero": self.time_zero} if self._computes else {}


def main_element(named: Spectrum) -> str | None:
    """Element of more than half of the named ions of a spectrum, None without one."""
    ions: dict[str, float] = {}
    for ion in named.ions:
        ions[ion.formula] = ions.get(ion.formula, 0) + ion.ions
    if not ions:
        return None
    most = max(ions, key=lambda formula: ions[formula])
    return most if ions[most] > 0.5 * math.fsum(ions.values()) else None
