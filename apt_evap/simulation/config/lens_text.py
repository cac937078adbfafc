"""Lenses from a table or from text such as local-electrode:shank_angle=7."""

from collections.abc import Mapping
from typing import Any

from apt_evap._common.codec import from_plain
from apt_evap._common.validation import check_kind, short_text
from apt_evap.detection.microscope.local_electrode import ELECTRODE_PRESETS, LocalElectrode
from apt_evap.simulation.config.toml_text import read_toml


def read_lens(settings: str | Mapping[str, Any]) -> LocalElectrode:
    """Make a lens from a table, or from the text of an option.

    Parameters
    ----------
    settings : str or mapping
        Fields of `LocalElectrode`, perhaps with a ``preset`` whose other fields they replace. As text: the name of a
        preset and the fields that are changed, ``"local-electrode:shank_angle=7,distance=60e3"``.

    Examples
    --------
    >>> from apt_evap.simulation.config.lens_text import read_lens
    >>> read_lens("local-electrode:shank_angle=7").shank_angle  # degrees
    7.0
    """
    if isinstance(settings, str):
        try:
            return read_lens(_table(settings))
        except ValueError as error:
            example = "an example is local-electrode:shank_angle=5"
            raise ValueError(f"lens {short_text(settings)}: {error}; {example}") from error
    table = dict(check_kind(settings, "lens", Mapping, "a text or a table"))
    if "preset" in table:
        name = table.pop("preset")
        known = {preset.replace(" ", "-"): preset for preset in ELECTRODE_PRESETS}
        if not isinstance(name, str) or name.replace(" ", "-") not in known:
            raise ValueError(f"preset must be {' or '.join(map(repr, ELECTRODE_PRESETS))}, got {short_text(name)}")
        table = {**ELECTRODE_PRESETS[known[name.replace(" ", "-")]], **table}
    return from_plain(table, LocalElectrode, what="lens")


def _table(text):
    """Table of a lens from text."""
    name, _, fields = text.partition(":")
    try:
        changes = read_toml(fields.replace(",", "\n"))
    except ValueError:
        expected = "expected fields such as shank_angle=7 after the colon"
        raise ValueError(f"{expected}, got {short_text(fields)}") from None
    return {"preset": name, **changes}
