"""Panel of the display: bins, smoothing and flattening of the maps."""

from collections.abc import Callable
from typing import Any

from bokeh.models import Slider

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.explore.explorer import Explorer, ExplorerMaps
from apt_evap.explore.widgets import request_maps_of, slider_with_number

_MOST_BINS = 512


class DisplayPanel:
    """Sliders of the bins and of the Gaussians."""

    def __init__(self, explorer: Explorer, maps: ExplorerMaps, request: Callable[[bool], None]) -> None:
        self._first, self._request = maps.settings, request
        first, size = maps.settings, maps.bin_size
        most = max(maps.pictures[0].values.shape) if isinstance(explorer.measured, DetectorMap) else _MOST_BINS
        millimetres = {"start": 0.0, "step": float(f"{size / 10:.1g}"), "format": "0[.]00"}
        self.smoothing = Slider(
            title="smoothing [mm]", value=first.smoothing, end=max(10 * size, first.smoothing), **millimetres
        )
        self.flattening = Slider(
            title="flattening [mm], 0 for none", value=first.flattening, end=maps.width / 2, **millimetres
        )
        self.bins = Slider(title="bins", start=min(16, first.bins), end=max(most, first.bins), step=1, value=first.bins)
        sliders = self.smoothing, self.flattening, self.bins
        for slider in sliders:
            request_maps_of(slider, request)
        self.widgets: list[Any] = [slider_with_number(self.smoothing)]
        self.further: list[Any] = [*map(slider_with_number, (self.bins, self.flattening))]

    def reset(self) -> None:
        """Set the numbers of the start."""
        for name in ("smoothing", "flattening", "bins"):
            getattr(self, name).value = getattr(self._first, name)
        self._request(False)
