"""Pictures: functions that draw into axes and return them, with or without pyplot."""

from apt_evap.plot._figure import add_colorbar, new_figure
from apt_evap.plot.maps import color_limits, common_limits, describe, detector_map, detector_maps
from apt_evap.plot.study import side_by_side, ssim_matrix

__all__ = [
    "add_colorbar",
    "color_limits",
    "common_limits",
    "describe",
    "detector_map",
    "detector_maps",
    "new_figure",
    "side_by_side",
    "ssim_matrix",
]
