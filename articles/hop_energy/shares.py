"""Shares of the atoms that roll by the energies of `hops.py`, for every choice, with the sensitivity.

python shares.py RUNS
"""

import argparse
from pathlib import Path

import numpy as np
from hops import AXES

import apt_evap as ae
from apt_evap.specimen.lattice import COORDINATION

BARRIER = 28.0  # over kT
# 1 - (1 + (sqrt(n + 1) - sqrt(n)))/sqrt(z): an atom with one bond to an atom with n = 9 (fcc {111}) or 6 (bcc {110})
LOST_BY_ROOTS = {"fcc": 0.664, "hcp": 0.664, "bcc": 0.577}
SENSITIVITY = 1.0  # eV, C of the linear barrier


def of_file(path):
    """Hops of one metal and radius."""
    with np.load(path) as file:
        return dict(file)


class Choice:
    """What is compared: place, bonds, field and temperature.

    Parameters
    ----------
    place : str
        "above" the strongest neighbour, or the "hollow" next to it with the most bonds.
    bonds : str
        "place": the bonds of that place; "half": half of E_coh; "roots": one bond above, energies in proportion to the
        root of the number of bonds of an atom.
    field : str
        "cap": the mean of the cap is the field of evaporation; "site": that at the atom; or a number, site over F_evap.
    warm : bool
        Whether atoms leave at F(T) instead of F_evap.
    """

    def __init__(self, place, bonds, field, warm):
        self.place, self.bonds, self.field, self.warm = place, bonds, field, warm

    def gains(self, metal, hops, temperature=80.0, factor=1.0):
        """Gain G of each hop [eV]."""
        kt = ae.units.BOLTZMANN * temperature
        field = factor * ae.material(metal).evaporation_field
        if self.warm:
            field *= max(1.0 - BARRIER * kt / SENSITIVITY, 0.0)
        reference = hops["field"] if self.field != "cap" else np.full(len(hops["field"]), float(hops["cap_field"]))
        ratio = float(self.field) if isinstance(self.field, float) else 1.0
        return (ratio * field / reference) ** 2 * (hops[f"{self.place}_energy"] - hops["site_energy"])

    def costs(self, metal, hops, temperature=80.0, cohesion=1.0):
        """Cost of the bonds less the barrier of evaporation [eV]."""
        material = ae.material(metal)
        kink = COORDINATION[material.structure][0] / 2
        if self.bonds == "place":
            lost = (hops["bonds"] - hops[f"{self.place}_bonds"]) / kink
        else:
            lost = 0.5 if self.bonds == "half" else LOST_BY_ROOTS[material.structure]
        return cohesion * material.cohesive_energy * lost - BARRIER * ae.units.BOLTZMANN * temperature

    def share(self, metal, hops, temperature=80.0, factor=1.0, cohesion=1.0):
        """Part of the atoms that roll."""
        gains = self.gains(metal, hops, temperature, factor)
        known = np.isfinite(gains)
        costs = np.broadcast_to(self.costs(metal, hops, temperature, cohesion), gains.shape)
        return float(np.mean(known & (np.where(known, gains, -np.inf) > costs)))


DECIDED = Choice("above", "place", "cap", True)
CHOICES = {
    "**above, cap, F(T)**": DECIDED,
    "above, cap, F_evap": Choice("above", "place", "cap", False),
    "above, bonds by roots, cap, F_evap": Choice("above", "roots", "cap", False),
    "above, bonds by roots, cap, F(T)": Choice("above", "roots", "cap", True),
    "above, site, F(T)": Choice("above", "place", "site", True),
    "above, site, F_evap": Choice("above", "place", "site", False),
    "hollow, cap, F(T)": Choice("hollow", "place", "cap", True),
    "hollow, cap, F_evap": Choice("hollow", "place", "cap", False),
    "hollow, site, F_evap": Choice("hollow", "place", "site", False),
    "hollow, half, cap, F_evap": Choice("hollow", "half", "cap", False),
    "charge above, half, cap, F_evap": Choice("above", "half", "cap", False),
    "charge above, half, cap, F(T)": Choice("above", "half", "cap", True),
    "charge above, half, site, F_evap": Choice("above", "half", "site", False),
    "charge above, half, site 1.28, F_evap": Choice("above", "half", 1.28, False),
}


