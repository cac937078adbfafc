"""Rings about a pole: known contrasts are found, noise and gradients are not."""

from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae

PLANE = ae.detection.Projection(100.0, compression=1.0)
POLE = np.array([0.3, -0.1, 1.0])


def hits_of(directions):
    return ae.Hits(**dict(zip("xy", PLANE.places(directions).T, strict=True)))


def about(pole, angle, azimuth):
    """Directions at an angle and an azimuth [rad] about a pole, counted as by the statistic."""
    pole = pole / np.linalg.norm(pole)
    first = np.eye(3)[np.abs(pole).argmin()]
    first = first - pole * (first @ pole)
    first /= np.linalg.norm(first)
    second = np.cross(pole, first)
    return np.cos(angle)[:, None] * pole + np.sin(angle)[:, None] * (
        np.cos(azimuth)[:, None] * first + np.sin(azimuth)[:, None] * second
    )


def simulated(rng, n, amplitude, fold=3, gradient=0.0, pole=POLE):
    """Directions of uniform density times 1 + a cos(fold azimuth) within 30 degrees, and a gradient."""
    angle = np.arccos(rng.uniform(np.cos(np.radians(30)), 1, 3 * n))
    azimuth = rng.uniform(0, 2 * np.pi, 3 * n)
    density = (1 + amplitude * np.cos(fold * azimuth)) * (1 + gradient * np.cos(azimuth - 0.3))
    keep = rng.uniform(0, (1 + abs(amplitude)) * (1 + gradient), 3 * n) < density
    return about(pole, angle[keep][:n], azimuth[keep][:n])


def counted(directions, bins=300):
    return hits_of(directions).map(like=ae.Detector(width=220.0).grid(bins), position_step=None)


@pytest.mark.parametrize("gradient", [0.0, 0.5])
def test_the_contrast_of_a_cosine_is_found(rng, gradient):
    map = counted(simulated(rng, 300_000, 0.4, gradient=gradient))
    for ring in ae.maps.ring_statistics(map, PLANE, POLE, fold=3):
        # a / sqrt(2), less 1 % by the width of a sector; a product with a gradient adds cos(2 a), cos(4 a): 0.1 a
        expected = 0.4 / np.sqrt(2)
        assert ring.contrast == pytest.approx(expected, abs=3 * ring.error + 0.012 + 0.1 * 0.4 * gradient)
        assert ring.error < 0.02
        assert ring.minimum == pytest.approx(0.6, abs=0.1) and ring.maximum == pytest.approx(1.4, abs=0.1)


@pytest.mark.parametrize("maps", [6, pytest.param(20, marks=pytest.mark.slow)])
def test_noise_is_no_contrast(rng, maps):
    """Maps without lines: the contrast is 0 within its error, where the uncorrected one is 0.14."""
    found, raw = [], []
    for _ in range(maps):
        (ring,) = ae.maps.ring_statistics(counted(simulated(rng, 30_000, 0.0)), PLANE, POLE, [(9, 14)], fold=3)
        found.append(ring.contrast)
        raw.append(np.std(ring.profile))
    n = ring.ions / 24
    assert np.mean(raw) == pytest.approx(np.sqrt(1 / n), rel=0.15)  # of 24 values each
    assert np.mean(np.square(found)) < 0.5 / n  # half of the squared noise, as negative variances count as 0


@pytest.mark.slow
def test_the_error_is_that_of_new_counts(rng):
    rings = [
        ae.maps.ring_statistics(counted(simulated(rng, 40_000, 0.5)), PLANE, POLE, [(9, 20)], fold=3)[0]
        for _ in range(25)
    ]
    scatter = np.std([ring.contrast for ring in rings], ddof=1)
    assert np.mean([ring.error for ring in rings]) == pytest.approx(scatter, rel=0.5)  # 25 values: 14 %


@pytest.mark.slow
def test_the_error_is_that_of_resamples_whose_contrast_has_the_noise_twice(rng):
    """The same with a map for each resample, where the contrast is as small as the noise."""
    edges = np.linspace(-30, 30, 61)
    x, y = np.meshgrid(*[(edges[1:] + edges[:-1]) / 2] * 2)

    def ring_of(counts):
        map = ae.DetectorMap.from_array(counts, edges, edges, is_counts=True)
        return ae.maps.ring_statistics(map, PLANE, rings=[(6, 15)], fold=3)[0]

    measured = rng.poisson(3 * (1 + 0.12 * np.cos(3 * np.arctan2(y, x))))
    ring = ring_of(measured)
    noise = np.var(ring.profile) - ring.contrast**2
    assert 1 < ring.contrast**2 / noise < 3
    once = np.array([ring_of(rng.poisson(measured)).contrast for _ in range(200)])
    scatter = np.std(np.sqrt(np.maximum(once**2 - noise, 0)))
    assert ring.error == pytest.approx(scatter, rel=0.15)  # 200 resamples twice: 7 %; with the noise once 0.77 of it


def test_densities_have_the_noise_of_their_hits(rng):
    """A map of counts in another unit: the same profile to rounding, and the same noise as far as it can be told."""
    map = counted(simulated(rng, 200_000, 0.3))
    density = ae.DetectorMap.from_array(map.values * 0.37, map.x_edges, map.y_edges)
    one, told, without, two = (
        ae.maps.ring_statistics(each, PLANE, POLE, [(5, 14)], fold=3, ions=ions)[0]
        for each, ions in ((map, None), (density, map.ions), (density, np.inf), (density, None))
    )
    assert told.profile == pytest.approx(one.profile, rel=1e-12)
    assert (told.contrast, told.error, told.ions) == pytest.approx((one.contrast, one.error, one.ions), rel=1e-9)
    assert told.profile_error == pytest.approx(one.profile_error, rel=1e-9)
    assert np.isnan(without.error) and np.isnan(without.ions) and np.isnan(without.profile_error).all()
    assert without.contrast == pytest.approx(np.std(one.profile), rel=1e-12)
    # an error of 2 % of the number of hits, and as much for lines within three bins
    assert two.ions == pytest.approx(one.ions, rel=0.05)


