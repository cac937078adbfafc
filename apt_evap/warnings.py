"""Classes of warnings, by subject. Filter them by class: the texts may change."""

import sys
import warnings

_PACKAGE = __name__.partition(".")[0]
_BETWEEN = ("contextlib", "functools")  # modules with frames between two functions of the package


class AptWarning(UserWarning):
    """Base of all warnings of this package."""

    fact: str = ""
    """The text without the advice, for those who did not choose the settings that it is about."""


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


class WorkflowWarning(AptWarning):
    """What to know about the result of a workflow: ions that miss the detector, an interrupt, an assumption."""


def warn(message: str, category: type[AptWarning], advice: str = "") -> None:
    """Issue a warning for the line outside the package that has called it.

    Parameters
    ----------
    message : str
        Text.
    category : type
        One of these classes.
    advice : str
        Settings to change; follows the text.
    """
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and _is_inside(frame):
        level, frame = level + 1, frame.f_back
    warning = category(f"{message}: {advice}" if advice else message)
    warning.fact = message
    warnings.warn(warning, stacklevel=level)


def _is_inside(frame):
    module = frame.f_globals.get("__name__") or ""
    return module.partition(".")[0] == _PACKAGE or module in _BETWEEN
