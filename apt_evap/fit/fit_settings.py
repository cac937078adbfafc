"""Settings of a fit: comparison, random draws and resampling of maps."""

from apt_evap._common.codec import checked, choice, count, number, settings, switch
from apt_evap._common.validation import check_seed
from apt_evap.detection.binning import MAX_BINS

MODEL_ERROR = 0.2
"""Relative increase of the misfit 1 - SSIM from the best to the true point, by the error of the model.

Measured (roll-up, Ni[111], R = 14 a, 10,000 ions, 23 twins with other origins, and radii, shanks and surface thresholds
within 20 %, each fitted by five specimens): median 0.12, 95 % below 0.24, largest 0.31. With 0.2, the intervals contain
the hidden sigma/mean in 96 %, and the hidden true mean in 98 % of the 115 fits."""
FOLDED_MODEL_ERROR = 0.12
"""This difference for 1 - concordance of folded maps.

Measured (50 twins as above, one specimen fitted): the intervals contain the hidden sigma/mean and true standard
deviation in 98 and 98 %, with 0.10 in 92 and 92 %."""
FOLDED_MODEL_ERROR_OF_MEANS = 0.08
"""This difference for the mean and the true mean, to which maps are more sensitive.

Measured (these twins): in 100 and 96 %, with 0.04 in 96 and 86 %."""
SAME_RADIUS_MODEL_ERROR_OF_MEANS = 0.04
"""This difference of means for 50 twins with radii within 5 %: 100 and 98 %, with 0.03 98 and 94 %."""


@settings
class FitSettings:
    """Comparison, random draws and resampling of maps in `fit_energies`.

    The default None of a setting is replaced by a value that follows from the maps.
    """

    bins: int | None = count(
        "Bins along the longer side. By default 128 for measured hits, and those of a map, or fewer, at least 24, if "
        "the run has less than 0.6 ions in each of them. The bins of a map are merged by an integer factor.",
        default=None,
        at_least=11,
        at_most=MAX_BINS,
    )
    smoothing: float | None = number(
        "Standard deviation of the Gaussian that smooths both maps. By default half a bin for counts, and one bin for "
        "densities, whose noise is not known.",
        default=None,
        at_least=0,
        unit="mm",
    )
    flattening: float | None = number(
        "Standard deviation of the Gaussian that flattens both maps: each map is divided by a smoothed copy; 0 for no "
        "flattening. By default 0.15 of the square root of the compared area. This removes gradients from the "
        "instrument or from the shape of the specimen, which do not depend on the energy.",
        default=None,
        at_least=0,
        unit="mm",
    )
    objective: str | None = choice(
        'What is compared: "folded", the concordance of both maps folded about a pole (`FoldedComparison`), which does '
        'not reward blurring, or "similarity", the structural similarity of both maps place by place. By default '
        '"folded" if the maps show a pole to fold about, and "similarity" for several runs, whose poles may differ.',
        ("similarity", "folded"),
        default=None,
    )
    data_range: float = number("Range of densities, as for `similarity`.", default=2.0, above=0)
    allow_noise: bool = switch(
        "Whether the similarity is corrected for the noise of both maps: the Poisson noise of measured counts, and the "
        "noise of the random draws of simulated ions. False for the standard `similarity`.",
        default=True,
    )
    replicas: int | None = count(
        "Number of draws of energy and direction per ion, which are summed to reduce the noise of a map. By default "
        "ten times as many simulated as measured ions, with 4 to 16 draws.",
        default=None,
        at_least=1,
    )
    resamples: int = count(
        "Number of resamples of all measured and simulated ions, for the errors; 0 for none.", default=200
    )
    seed: int = checked("Seed of the resamples.", "int", check_seed, default=0)
    temperature: float = number(
        "Temperature of the thermal baseline, Maxwell-Boltzmann lateral velocities.",
        default=50.0,
        above=0,
        at_most=1e5,
        unit="K",
    )
    model_error: float | None = number(
        "Relative increase of the misfit 1 - SSIM, or 1 - concordance, that the difference of the simulated from the "
        "measured specimen explains, for the intervals; 0: by noise alone. By default 0.2, for folded maps "
        "0.12, and for their mean energy and true mean 0.08. Measured with twins.",
        default=None,
        at_least=0,
    )

    same_radius: bool = switch(
        "Whether the simulated specimen is known to have the radius of the measured one, within 5 %. The default model "
        "error of the mean and the true mean is then 0.04 for folded maps.",
        default=False,
    )

    @property
    def score_name(self) -> str:
        """Name of the scores: "SSIM", or "concordance" of folded maps."""
        return "concordance" if self.objective == "folded" else "SSIM"

    @property
    def allowed_errors(self) -> tuple[float, float]:
        """Model error of the mean and the true mean, and of all other numbers."""
        if self.model_error is not None:
            return self.model_error, self.model_error
        if self.objective != "folded":
            return MODEL_ERROR, MODEL_ERROR
        means = SAME_RADIUS_MODEL_ERROR_OF_MEANS if self.same_radius else FOLDED_MODEL_ERROR_OF_MEANS
        return means, FOLDED_MODEL_ERROR
