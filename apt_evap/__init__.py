"""Field evaporation in atom probe tomography: Robin-Rolland electrostatics with stochastic ion emission."""

from apt_evap import plot
from apt_evap._version import __version__
from apt_evap.cap import field_factor, fit_caps, image_compression, run_field_factor
from apt_evap.checkpoint import Checkpoint
from apt_evap.compare import half_ceiling, ssim
from apt_evap.detector import Detector
from apt_evap.emission import Emissions, Launches, tangent_frame
from apt_evap.emitter import ChargeSettings, Emitter
from apt_evap.energy import Fixed, Thermal, TruncatedNormal
from apt_evap.fit import fit_energies
from apt_evap.hits import Hits, Outcome
from apt_evap.io import FileError, TruncatedFile, chunks, read, read_ranges, write
from apt_evap.io.npz import read_map
from apt_evap.ion_random import IonRandom
from apt_evap.law import Extremal
from apt_evap.maps import DetectorMap
from apt_evap.material import Material, material, polarization_energy
from apt_evap.orientation import Orientation, fit_orientation
from apt_evap.perturbation import Combined, LateralVelocity, RollUp, Unperturbed
from apt_evap.profiles import Rectangle, azimuthal_profile, radial_profile, zone_line_profile
from apt_evap.projection import Projection
from apt_evap.ranges import Ranges
from apt_evap.register import Registration, register, register_points
from apt_evap.response import Design, ResponseSettings
from apt_evap.run import Run, load
from apt_evap.simulation import FlightSettings, Simulation
from apt_evap.study import Study
from apt_evap.tip import Tip
from apt_evap.tracks import lateral_tracks, rollup_tracks
from apt_evap.watch import History, WatchSettings
from apt_evap.zone_line import ZoneLine, compare_profiles, fit_zone_line

__all__ = [
    "ChargeSettings",
    "Checkpoint",
    "Combined",
    "Design",
    "Detector",
    "DetectorMap",
    "Emissions",
    "Emitter",
    "Extremal",
    "FileError",
    "Fixed",
    "FlightSettings",
    "History",
    "Hits",
    "IonRandom",
    "LateralVelocity",
    "Launches",
    "Material",
    "Orientation",
    "Outcome",
    "Projection",
    "Ranges",
    "Rectangle",
    "Registration",
    "ResponseSettings",
    "RollUp",
    "Run",
    "Simulation",
    "Study",
    "Thermal",
    "Tip",
    "TruncatedFile",
    "TruncatedNormal",
    "Unperturbed",
    "WatchSettings",
    "ZoneLine",
    "__version__",
    "azimuthal_profile",
    "chunks",
    "compare_profiles",
    "field_factor",
    "fit_caps",
    "fit_energies",
    "fit_orientation",
    "fit_zone_line",
    "half_ceiling",
    "image_compression",
    "lateral_tracks",
    "load",
    "material",
    "plot",
    "polarization_energy",
    "radial_profile",
    "read",
    "read_map",
    "read_ranges",
    "register",
    "register_points",
    "rollup_tracks",
    "run_field_factor",
    "ssim",
    "tangent_frame",
    "write",
    "zone_line_profile",
]
