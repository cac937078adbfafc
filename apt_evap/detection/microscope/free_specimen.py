"""A specimen in free space: what `RunLens` is for a specimen behind a lens."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats, Integers


class FreeSpecimen:
    """The specimen of a simulation without a lens, whose flights are those of the instrument."""

    lens: Any = None
    """The lens of the instrument: none."""

    def lens_settings(self) -> dict[str, Any]:
        """Settings of the lens: none."""
        return {}

    def figures(self, ions: ArrayLike) -> dict[str, Floats]:
        """Figures of the lens for each ion: none."""
        return {}

    def constants(self, voltages: Floats, flight_length: float) -> dict[str, Any]:
        """Constants of a reconstruction that follow from the lens: none."""
        return {}

    def check_field_factor(self, field_factor: float) -> None:
        """Any field factor is possible."""

    def voltages(self, model: Floats, ions: ArrayLike, field: float) -> Floats:
        """Voltages of the instrument [V], shape (n,): those of the model, as for `RunLens.voltages`."""
        return model

    def seen(
        self,
        directions: Floats,
        times: Floats,
        ions: ArrayLike,
        masses: Floats,
        charges: Integers,
        model: Floats,
        voltages: Floats,
        flight_length: float,
    ) -> tuple[Floats, Floats]:
        """Directions and times of flights in the instrument: the same directions, times at its voltages.

        Parameters and result are those of `RunLens.seen`.
        """
        return directions, times * np.sqrt(model / voltages)
