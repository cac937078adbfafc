"""Materials: properties of the elements, each number with its source."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from apt_evap._common.codec import checked, choice, count, from_plain, number, settings
from apt_evap._common.notebook import as_table
from apt_evap._common.validation import check_kind, check_name, did_you_mean, short_text
from apt_evap.specimen.isotopes import MOST_ELECTRONS
from apt_evap.specimen.lattice import BASES, nearest_neighbour_distance

_KITTEL = "Kittel, Introduction to Solid State Physics, 8th ed. (2005), ch. 1, table 3"
_COHESION = "Kittel, Introduction to Solid State Physics, 8th ed. (2005), ch. 3, table 1"
_TSONG = "Tsong, Surf. Sci. 70, 211 (1978), image-hump model, charge state of lowest field"
_IMAGE_HUMP = (
    "computed by the image-hump model of Tsong (1978), with cohesive energies of Kittel (2005), ionisation energies of "
    "NIST and work functions of Michaelson (1977); charge state of lowest field"
)
_MULLER = "measured; Mueller and Tsong, Field Ion Microscopy (1969)"
_IUPAC = "IUPAC standard atomic weights, abridged (Prohaska et al., Pure Appl. Chem. 94, 573, 2022)"
_SHAIKH = "Shaikh et al., arXiv 2509.13744, appendix on polarization"
EVAPORATION_FIELD_ERROR = 0.1
"""Relative error of an evaporation field that is computed by an image-hump model."""
# larger than for any element: finds wrong units, such as a = 3.52 (Angstrom) or 35e9 (V/m)
_LONGEST = 2.0
_HIGHEST_FIELD = 1000.0


def _sources(value, name):
    return dict(check_kind(value, name, Mapping, "a mapping of a field to its source"))


@settings
class Material:
    """A pure element (or the host of an alloy) as a field emitter.

    Examples
    --------
    >>> metal = ae.Material("M", structure="bcc", a=0.3, evaporation_field=40.0, charge_state=2, mass=60.0)
    >>> round(metal.nearest_neighbour_distance, 4)  # nm
    0.2598
    >>> ae.Tip(metal, apex_radius=2.0)
    <Tip: 6,583 atoms of M [0 0 1], apex radius 2 nm, shank 4 nm at 1.5 degrees, rounded base>
    """

    name: str = checked("Chemical symbol, or any name.", "str", check_name)
    structure: str = choice("Crystal structure.", BASES)
    a: float = number("Lattice constant.", above=0, at_most=_LONGEST, unit="nm")
    evaporation_field: float = number(
        "Field at which an atom leaves without a barrier.", above=0, at_most=_HIGHEST_FIELD, unit="V/nm"
    )
    charge_state: int = count(
        "Dominant charge of the ion at the evaporation field.", at_least=1, at_most=MOST_ELECTRONS, unit="e"
    )
    mass: float = number("Mass of the ion.", at_least=1, at_most=1e4, unit="Da")
    c: float | None = number(
        "Height of the hexagonal cell; needed for hcp, not allowed for the others.",
        default=None,
        above=0,
        at_most=_LONGEST,
        unit="nm",
    )
    polarizability: float | None = number(
        "Polarizability of the free atom.", default=None, above=0, at_most=1e-30, unit="F m^2"
    )
    cohesive_energy: float | None = number(
        "Energy per atom to take the crystal apart.", default=None, above=0, at_most=20, unit="eV"
    )
    sources: Mapping[str, str] = checked(
        "Source of each number, by the name of the field.",
        "mapping of str to str",
        _sources,
        default={},
        compare=False,
        repr=False,
    )

    _repr_html_ = as_table

    def _check(self):
        if (self.structure == "hcp") != (self.c is not None):
            requirement = "be a number for hcp" if self.structure == "hcp" else f"be None for {self.structure}"
            raise ValueError(f"c must {requirement}, got {short_text(self.c)}")

    @property
    def nearest_neighbour_distance(self) -> float:
        """Distance between nearest neighbours in the bulk [nm]."""
        return nearest_neighbour_distance(self.structure, self.a, self.c)


def _element(name, structure, a, evaporation_field, charge_state, mass, *, field_source=_TSONG, **more):
    sources = {
        "structure": _KITTEL,
        "a": _KITTEL,
        "evaporation_field": field_source,
        "charge_state": _IMAGE_HUMP if field_source == _IMAGE_HUMP else _TSONG,
        "mass": _IUPAC,
    }
    known = {"c": _KITTEL, "cohesive_energy": _COHESION, "polarizability": _SHAIKH}
    sources |= {name: source for name, source in known.items() if name in more}
    return Material(name, structure, a, evaporation_field, charge_state, mass, sources=sources, **more)


def _computed(name, structure, a, evaporation_field, charge_state, mass, cohesive_energy, **more):
    return _element(
        name,
        structure,
        a,
        evaporation_field,
        charge_state,
        mass,
        cohesive_energy=cohesive_energy,
        field_source=_IMAGE_HUMP,
        **more,
    )


MATERIALS = {
    element.name: element
    for element in (
        _computed("Be", "hcp", 0.227, 38.0, 2, 9.012, 3.32, c=0.359),
        _computed("Mg", "hcp", 0.321, 21.0, 1, 24.305, 1.51, c=0.521),
        _element("Al", "fcc", 0.405, 19.0, 1, 26.982, polarizability=9.8e-40, cohesive_energy=3.39),
        _element("Si", "diamond", 0.543, 33.0, 2, 28.085, cohesive_energy=4.63),
        _element("Ti", "hcp", 0.295, 26.0, 2, 47.867, c=0.468, cohesive_energy=4.85),
        _computed("V", "bcc", 0.303, 28.0, 2, 50.942, 5.31),
        _computed("Cr", "bcc", 0.288, 28.0, 1, 51.996, 4.10),
        _element("Fe", "bcc", 0.287, 33.0, 2, 55.845, cohesive_energy=4.28),
        _computed("Co", "hcp", 0.251, 33.0, 2, 58.933, 4.39, c=0.407),
        _element("Ni", "fcc", 0.352, 35.0, 1, 58.693, polarizability=6.8e-40, cohesive_energy=4.44),
        _element("Cu", "fcc", 0.361, 30.0, 1, 63.546, cohesive_energy=3.49),
        _computed("Zn", "hcp", 0.266, 29.0, 1, 65.38, 1.35, c=0.495),
        _computed("Ge", "diamond", 0.566, 27.0, 2, 72.630, 3.85),
        _computed("Zr", "hcp", 0.323, 28.0, 2, 91.224, 6.25, c=0.515),
        _computed("Nb", "bcc", 0.330, 35.0, 2, 92.906, 7.57),
        _computed("Mo", "bcc", 0.315, 38.0, 2, 95.95, 6.82),
        _computed("Ru", "hcp", 0.271, 40.0, 2, 101.07, 6.74, c=0.428),
        _computed("Rh", "fcc", 0.380, 40.0, 2, 102.91, 5.75),
        _computed("Pd", "fcc", 0.389, 35.0, 1, 106.42, 3.89),
        _computed("Ag", "fcc", 0.409, 27.0, 1, 107.87, 2.95),
        _computed("Hf", "hcp", 0.319, 35.0, 2, 178.49, 6.44, c=0.505),
        _computed("Ta", "bcc", 0.330, 46.0, 3, 180.95, 8.10),
        _element("W", "bcc", 0.316, 57.0, 3, 183.84, field_source=_MULLER, cohesive_energy=8.9),
        _computed("Re", "hcp", 0.276, 44.0, 2, 186.21, 8.03, c=0.446),
        _computed("Os", "hcp", 0.274, 50.0, 2, 190.23, 8.17, c=0.432),
        _computed("Ir", "fcc", 0.384, 43.0, 2, 192.22, 6.94),
        _element("Pt", "fcc", 0.392, 48.0, 2, 195.08, cohesive_energy=5.84),
        _element("Au", "fcc", 0.408, 53.0, 1, 196.97, cohesive_energy=3.81),
        _computed("Pb", "fcc", 0.495, 19.0, 1, 207.2, 2.03),
    )
}
"""Known materials by name. Ni and Au are observed as 1+ and 2+: their evaporation fields are close.

