"""Classes of warnings, by what they concern: filter by class, as texts may change."""


class AptWarning(UserWarning):
    """Base of all warnings of this package."""


class DataWarning(AptWarning):
    """Ions, ranges or a file are incomplete or ambiguous: what was lost, left out or assumed."""


class ChargesWarning(AptWarning):
    """Charges did not converge, or have drifted from converged ones."""


class ResponseWarning(AptWarning):
    """Hits follow from responses outside the range that these were fitted to, or where the fit is poor."""


class MapWarning(AptWarning):
    """A map that may mislead: stripes of the detector's comb, or too few ions for its bins."""


class RegistrationWarning(AptWarning):
    """A registration that may be wrong."""


class RunWarning(AptWarning):
    """A run that ends early, or that cannot be kept on disk as asked."""


class ReproducibilityWarning(AptWarning):
    """Results that may not have the bits of others of the same settings: another kind of processor or library."""
