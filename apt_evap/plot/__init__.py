"""Pictures: functions that draw into axes and return them, with or without pyplot."""

from apt_evap.plot._figure import add_colorbar, new_figure
from apt_evap.plot.histories import history
from apt_evap.plot.maps import color_limits, common_limits, describe, detector_map, detector_maps
from apt_evap.plot.overlay import overlay
from apt_evap.plot.poles import poles
from apt_evap.plot.profiles import profile, profile_comparison, rectangles
from apt_evap.plot.responses import ion_colors, response
from apt_evap.plot.specimens import mark_atoms, specimen
from apt_evap.plot.study import side_by_side, ssim_matrix

__all__ = [
    "add_colorbar",
    "color_limits",
    "common_limits",
    "describe",
    "detector_map",
    "detector_maps",
    "history",
    "ion_colors",
    "mark_atoms",
    "new_figure",
    "overlay",
    "poles",
    "profile",
    "profile_comparison",
    "rectangles",
    "response",
    "side_by_side",
    "specimen",
    "ssim_matrix",
]