Evaporation fields are known to about 10 %: other work functions and ionisation energies change the computed ones by up
to a fifth. Mn and Sn are not in the table: a Tip has no lattice of their structures.
"""


_WORDS = {
    "beryllium": "Be",
    "magnesium": "Mg",
    "aluminium": "Al",
    "aluminum": "Al",
    "silicon": "Si",
    "titanium": "Ti",
    "vanadium": "V",
    "chromium": "Cr",
    "iron": "Fe",
    "cobalt": "Co",
    "nickel": "Ni",
    "copper": "Cu",
    "zinc": "Zn",
    "germanium": "Ge",
    "zirconium": "Zr",
    "niobium": "Nb",
    "molybdenum": "Mo",
    "ruthenium": "Ru",
    "rhodium": "Rh",
    "palladium": "Pd",
    "silver": "Ag",
    "hafnium": "Hf",
    "tantalum": "Ta",
    "tungsten": "W",
    "rhenium": "Re",
    "osmium": "Os",
    "iridium": "Ir",
    "platinum": "Pt",
    "gold": "Au",
    "lead": "Pb",
}


def unknown_name(name: Any) -> str:
    """Message that no material has this name, with the nearest and all names."""
    symbol = _WORDS.get(name.strip().lower()) if isinstance(name, str) else None
    hint = did_you_mean(symbol or name, MATERIALS)
    return f"no material is named {short_text(name)}{hint}; known are {', '.join(MATERIALS)}"


def material(name: str, **changes: Any) -> Material:
    """Return a known material, optionally with changed numbers.

    Parameters
    ----------
    name : str
        Chemical symbol.
    **changes
        Fields of `Material` to replace: ``material("Ni", evaporation_field=36.0)``.

    Returns
    -------
    Material

    Raises
    ------
    ValueError
        If the name or a field is unknown, or a new value is outside its range.

    Examples
    --------
    >>> nickel = ae.material("Ni")
    >>> nickel.structure, nickel.a, nickel.evaporation_field  # nm, V/nm
    ('fcc', 0.352, 35.0)
    >>> ae.material("Ni", evaporation_field=36.0).evaporation_field
    36.0
    """
    known = [item.name for item in fields(Material) if item.name not in ("name", "sources")]
    for change in changes:
        if change not in known:
            raise ValueError(
                f"a material has no {short_text(change)}{did_you_mean(change, known)}; it has {', '.join(known)}"
            )
    if not isinstance(name, str) or name not in MATERIALS:
        raise ValueError(f"{unknown_name(name)}, define others as Material(...)")
    element = MATERIALS[name]
    return replace(element, **changes, sources=element.sources | dict.fromkeys(changes, "given by the user"))


def as_material(value: Material | str | Mapping[str, Any], name: str = "material") -> Material:
    """Return a Material, looked up if `value` is a name."""
    if isinstance(value, str):
        return material(value)
    if isinstance(value, Mapping):
        if value.get("name") in list(MATERIALS) and "sources" not in value:
            return material(**value)
        return from_plain(value, Material, what=name)
    return check_kind(value, name, Material, "a Material or its name")
