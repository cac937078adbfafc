"""Classes of warnings, by subject. Filter them by class: the texts may change."""


class AptWarning(UserWarning):
    """Base of all warnings of this package."""


class DataWarning(AptWarning):
    """Incomplete or ambiguous ions, ranges, specimens or files: the text says what was lost, skipped or assumed."""


class ChargesWarning(AptWarning):
    """Charges that did not converge, or that drifted from the converged ones."""


class EmissionWarning(AptWarning):
    """A rule of the emission outside the conditions for which it holds."""


class ResponseWarning(AptWarning):
    """Hits from responses outside the fitted range, or where the fit is poor."""


class MapWarning(AptWarning):
    """A map that may mislead: stripes from the detector quantisation step, or too few ions for its bins."""


class RegistrationWarning(AptWarning):
    """A registration that may be wrong."""


class StructureWarning(AptWarning):
    """A best map that has lost the zone lines of the measured one."""


class SpecimenWarning(AptWarning):
    """A specimen in an unusual position: upside down, or lying on its side."""


class RunWarning(AptWarning):
    """A run that ends early, or that cannot be saved as requested."""
