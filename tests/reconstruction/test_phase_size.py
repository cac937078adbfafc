"""The size of a phase that a reconstruction has found."""

import numpy as np
import pytest
from fluxes import even_flux

import apt_evap as ae

KNOWN = {"atomic_volume": 0.0166, "efficiency": 0.5, "distance": 100.0, "projection": "compressed", "compression": 1.0}
EXACT = dict.fromkeys(("compression", "radius", "efficiency"), 0.0)


def test_a_ball_has_its_size_and_the_constants_its_errors():
    n = 10_000
    directions = even_flux(n, 0.54)
    voltage = 3000.0 + 10 * np.sin(np.arange(n) / 300)
    hits = ae.Hits(
        x=100 * directions[:, 0] / directions[:, 2], y=100 * directions[:, 1] / directions[:, 2], voltage=voltage
    )
    places = ae.reconstruct(hits, radius=13.0, **KNOWN).positions
    ball = np.linalg.norm(places - (1.0, 0.0, 2.4), axis=1) < 1.2
    found = ae.reconstruct(hits, shape="evolving", radius=13.0, labels=ball.astype(int), **KNOWN)
    (size,) = ae.reconstruction.phase_sizes(found, EXACT, local=(0.0, 0.0))
    assert size.ions == ball.sum()
    variances = found.positions[ball].var(axis=0)
    assert size.lateral == pytest.approx(np.sqrt(5 * variances[:2].mean()), rel=0.02)
    assert size.depth == pytest.approx(np.sqrt(5 * variances[2]), rel=0.02)
    assert size.lateral_error == pytest.approx(size.lateral / np.sqrt(2 * ball.sum()), rel=0.1)
    # what the recession is not sure about: depths that may be larger by a tenth
    tenth = found.positions[:, 2:] * (0.0, 0.0, -0.1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(found), "recession_changes", lambda self: [tenth])
        (unsure,) = ae.reconstruction.phase_sizes(found, EXACT, local=(0.0, 0.0))
    change = np.sqrt(unsure.depth_error**2 - size.depth_error**2)
    assert change == pytest.approx(0.1 * size.depth, rel=0.01) and unsure.depth == size.depth
    # 10 % more efficiency: a tenth less of depth, and the same width
    (deeper,) = ae.reconstruction.phase_sizes(found, EXACT | {"efficiency": 0.1}, local=(0.0, 0.0))
    change = np.sqrt(deeper.depth_error**2 - size.depth_error**2)
    assert change == pytest.approx(size.depth * (1 - 1 / 1.1), rel=0.15)
    assert deeper.lateral_error < 1.5 * size.lateral_error
    # the scatter of the ions is taken off, and half of that is an error
    (narrower,) = ae.reconstruction.phase_sizes(found, EXACT, local=(0.1, 0.1))
    assert narrower.lateral == pytest.approx(np.sqrt(size.lateral**2 - 5 * 0.01), rel=1e-6)
    assert "± " in str(narrower) and "nm across" in str(narrower)
    with pytest.raises(ValueError, match="must have a surface that was followed, got 'cap: 50 ions"):
        ae.reconstruction.phase_sizes(ae.reconstruct(hits[:50], shape="evolving", radius=13.0, **KNOWN))
