"""What 10 % of a constant change in a reconstruction, where closed forms say it."""

import numpy as np
import pytest

import apt_evap as ae

KNOWN = {"atomic_volume": 0.0166, "distance": 90.0}


def ions(n=3000):
    rng = np.random.default_rng(1)
    rho, azimuth = 20 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)  # mm
    return ae.Hits(x=rho * np.cos(azimuth), y=rho * np.sin(azimuth), voltage=np.full(n, 5000.0))


def test_efficiency_changes_the_depth_alone_and_is_assumed_beyond_one():
    result = ae.reconstruct(ions(), radius=30.0, **KNOWN)
    (found,) = ae.reconstruction.assumptions(result, ["efficiency"])
    assert found.value == 1.0
    assert found.width == pytest.approx((0, 0), abs=1e-12)
    assert found.depth == pytest.approx((1 / 0.9 - 1, 1 / 1.1 - 1), rel=1e-6)
    assert found.density == pytest.approx((-0.1, 0.1), rel=1e-6)


def test_field_factor_changes_the_radius():
    result = ae.reconstruct(ions(), evaporation_field=19.0, **KNOWN)
    (found,) = ae.reconstruction.assumptions(result, ["field_factor"])
    # R is 1 / k_f, the depth 1 / R^2
    assert found.width == pytest.approx((1 / 0.9 - 1, 1 / 1.1 - 1), rel=1e-6)
    assert found.depth == pytest.approx((0.9**2 - 1, 1.1**2 - 1), rel=1e-6)
    assert "field factor 3.3 (of the literature" in str(found)


def test_constants_that_it_does_not_have_are_left_out_and_unknown_ones_are_errors():
    result = ae.reconstruct(ions(), radius=30.0, **KNOWN)
    assert [one.name for one in ae.reconstruction.assumptions(result, ["field_factor", "compression"])] == [
        "compression"
    ]
    with pytest.raises(ValueError, match="names must be one of"):
        ae.reconstruction.assumptions(result, ["colour"])


def test_a_compression_at_which_ions_leave_the_cap_is_nan():
    result = ae.reconstruct(ions(), radius=30.0, projection="compressed", compression=7.0, **KNOWN)
    (found,) = ae.reconstruction.assumptions(result, ["compression"])
    assert np.isfinite(found.width[0]) and np.isnan(found.width[1])
    assert "none" in str(found)
