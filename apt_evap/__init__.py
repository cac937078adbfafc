"""Field evaporation in atom probe tomography: Robin-Rolland electrostatics with stochastic ion emission."""

from apt_evap import plot
from apt_evap._version import __version__
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
from apt_evap.maps import DetectorMap, azimuthal_profile, radial_profile
from apt_evap.material import Material, material, polarization_energy
from apt_evap.perturbation import Combined, LateralVelocity, RollUp, Unperturbed
from apt_evap.ranges import Ranges
from apt_evap.register import Registration, register, register_points
from apt_evap.response import Design, ResponseSettings
from apt_evap.run import Run, load
from apt_evap.simulation import FlightSettings, Simulation
from apt_evap.study import Study
from apt_evap.tip import Tip

__all__ = [
    "ChargeSettings",
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
    "Hits",
    "IonRandom",
    "LateralVelocity",
    "Launches",
    "Material",
    "Outcome",
    "Ranges",
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
    "__version__",
    "azimuthal_profile",
    "chunks",
    "fit_energies",
    "half_ceiling",
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
    "ssim",
    "tangent_frame",
    "write",
]
