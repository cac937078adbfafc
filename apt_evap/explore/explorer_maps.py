"""What the explorer shows: settings of its maps, and the maps with the numbers that compare them."""

from dataclasses import dataclass

from apt_evap._common.codec import check_itself
from apt_evap._common.validation import check_count, check_number, check_sequence
from apt_evap.detection.binning import MAX_BINS
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.emission.perturbations import Perturbation
from apt_evap.maps.similarity import Similarity


@dataclass(frozen=True)
class ExplorerSettings:
    """Settings of the maps of the explorer.

    Parameters
    ----------
    perturbation : perturbation
        Emission of the ions.
    bins : int
        Bins along the longer side; with a measured map, its bins are merged to come closest to this number.
    smoothing : float
        Standard deviation of the Gaussian that smooths both maps [mm]; 0 for none.
    flattening : float
        Standard deviation of the Gaussian that flattens both maps before [mm]; 0 for none.
    ions : tuple of int, optional
        First ion, and the one after the last, in the sequence of evaporation; by default all.

    Raises
    ------
    ValueError
        If a number is outside its range.
    """

    perturbation: Perturbation
    bins: int
    smoothing: float
    flattening: float = 0.0
    ions: tuple[int, int] | None = None

    def __post_init__(self):
        check_itself(self)

    def _check(self):
        check_count(self.bins, "bins", at_least=1, at_most=MAX_BINS)
        widths = ("smoothing", "flattening")
        values = {name: check_number(getattr(self, name), name, at_least=0, unit="mm") for name in widths}
        if self.ions is None:
            return values
        first, last = check_sequence(self.ions, "ions", "(first, last)")
        first = check_count(first, "first ion")
        return values | {"ions": (first, check_count(last, "last ion", at_least=first + 1))}


@dataclass(frozen=True, eq=False)
class ExplorerMaps:
    """Maps of the explorer, and the numbers that compare them.

    Parameters
    ----------
    settings : ExplorerSettings
        Settings of the maps.
    simulated : DetectorMap or None
        Counts of the simulated ions, in the measured frame if there is a measured map; None without a run.
    measured : DetectorMap or None
        The measured map, with a run within the region that both maps cover.
    pictures : tuple of DetectorMap
        The same maps flattened and smoothed; without those that are None.
    whole : DetectorMap or None
        The complete measured map, flattened and smoothed.
    similarity : Similarity or None
        `similarity` of both maps; None without a measured map or with too few bins.
    ceiling : Similarity or None
        `similarity_ceiling` of the measured counts, for comparison; None for densities and for flattened maps.
    ions : int
        Number of simulated ions, including those outside the map.
    preview : bool
        Whether these are only a part of the ions of the settings.
    seconds : float
        Duration of the computation [s].
    notes : tuple of str
        Texts of the warnings.
    """

    settings: ExplorerSettings
    simulated: DetectorMap | None
    measured: DetectorMap | None
    pictures: tuple[DetectorMap, ...]
    whole: DetectorMap | None
    similarity: Similarity | None
    ceiling: Similarity | None
    ions: int
    preview: bool
    seconds: float
    notes: tuple[str, ...]

    @property
    def present(self) -> list[DetectorMap]:
        """The simulated and the measured map, as far as there are both."""
        return [counts for counts in (self.simulated, self.measured) if counts is not None]

    @property
    def width(self) -> float:
        """Longer side of the maps [mm]."""
        left, right, lower, upper = self.pictures[0].extent
        return max(right - left, upper - lower)

    @property
    def bin_size(self) -> float:
        """Longer side of a bin [mm]."""
        return max(self.pictures[0].bin_size)
