"""Mechanisms and default grid of energies of a study, in a module without imports for fast help texts."""

MEANS = (0.01, 0.0825, 0.155, 0.2275, 0.3, 0.3725)
"""Means of the paper's grid [eV]: from 0.01 to 0.3725 in even steps."""
RSDS = (0.01, 0.0316, 0.1, 0.316, 1.0, 3.16)
"""Relative standard deviations of the paper's grid: from 0.01 to 3.16, two per decade."""
ROLLUP_FRACTIONS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Roll-up fractions of the energy in the paper's grid."""
MODEL_ERROR = 0.2
"""Relative increase of the misfit 1 - SSIM from the best to the true point, by the error of the model.

Measured (roll-up, Ni[111], R = 14 a, 10,000 ions, 23 twins with other origins, and radii, shanks and surface thresholds
within 20 %, each fitted by five specimens): median 0.12, 95 % below 0.24, largest 0.31. With 0.2, the intervals contain
the hidden sigma/mean in 96 %, and the hidden true mean in 98 % of the 115 fits."""
FOLDED_MODEL_ERROR = 0.12
"""The same for 1 - concordance of folded maps.

Measured (50 twins as above, one specimen fitted): the intervals contain the hidden sigma/mean and true standard
deviation in 98 and 98 %, with 0.10 in 92 and 92 %."""
FOLDED_MODEL_ERROR_OF_MEANS = 0.08
"""The same for the mean and the true mean, which maps see better: in 100 and 96 %, with 0.04 in 96 and 86 %."""
SAME_RADIUS_MODEL_ERROR_OF_MEANS = 0.04
"""The same for 50 twins with radii within 5 %: 100 and 98 %, with 0.03 98 and 94 %."""

MECHANISMS = ("roll-up", "lateral", "combined")
"""Mechanisms of emission: `RollUp`, `LateralVelocity` or `Combined`."""
