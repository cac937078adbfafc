"""The groups and fields that NeXus NXapm requires of a file, for runs and for ions.

Written for the application definition NXapm as in the NeXus definitions v2026.01. The validator of pynxtools 0.16
(``pynx validate``) accepts these files without a warning. Data for which NXapm has no name are in groups of the class
NXcollection, which are not validated. Texts of NeXus have variable length, because the validator does not accept bytes.
They are not needed to read a file. https://fairmat-nfdi.github.io/nexus_definitions/classes/applications/NXapm.html
"""

from collections.abc import Mapping, Sequence
from typing import Any

import h5py
import numpy as np

from apt_evap._common.checked_hdf5 import put_field

DEFINITIONS = "v2026.01"
"""Version of the NeXus definitions."""
ENTRY = "entry1"
ATOM_PROBE = f"{ENTRY}/atom_probe"
IONS = f"{ATOM_PROBE}/hit_spatial_filtering/evaporation_id"
HITS = f"{ATOM_PROBE}/hit_finding/hit_positions"
TIMES = f"{ATOM_PROBE}/voltage_and_bowl/raw_tof"
MASSES = f"{ATOM_PROBE}/mass_to_charge_conversion/mass_to_charge"
MULTIPLICITY = f"{ATOM_PROBE}/hit_finding/hit_multiplicity"
PULSER = f"{ENTRY}/measurement/event1/instrument/pulser"
POSITIONS = f"{ATOM_PROBE}/reconstruction/reconstructed_positions"
_FRAME = f"{ENTRY}/laboratory_reference_frame"


def put_group(parent: Any, name: str, nexus_class: str) -> Any:
    """Create a group of a NeXus class."""
    group = parent.create_group(name)
    group.attrs["NX_class"] = nexus_class
    return group


def put_nxapm(
    file: h5py.File,
    *,
    ions: Any,
    hits: Any,
    times: Any,
    masses: Any,
    multiplicity: Any = None,
    elements: Sequence[str],
    start_time: str,
    version: str,
    is_simulation: bool,
    radius: float | None = None,
    shank_angle: float | None = None,
) -> None:
    """Write all that NXapm requires, and the hits; arrays are of shape (n,).

    Units are mm (`hits`, shape (n, 2)), ns (`times`, a field that NXapm gives no unit), Da, nm (`radius`, at the first
    ion) and degrees (`shank_angle`, half the opening angle). `ions` are numbers in the sequence of evaporation,
    `multiplicity` is the number of ions in the pulse of each ion.
    """
    file.attrs["NX_class"] = "NXroot"
    entry = put_group(file, ENTRY, "NXentry")
    put_field(entry, "definition", "NXapm").attrs["version"] = DEFINITIONS
    put_field(entry, "start_time", start_time)
    put_field(entry, "operation_mode", "apt")
    specimen = put_group(entry, "specimen", "NXsample")
    put_field(specimen, "is_simulation", np.bool_(is_simulation))
    put_field(specimen, "atom_types", ", ".join(dict.fromkeys(elements)))
    for name, value, unit in (("initial_radius", radius, "nm"), ("shank_angle", shank_angle, "deg")):
        if value is not None:
            put_field(specimen, name, float(value), unit)
    frame = put_group(file, _FRAME, "NXcoordinate_system")
    put_field(frame, "type", "cartesian")
    for name, direction in zip("xyz", np.eye(3), strict=True):
        put_field(frame, name, direction, "mm")
    put_group(file, ATOM_PROBE, "NXroi_process")
    _put_process(file, HITS, version)
    if hits is not None:
        put_field(file, HITS, hits, "mm").attrs["depends_on"] = f"/{_FRAME}"
    if multiplicity is not None:
        put_field(file, MULTIPLICITY, multiplicity)
    put_field(_put_process(file, IONS, version), "evaporation_id_offset", np.int64(0))
    put_field(file, IONS, ions)
    put_group(_put_process(file, TIMES, version), "config", "NXparameters")
    if times is not None:
        put_field(file, TIMES, times)
    if masses is not None:  # NXapm requires them of this step
        _put_process(file, MASSES, version)
        put_field(file, MASSES, masses, "Da")


def put_links(file: h5py.File, columns: Mapping[str, Any]) -> None:
    """Link datasets to the paths at which other programs look for them.

    NXapm allows these groups only with data that are not recorded here, such as the pressure. They are therefore of the
    class NXcollection.
    """
    for path, dataset in columns.items():
        *folders, name = path.split("/")
        group = file
        for folder in folders:
            group = group[folder] if folder in group else put_group(group, folder, "NXcollection")
        group[name] = dataset


def _put_process(file, field, version):
    """The step of the analysis that contains a field, with the program that did it."""
    group = put_group(file, field.rpartition("/")[0], "NXprocess")
    put_field(put_group(group, "program1", "NXprogram"), "program", "apt_evap").attrs["version"] = version
    return group