@pytest.mark.slow
def test_errors_of_a_profile_are_those_of_new_counts(rng):
    """40 maps: the scatter of each of 24 values, and of the extremes about their mean."""
    rings = [
        ae.maps.ring_statistics(counted(simulated(rng, 40_000, 0.5)), PLANE, POLE, [(9, 20)], fold=3)[0]
        for _ in range(40)
    ]
    scatter = np.std([ring.profile for ring in rings], axis=0, ddof=1)
    told = np.mean([ring.profile_error for ring in rings], axis=0)
    # 24 standard deviations of 40 values: 2.3 %, three times; the harmonic and the mean take 5 of 72 freedoms
    assert np.sqrt(np.mean(scatter**2) / np.mean(told**2)) == pytest.approx(1, abs=0.1)
    assert rings[0].minimum_error == rings[0].profile_error[np.argmin(rings[0].profile)]
    assert rings[0].maximum_error == rings[0].profile_error[np.argmax(rings[0].profile)]


def test_symmetric_sectors_are_averaged(rng):
    """A line in one of three symmetric places keeps a third of its height."""
    directions = np.concatenate(
        [simulated(rng, 200_000, 0.0), about(POLE, np.radians(rng.uniform(9, 14, 3000)), np.full(3000, 2.6))]
    )
    once, thrice = (
        ae.maps.ring_statistics(counted(directions), PLANE, POLE, [(9, 14)], fold=fold)[0] for fold in (1, 3)
    )
    assert len(once.profile) == 72 and len(thrice.profile) == 24
    assert thrice.maximum - 1 == pytest.approx((once.maximum - 1) / 3, rel=0.25)


def test_the_density_about_a_pole(rng):
    """Twice the density within 3 degrees."""
    inside = about(POLE, np.arccos(rng.uniform(np.cos(np.radians(3)), 1, 4000)), rng.uniform(0, 2 * np.pi, 4000))
    area = 1 - np.cos(np.radians([3, 30]))
    uniform = simulated(rng, int(4000 * area[1] / area[0]), 0.0)
    map = counted(np.concatenate([uniform, inside]), bins=500)
    found = ae.maps.pole_profile(map, PLANE, POLE, (0, 2, 3.5, 6)).density
    mean = 1 + area[0] / (1 - np.cos(np.radians(16)))
    assert found[0] == pytest.approx(2 / mean, rel=0.06)  # 1,800 ions: 2.4 %
    assert found[2] == pytest.approx(1 / mean, rel=0.06)
    assert 1 / mean < found[1] < 2 / mean


def test_rings_off_the_map_are_refused(rng):
    map = counted(simulated(rng, 1000, 0.0))
    with pytest.raises(ValueError, match="70 to 80 degrees has too few bins"):
        ae.maps.ring_statistics(map, PLANE, POLE, [(70, 80)])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("fold", [1, 3])
def test_a_few_hits_have_errors_without_warnings(rng, fold):
    """Some resamples of a few hits have none at all."""
    map = counted(about(POLE, np.radians(rng.uniform(9, 14, 4)), rng.uniform(0, 2 * np.pi, 4)))
    (ring,) = ae.maps.ring_statistics(map, PLANE, POLE, [(9, 14)], fold=fold)
    assert ring.ions == 4 and ring.minimum == 0.0 and ring.error > 0


def test_the_amplitude_has_a_sign_and_is_linear(rng):
    """Lines of the same and of the other sign have the same contrast; half of each have none."""
    bright, dark = (
        ae.maps.ring_statistics(counted(simulated(rng, 400_000, a)), PLANE, POLE, [(9, 14)], fold=3)[0]
        for a in (0.4, -0.4)
    )
    assert bright.contrast == pytest.approx(dark.contrast, abs=3 * np.hypot(bright.error, dark.error))
    same, other = ae.maps.line_amplitude(bright, bright), ae.maps.line_amplitude(dark, bright)
    # of itself 1 plus the noise over the squared contrast: 0.006
    assert same.value == pytest.approx(1.0, abs=0.02)
    assert other.value == pytest.approx(-1.0, abs=4 * other.error) and 0 < other.error < 0.1
    both = np.concatenate([simulated(rng, 200_000, 0.4), simulated(rng, 200_000, -0.4)])
    mixed = ae.maps.line_amplitude(ae.maps.ring_statistics(counted(both), PLANE, POLE, [(9, 14)], fold=3)[0], bright)
    assert mixed.value == pytest.approx(0.0, abs=4 * mixed.error)
    # turned by half a period of the lines, the bright ones are dark
    half = len(bright.profile) // 2
    assert ae.maps.line_amplitude(bright, bright, shift=half).value == pytest.approx(-1.0, abs=4 * same.error)
    mirrored = replace(bright, profile=bright.profile[::-1], profile_error=bright.profile_error[::-1])
    assert ae.maps.line_amplitude(mirrored, bright, mirror=True) == same
    assert ae.maps.line_amplitude(mirrored, bright).value < same.value  # the noise of the sectors is not symmetric


def test_amplitudes_of_unequal_rings_are_refused(rng):
    map = counted(simulated(rng, 50_000, 0.4))
    (first,), (second,) = (ae.maps.ring_statistics(map, PLANE, POLE, [(9, 14)], fold=fold) for fold in (1, 3))
    with pytest.raises(ValueError, match="equal sectors, got 72 and 24"):
        ae.maps.line_amplitude(first, second)