def form(metal, hops):
    """Gain as alpha F^2 (phi^2 - 1)/2, F at the site: alpha, its spread, phi over the charge ratio, self terms."""
    gains, field = hops["above_energy"] - hops["site_energy"], hops["field"]
    phi = hops["above_charge"] / hops["site_charge"]
    unit = 1e-18 * ae.units.ELEMENTARY_CHARGE  # e nm^2/V to F m^2
    alpha = 2.0 * gains / (field**2 * (phi**2 - 1.0)) * unit
    slope, start = np.polyfit(hops["ratio"], phi, 1)
    ratio = hops["above_energy"] / hops["above_charge"] ** 2 / (hops["site_energy"] / hops["site_charge"] ** 2)
    cube = ae.material(metal).nearest_neighbour_distance ** 3 / ae.units.COULOMB  # F^2 d^3/k_e is an energy
    parts = (
        f"alpha {np.median(alpha):.3g} F m^2 (spread {alpha.std() / alpha.mean():.3f})",
        f"over 4 pi epsilon_0 d^3 {np.median(alpha) / unit / cube:.4f}",
        f"phi {start:.2f} + {slope:.2f} x",
        f"self terms {np.median(ratio):.3f}",
        f"G over F^2 d^3/k_e {np.median(gains / field**2) / cube:.3f}",
    )
    return ", ".join(parts)


def row(name, cells):
    """Print a row."""
    print("| " + " | ".join([name, *cells]) + " |")


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    options = parser.parse_args()
    paths = {m: {int(p.name.split("_")[1]): p for p in options.runs.glob(f"{m}_*_hops.npz")} for m in AXES}
    files = {m: {r: of_file(p) for r, p in sorted(of.items()) if r >= 20} for m, of in paths.items()}
    files = {m: of for m, of in files.items() if of}
    print("hops, site over cap, bonds of the atom, gain of the place above (10, 50, 90 %, cap, F_evap) [eV]")
    plain = CHOICES["above, cap, F_evap"]
    for metal, of in files.items():
        for radius, hops in of.items():
            gains = plain.gains(metal, hops)
            x = hops["ratio"]
            slope, start = np.polyfit(x, gains, 1)
            print(metal, radius, len(x), (hops["field"].mean() / hops["cap_field"]).round(3),
                  np.bincount(hops["bonds"]).tolist(), np.percentile(gains, [10, 50, 90]).round(2),
                  f"G = {start:.2f} + {slope:.2f} x, correlation {np.corrcoef(x, gains)[0, 1]:.2f}",
                  "solved over event", np.mean(hops["site_charge"] / hops["event_charge"]).round(4),
                  "hollow bonds", np.bincount(hops["hollow_bonds"]).tolist(),
                  "hollow gain", np.nanmedian(Choice("hollow", "half", "cap", False).gains(metal, hops)).round(2),
                  "half E_coh", ae.material(metal).cohesive_energy / 2)  # fmt: skip
            print("   ", form(metal, hops))
    names = list(files)
    row("shares at 80 K", [f"{m} {'/'.join(str(r) for r in files[m])}" for m in names])
    for name, choice in CHOICES.items():
        row(name, [" ".join(f"{choice.share(m, h):.2f}" for h in files[m].values()) for m in names])
    for name, choice in CHOICES.items():
        print(f"\nsensitivity, {name}, largest radius")
        row("", names)
        last = {m: h[max(h)] for m, h in files.items()}
        for factor in (0.9, 0.95, 1.05, 1.1):
            row(f"field {factor - 1:+.0%}", [f"{choice.share(m, last[m], factor=factor):.2f}" for m in names])
        for factor in (0.8, 1.2):
            row(f"E_coh {factor - 1:+.0%}", [f"{choice.share(m, last[m], cohesion=factor):.2f}" for m in names])
        for temperature in (20, 60, 80, 150, 300):
            row(f"{temperature} K", [f"{choice.share(m, last[m], temperature):.2f}" for m in names])


if __name__ == "__main__":
    main()
