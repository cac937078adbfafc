"""Settings of a study: comparison, random draws and resampling of maps."""

from dataclasses import dataclass

from apt_evap._common.validation import check_count, check_number, check_seed, check_switch
from apt_evap.emission.energies import Thermal
from apt_evap.energy_fit.defaults import MODEL_ERROR


@dataclass(frozen=True)
class StudySettings:
    """Settings of `fit_energies`: comparison, random draws and resampling of maps.

    Parameters
    ----------
    smoothing : float
        Standard deviation of the Gaussian that smooths both maps [mm]; 0 for none.
    flattening : float, optional
        Standard deviation of the Gaussian that flattens both maps [mm]; 0 for none. None until it follows from the area
        of the compared region.
    data_range : float
        Range of densities, as for `ssim`.
    allow_noise : bool
        Whether the similarity is corrected for noise: the Poisson noise of measured counts, and the noise of the random
        draws of simulated ions.
    replicas : int
        Number of draws of energy and direction per ion, which are summed.
    resamples : int
        Number of resamples of all measured and simulated ions, for the errors.
    seed : int
        Seed of the resamples.
    temperature : float
        Temperature of the thermal baseline [K].
    model_error : float
        Relative increase of the misfit 1 - SSIM that the difference of the simulated from the measured specimen
        explains, for the intervals; 0 for intervals by noise alone.

    Raises
    ------
    ValueError
        If a value is outside its range.
    """

    smoothing: float
    flattening: float | None = None
    data_range: float = 2.0
    allow_noise: bool = True
    replicas: int = 4
    resamples: int = 200
    seed: int = 0
    temperature: float = 50.0
    model_error: float = MODEL_ERROR

    def __post_init__(self):
        values = {
            "smoothing": check_number(self.smoothing, "smoothing", at_least=0, unit="mm"),
            "data_range": check_number(self.data_range, "data_range", above=0),
            "allow_noise": check_switch(self.allow_noise, "allow_noise"),
            "replicas": check_count(self.replicas, "replicas", at_least=1),
            "resamples": check_count(self.resamples, "resamples"),
            "seed": check_seed(self.seed),
            "temperature": Thermal(self.temperature).temperature,
            "model_error": check_number(self.model_error, "model_error", at_least=0),
        }
        if self.flattening is not None:
            values["flattening"] = check_number(self.flattening, "flattening", at_least=0, unit="mm")
        for name, value in values.items():
            object.__setattr__(self, name, value)
