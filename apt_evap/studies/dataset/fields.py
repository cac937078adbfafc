"""The tables of a data set and their fields: the files, the schema and the data sheet follow from this list."""

from typing import Any, NamedTuple

import numpy as np

TEXT = "text"
"""Type of a field of texts."""
LINE_POINTS = 61
"""Points of a zone line: every 3 degrees from horizon to horizon."""


class Field(NamedTuple):
    """A column of a table of a data set."""

    name: str
    """Name."""
    dtype: Any
    """Type of its numbers, or "text"."""
    text: str
    """What it is."""
    unit: str = ""
    """Unit."""
    row: tuple[int, ...] = ()
    """Shape of a row."""

    @property
    def kind(self) -> str:
        """Name of its type: "text", "float32", ..."""
        return TEXT if self.dtype == TEXT else np.dtype(self.dtype).name

    @property
    def bytes(self) -> int:
        """Size of a row of numbers [bytes]."""
        return 0 if self.dtype == TEXT else np.dtype(self.dtype).itemsize * int(np.prod(self.row))


EXAMPLE = Field("example", np.uint32, "Index of the example, from 0 in each file.")
TABLES: dict[str, tuple[Field, ...]] = {
    "examples": (
        Field("name", TEXT, "Name: key of the run, and number of the emission."),
        Field("run", TEXT, "Key of the run: the beginning of the SHA-256 of its settings."),
        Field("split", TEXT, "train, validation or test."),
        Field("first_ion", np.int64, "Index of its first ion in the table of the ions."),
        Field("ions", np.int64, "Recorded ions."),
        Field("evaporated", np.int64, "Evaporated ions of the run."),
        Field("material", TEXT, "Material of the matrix; empty for a specimen from a file."),
        Field("structure", TEXT, "Its structure: fcc, bcc, sc, diamond or hcp."),
        Field("lattice_constant", np.float64, "Its lattice constant.", "nm"),
        Field("elements", TEXT, "Names of the species as a list in JSON."),
        Field("phases", TEXT, "Names of the phases as a list in JSON."),
        Field("axis", np.float64, "Crystal direction [u v w] along the axis of the specimen.", "", (3,)),
        Field("orientation", np.float64, "Rotation from the crystal to the specimen.", "", (3, 3)),
        Field("compression", np.float32, "Image compression of the run; NaN if it has too few ions."),
        Field("emission", TEXT, "Emission: a perturbation in JSON; energies in eV."),
        Field("instrument", TEXT, "Instrument in JSON."),
        Field("seed", np.int64, "Seed of the emission and of the instrument."),
        Field("settings", TEXT, "Settings of the run in JSON, as in a file of apt-evap run."),
        Field("fingerprint", TEXT, "SHA-256 of the bits of the run."),
    ),
    "ions": (
        Field("x", np.float32, "Measured position on the detector.", "mm"),
        Field("y", np.float32, "Measured position on the detector.", "mm"),
        Field("time_of_flight", np.float32, "Measured time of flight.", "ns"),
        Field("mass_to_charge", np.float32, "Measured mass-to-charge ratio.", "Da"),
        Field("voltage", np.float32, "Standing voltage.", "V"),
        Field("pulse_voltage", np.float32, "Height of the voltage pulse; 0 without one.", "V"),
        Field("pulse", np.int64, "Number of the pulse."),
        Field("multiplicity", np.uint16, "Recorded ions of its pulse."),
        Field("site", np.float32, "True position in the specimen before evaporation.", "nm", (3,)),
        Field("species", np.uint8, "True species: index into the elements of the example; 0 is the host."),
        Field("phase", np.uint8, "True phase: index into the phases of the example; 0 is the matrix."),
        Field("charge", np.uint8, "True charge in flight.", "e"),
        Field("number", np.int32, "Number in the sequence of evaporation, of all ions from 0."),
    ),
    "poles": (
        Field("indices", np.int16, "Miller indices h k l of the planes; for hcp without i = -(h + k).", "", (3,)),
        Field("normal", np.float32, "Unit normal in the frame of the specimen.", "", (3,)),
        Field("spacing", np.float32, "Distance between the planes.", "nm"),
        Field("x", np.float32, "Position on the detector; NaN if it is not in front of it.", "mm"),
        Field("y", np.float32, "Position on the detector; NaN if it is not in front of it.", "mm"),
        Field("visible", np.bool_, "Whether the position is within the field of view."),
    ),
    "zone_lines": (
        Field("indices", np.int16, "Direction u v w of the zone axis, in three indices also for hcp.", "", (3,)),
        Field("direction", np.float32, "Unit vector of the axis in the frame of the specimen.", "", (3,)),
        Field("x", np.float32, "Points of the line on the detector; NaN outside.", "mm", (LINE_POINTS,)),
        Field("y", np.float32, "Points of the line on the detector; NaN outside.", "mm", (LINE_POINTS,)),
    ),
    "cap": (
        Field("number", np.int64, "Number of evaporated ions."),
        Field("radius", np.float32, "Radius of the cap.", "nm"),
        Field("apex", np.float32, "z of the top of the cap, in the frame of the sites.", "nm"),
    ),
}
"""Fields of each table. All tables but that of the examples also have `EXAMPLE`."""
CHOICES = (*(field.name for field in TABLES["ions"]), "poles", "zone_lines", "cap")
"""What the key ``fields`` of ``[dataset]`` can contain: columns of the ions, and further tables."""


def chosen_tables(chosen: tuple[str, ...]) -> dict[str, tuple[Field, ...]]:
    """Tables of a data set with these fields, dict."""
    tables = {"examples": TABLES["examples"]}
    tables["ions"] = (EXAMPLE, *(field for field in TABLES["ions"] if field.name in chosen))
    return tables | {
        name: (EXAMPLE, *fields) for name, fields in TABLES.items() if name in chosen and name not in tables
    }
