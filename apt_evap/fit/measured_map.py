"""The measured map of a comparison: its bins, and how many of them the ions of a run allow."""

import math
from dataclasses import replace

import numpy as np

from apt_evap._common.validation import check_count, check_kind
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.emission.perturbations import Unperturbed
from apt_evap.maps.registration.register import Registration
from apt_evap.maps.similarity import WINDOW
from apt_evap.simulation.run import Run

BINS = 128
"""Bins along the longer side of a map of ions."""
FEWEST_IONS = 0.5
"""Fewest simulated ions per bin of a comparison; studies of tutorials and twins have 1 to 10."""
_FEWEST_BINS = 24  # along the longer side of a comparison
_MARGIN = 1.2  # of the ions in a bin, as the common region is smaller


def measured_map(measured: Hits | DetectorMap, bins: int | None = None) -> DetectorMap:
    """Measured map, with about the requested number of bins along the longer side.

    Parameters
    ----------
    measured : Hits or DetectorMap
        Measured ions, or a map, whose bins are merged by an integer factor.
    bins : int, optional
        Number of bins, at least 11; by default 128 for ions, and those of a map.

    Returns
    -------
    DetectorMap

    Raises
    ------
    ValueError
        If the number is too small or leaves no bin.
    """
    if bins is not None:
        bins = check_count(bins, "bins", at_least=2 * WINDOW + 1)
    if isinstance(measured, Hits):
        return DetectorMap.from_hits(measured, bins=bins or BINS)
    check_kind(measured, "measured", DetectorMap, "Hits or a DetectorMap")
    if bins is None:
        return measured
    ny, nx = measured.values.shape
    factor = max(1, round(max(nx, ny) / bins))
    rows, columns = ny - ny % factor, nx - nx % factor

    def blocks(values):
        return values[:rows, :columns].reshape(rows // factor, factor, columns // factor, factor)

    inside = blocks(measured.mask)
    # a bin partly outside counts as outside
    mask, values = inside.all(axis=(1, 3)), blocks(np.where(measured.mask, measured.values, 0)).sum(axis=(1, 3))
    if not mask.any():
        raise ValueError(f"bins={bins} leaves no bin inside {measured!r}")
    x_edges, y_edges = measured.x_edges[: columns + 1 : factor], measured.y_edges[: rows + 1 : factor]
    ions = int(values[mask].sum()) if measured.is_counts else None
    return replace(measured, values=values, mask=mask, ions=ions, detected=None, x_edges=x_edges, y_edges=y_edges)


def bins_for_run(run: Run, measured: DetectorMap, registration: Registration, merged: bool) -> int | None:
    """Bins along the longer side with enough ions of a run in each, None for the bins of the map.

    Returns
    -------
    int or None
        At least 24.
    """
    seen = registration.hits(run.hits(Unperturbed())).map(like=measured, position_step=None)
    covered = measured.mask & seen.mask
    ions, bins = int(seen.counts[covered].sum()), np.count_nonzero(covered)
    if ions >= _MARGIN * FEWEST_IONS * bins:
        return None
    side = max(measured.values.shape)
    factor = math.sqrt(_MARGIN * FEWEST_IONS * bins / max(ions, 1))
    fewer = max(_FEWEST_BINS, int(side / (math.ceil(factor) if merged else factor)))
    return fewer if fewer < side else None
