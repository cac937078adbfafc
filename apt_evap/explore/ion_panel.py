"""Panel of the ions: which part of the sequence of evaporation the maps show."""

from collections.abc import Callable

from bokeh.models import RangeSlider

from apt_evap.explore.explorer import Explorer
from apt_evap.explore.widgets import LEFT, request_maps_of


class IonPanel:
    """Slider of the first and the last ion."""

    def __init__(self, explorer: Explorer, ions: tuple[int, int] | None, request: Callable[[bool], None]) -> None:
        self._all, self._request = explorer.first_and_last, request
        first, last = self._all
        self.slider = RangeSlider(
            title="ions from - to",
            start=first,
            end=last,
            step=max(1, (last - first) // 200),
            value=ions or (first, last),
            format="0,0",
            width=LEFT - 20,
        )
        request_maps_of(self.slider, request)

    @property
    def ions(self) -> tuple[int, int] | None:
        """First ion, and the one after the last; None for all."""
        first, last = (int(end) for end in self.slider.value)
        return None if (first, last) == self._all else (first, max(last, first + 1))

    def reset(self) -> None:
        """Select all ions."""
        self.slider.value = self._all
        self._request(False)
