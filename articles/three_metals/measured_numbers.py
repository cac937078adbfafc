"""Folded densities of the measured maps, as numbers in measured.npz; needs the three files.

python measured_numbers.py W_tap.raw NICKEL.npz ALUMINIUM.npz
"""

import sys
from pathlib import Path

import numpy as np
from judge import METALS, folded, measured_of

import apt_evap as ae
from apt_evap.maps.folded_map import FoldedMap

HERE = Path(__file__).parent
SOURCES = {
    "W": "hit list of tungsten, calibration data of APyT (AGPL-3.0-or-later), W3+ from 59 to 63.4 Da",
    "Ni": "map of nickel of a third party; its owner does not allow redistribution of the map",
    "Al": "map of aluminium, from a figure of PyCCAPT (GPL-3.0)",
}


def measured_fold(name):
    """Folded measured map of measured.npz."""
    with np.load(HERE / "measured.npz") as file:
        density, step = file[f"{name}_density"].astype(float), float(file[f"{name}_step"])
        numbers = [float(file[f"{name}_{key}"]) for key in ("smoothing", "ions", "halves")]
        symmetry = str(file[f"{name}_symmetry"])
    angles = (np.arange(len(density)) - (len(density) - 1) / 2) * step
    return FoldedMap(density, angles, symmetry, *numbers)


def tungsten(path):
    """The ions of W3+: the straight flight of 305 mm gives their masses."""
    ions = ae.read(path)
    length = np.hypot(305.0, np.hypot(ions.x, ions.y)) * ae.units.NM_PER_MM
    time = ions.time_of_flight - 38.5  # ns, as in charge_states.py
    ratio = ions.voltage * (ae.units.SPEED * time / length) ** 2
    chosen = (ratio > 59.0) & (ratio < 63.4)
    print(f"{np.count_nonzero(chosen)} ions of W3+")
    return ions[chosen]


def main():
    """Write measured.npz."""
    arrays = {}
    for name, path in zip(SOURCES, sys.argv[1:], strict=True):
        fold = folded(*measured_of(name, tungsten(path) if name == "W" else path), METALS[name])
        arrays |= {
            f"{name}_density": fold.density.astype(np.float16),
            f"{name}_step": np.diff(fold.angles).mean(),
            f"{name}_symmetry": fold.symmetry,
            f"{name}_source": SOURCES[name],
            **{f"{name}_{key}": getattr(fold, key) for key in ("smoothing", "ions", "halves")},
        }
        print(name, fold.density.shape, fold.angles[[0, -1]])
    np.savez_compressed(HERE / "measured.npz", **arrays)


if __name__ == "__main__":
    main()
