"""The rule of a run behind a lens, against flights through the charges of atoms and rings."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).parents[2] / "articles" / "microscope" / "flights.py"


@pytest.mark.slow
def test_flights_through_atoms_and_rings():
    """R = 8 a, where the rule is worst; the article has R = 20 a and 40 a."""
    spec = importlib.util.spec_from_file_location("flights", SCRIPT)
    flights = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(flights)
    seen, times, places, true_times, _ = flights.compare(radius=8.0, ions=30, events=600)
    lengths = np.linalg.norm(seen, axis=1)
    found = seen * (np.tan(2 * np.arctan(lengths)) / lengths)[:, None]
    distance = np.linalg.norm(places, axis=1)
    outer = np.degrees(np.arctan(distance)) > 3
    shares = (np.linalg.norm(found - places, axis=1) / distance)[outer]
    assert len(shares) > 20
    # measured: 0.3 % RMS and 0.7 %; 1.4 % RMS if the ions start on the smooth cap, 46 % without the lens
    assert np.sqrt(np.mean(shares**2)) < 0.006 and shares.max() < 0.01
    # measured: 0.15 % RMS; a volt of 150 is 0.3 %
    assert np.sqrt(np.mean((times / true_times - 1) ** 2)) < 0.0025
