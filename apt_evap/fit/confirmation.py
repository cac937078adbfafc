"""Maps whose symmetries agree are alike only if their folded maps correlate, and their lines have the same sign.

The symmetry about a pole does not change if lines are dark instead of bright (`maps.likeness`). The folded maps, and
the amplitudes of the lines in the rings about the pole, do.

Measured, with tips of R = 16 a and 10,000 ions of which all roll up, and registrations that were searched: folded maps
of the same crystal and axis correlate to 0.55, 0.77 and 0.79; with a registration that was only refined from a start,
0.46 (nickel) and -0.09 and 0.26 (tungsten). Of other crystals or axes three of six pairs correlate to -0.09 to 0.01,
and three to 0.45 to 0.69; the symmetries of these three do not agree. The limit was chosen with these numbers.
"""

import math
from collections.abc import Sequence

import numpy as np

from apt_evap.fit.structure import SIGNIFICANT, Structure
from apt_evap.maps.registration.verdict import Likeness
from apt_evap.maps.rings import line_amplitude

LEAST_CORRELATION = 0.4
"""Correlation of the folded maps above which maps are alike."""


def confirmed(likeness: Likeness, simulated: Structure | None, measured: Structure | None) -> Likeness:
    """Verdict on two maps by their symmetries, and by their structure about a pole.

    Parameters
    ----------
    likeness : Likeness
        Verdict by the symmetries.
    simulated, measured : Structure or None
        Structure about the same pole; None if there is no pole whose rings are on the maps.

    Returns
    -------
    Likeness
        "alike" becomes "doubtful" without the correlation, or with lines of the other sign.
    """
    if likeness.verdict != "alike":
        return likeness
    if simulated is None or measured is None:
        return _doubtful(likeness, "no pole with its rings is on both maps, so that their lines cannot be compared")
    correlation = simulated.correlation(measured)
    if not correlation >= LEAST_CORRELATION:
        known = "cannot be correlated" if math.isnan(correlation) else f"correlate only to {correlation:.2f}"
        return _doubtful(likeness, f"their folded maps {known}, {LEAST_CORRELATION:g} is needed")
    if wrong := lines_of_other_sign(simulated, measured):
        rings = ", ".join(f"{inner:g} to {outer:g}" for inner, outer in wrong)
        return _doubtful(likeness, f"lines at {rings} degrees from the pole have the other sign")
    return likeness


def lines_of_other_sign(simulated: Structure, measured: Structure) -> Sequence[tuple[float, float]]:
    """Rings with a significant measured contrast in which bright lines are dark, or dark ones bright.

    Returns
    -------
    list of (float, float)
        Inner and outer radii [degrees].
    """
    wrong = []
    for ring, other in simulated.significant_rings(measured):
        amplitude = line_amplitude(ring, other)
        if amplitude.value < -SIGNIFICANT * np.nan_to_num(amplitude.error):
            wrong.append((ring.inner, ring.outer))
    return wrong


def _doubtful(likeness, reason):
    return likeness._replace(verdict="doubtful", reason=f"{likeness.reason}, but {reason}")
