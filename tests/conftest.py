"""Small specimens, made once for all tests."""

import signal
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))  # for twins.py, whatever the import mode

import apt_evap as ae

# a shell that has put the tests into the background lets them ignore Ctrl-C, which some of them press
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def nickel():
    return ae.material("Ni")


@pytest.fixture(scope="session")
def small_tip(nickel):
    """Ni[111], R = 6 a: 10,000 atoms, 2,100 at the surface."""
    return ae.Tip(nickel, apex_radius=6 * nickel.a, axis=(1, 1, 1), shank_length=6 * nickel.a)


@pytest.fixture(scope="session")
def tip12(nickel):
    """Ni[111], R = 12 a, of a random origin: no two charges are equal."""
    return ae.Tip(nickel, apex_radius=12 * nickel.a, axis=(1, 1, 1), shank_length=12 * nickel.a, offset_seed=3)


@pytest.fixture(scope="session")
def surface12(tip12):
    """Positions, normals and charges of the surface atoms of `tip12`, solved to 1e-8."""
    emitter = ae.Emitter(tip12, 1000.0)
    return emitter.positions, emitter.normals, emitter.charges


@pytest.fixture(scope="session")
def tip20(nickel):
    """Ni[111], R = 20 a, centred on an atom: as symmetric as the crystal."""
    return ae.Tip(nickel, apex_radius=20 * nickel.a, axis=(1, 1, 1), shank_angle=1.5, shank_length=20 * nickel.a)


@pytest.fixture(scope="session")
def run20(tip20):
    """15,000 ions of `tip20`, each flown at rest and rolled up (some 10 s)."""
    simulation = ae.Simulation(tip20, voltage=1000.0, seed=1, detector=ae.Detector(distance=100.0, width=300.0))
    flown = (ae.Unperturbed(), ae.RollUp(ae.TruncatedNormal(0.155, 0.155)))
    return simulation.run(15_000, flown, responses=False, progress=False)


@pytest.fixture
def rng():
    return np.random.default_rng(20260)
