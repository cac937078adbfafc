"""Compression and radius from the poles of a crystal and the spacing of their planes."""

import math
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.fit import crystal_constants
from apt_evap.fit.crystal_constants import PoleSpacing

COMPRESSION, FACTOR, FIELD = 1.05, 3.0, 19.0
ALUMINIUM = ae.Orientation("Al", (0, 1, 2), 20.0)


@cache
def crystal(radius=10.0, depth=1.2, rim=25.0):
    """Hits of a perfect crystal that a sphere of constant radius crosses, and their directions in the crystal."""
    n = math.ceil((radius + 1) / ALUMINIUM.material.a)
    cells = np.stack(np.meshgrid(*[np.arange(-n, n)] * 3), axis=-1).reshape(-1, 3)
    inside = np.abs(np.linalg.norm(cells, axis=1) * ALUMINIUM.material.a - radius + depth / 2) < depth / 2 + 1
    cells = cells[inside & (cells @ ALUMINIUM.matrix[2] > 0)]
    basis = np.array([(0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 0)]) / 2
    sites = ALUMINIUM.material.a * (cells[:, None] + basis + 0.137).reshape(-1, 3) @ ALUMINIUM.matrix.T
    across = np.hypot(*sites[:, :2].T)
    angle = np.arcsin(np.minimum(across / radius, 1)) / COMPRESSION
    apex = radius * np.cos(COMPRESSION * angle) - sites[:, 2]  # depth of the apex when the sphere reaches the atom
    order = np.argsort(apex)
    order = order[(apex > 0)[order] & (apex < depth)[order] & (angle < math.radians(rim))[order]]
    x, y = (100 * np.tan(angle) / across * sites[:, :2].T)[:, order]
    directions = np.column_stack([sites[:, :2] / radius, np.cos(COMPRESSION * angle)])[order] @ ALUMINIUM.matrix
    hits = ae.Hits(x=x, y=y, voltage=np.full(len(x), FACTOR * FIELD * radius))
    return hits, directions, {"element": "Al", "distance": 100.0, "detector_radius": 100 * math.tan(math.radians(rim))}


@pytest.mark.parametrize(
    ("name", "right", "given"),
    [
        ("radius", 10.0, {"radius": 9.0}),
        ("field_factor", FACTOR, {"evaporation_field": FIELD}),
        ("initial_radius", 10.0, {"radius": "shank", "initial_radius": 11.0, "shank_angle": 0.0}),
    ],
)
def test_the_radius_is_that_with_the_right_spacings(monkeypatch, name, right, given):
    hits, _, known = crystal()
    monkeypatch.setattr(crystal_constants, "_WIDEST", 0.0)
    monkeypatch.setattr(crystal_constants, "_FAMILIES", 3)
    find = crystal_constants.find_planes
    monkeypatch.setattr(
        crystal_constants, "find_planes", lambda *a, scattered=1, **more: find(*a, scattered=scattered and 1, **more)
    )
    known = known | given | {"orientation": ALUMINIUM, "compression": COMPRESSION, "efficiency_error": 0.06}
    found = ae.fit.constants_of_crystal(hits, **known)
    assert found.constants == {
        "compression": COMPRESSION,
        "projection": "compressed",
        name: pytest.approx(right, rel=0.004),
    }
    assert [(one.pole, one.is_used) for one in found.poles] == [((0, 2, 2), True)]
    assert found.poles[0].ratio == pytest.approx(1.0, abs=1.1 * 2 * crystal_constants._SETTLED)
    # the radius follows compression and efficiency, and has the error of the spacings
    rim = COMPRESSION * math.radians(25)
    covariance = found.covariance
    assert covariance[0, 1] == pytest.approx(-(0.035**2) * rim / math.tan(rim)) and covariance[1, 2] == pytest.approx(
        -0.0018
    )
    assert covariance[1, 1] == pytest.approx(
        0.035**2 * (rim / math.tan(rim)) ** 2 + 0.03**2 + 0.015**2 + 0.01**2, rel=0.02
    )
    assert f"compression 1.050 ± 3.5%, {name.replace('_', ' ')} {found.constants[name]:.4g} ± 4.8%" in str(found)


def spacings(*ratios, error=0.002):
    """Spacings at poles, of planes that are found if the ratio is positive."""
    return [
        PoleSpacing((0, 0, k), abs(one), error, SimpleNamespace(found=one > 0), False) for k, one in enumerate(ratios)
    ]


@pytest.mark.parametrize(
    ("ratios", "used", "sentence"),
    [
        ((1.02, 1.02, 1.3), [True, True, False], ""),
        ((1.0, -0.98, 1.0), [True, False, True], ""),
        ((0.41, 1.0), None, "planes must agree at most poles, got spacings of planes over the true ones: 000 0.410 ± "
         r"0.002 \(not used\), 001 1.000 ± 0.002; the orientation is given"),
        ((-1.0, -0.9), None, "hits must have lattice planes at a pole, got spacings .* 000 none, 001 none; the orient"),
        ((), None, "hits must have lattice planes at a pole, got no pole with 50 ions in view"),
    ],
)  # fmt: skip
def test_poles_must_agree(monkeypatch, ratios, used, sentence):
    hits, _, known = crystal()
    monkeypatch.setattr(crystal_constants, "_spacings", lambda *_, **__: spacings(*ratios))
    known = known | {"orientation": ALUMINIUM, "compression": COMPRESSION, "radius": 10.0}
    if sentence:
        with pytest.raises(ValueError, match=sentence):
            ae.fit.constants_of_crystal(hits, **known)
        return
    found = ae.fit.constants_of_crystal(hits, **known)
    assert [one.is_used for one in found.poles] == used
    assert found.constants["radius"] == pytest.approx(10 * ratios[0] ** (6 / 2))  # they are the same after each of six


def test_spacings_that_are_right_on_the_cap_are_not_settled_on_the_surface(monkeypatch):
    hits, _, known = crystal()
    ratios, shapes, plain = iter((1.0, 1.2, 1.0, 1.0)), [], crystal_constants.reconstruct
    monkeypatch.setattr(crystal_constants, "_spacings", lambda *_, **__: spacings(next(ratios)))

    def on_the_cap(hits, known, **how):
        shapes.append(how.get("shape"))
        return plain(hits, known)

    monkeypatch.setattr(crystal_constants, "reconstruct", on_the_cap)
    known = known | {"orientation": ALUMINIUM, "compression": COMPRESSION, "shape": "evolving"}
    found = ae.fit.constants_of_crystal(hits, radius=10.0, **known)
    assert shapes == [None, "evolving", "evolving", "evolving"]
    assert found.constants["radius"] == pytest.approx(10 * math.sqrt(1.2)) and found.covariance[1, 1] < 0.06**2


def test_without_a_map_that_decides_one_pole_is_not_enough(monkeypatch):
    hits, _, known = crystal()
    # the ions have their centre 10 degrees from that of the detector, in x
    away = np.array([-math.sin(math.radians(10)), 0.0, math.cos(math.radians(10))])
    projection = SimpleNamespace(scale=80.0, directions=lambda places: np.tile(away, (len(places), 1)))
    best = SimpleNamespace(orientation=ALUMINIUM, projection=projection, rim_change=0.25)
    told = SimpleNamespace(best=best, decided=False, verdict="undecided", reason="two are as good")
    asked = {}
    monkeypatch.setattr(
        crystal_constants, "index", lambda hits, material, **more: asked.update(more, hits=hits) or told
    )
    used = []
    monkeypatch.setattr(crystal_constants, "_spacings", lambda *given, **__: used.append(given[1]) or spacings(1.0))
    with pytest.raises(ValueError, match=r"planes must agree .*; undecided: two are as good"):
        ae.fit.constants_of_crystal(hits, radius=10.0, **known)
    np.testing.assert_allclose(used[0].matrix @ ALUMINIUM.matrix.T @ away, [0, 0, 1], atol=1e-12)
    told.decided = True
    found = ae.fit.constants_of_crystal(hits, radius=10.0, compressions=(1.0, 1.25), **known)
    assert found.constants["compression"] == 1.0 and found.indexing is told  # 80 mm/rad, a quarter more at the rim
    assert asked["scales"] == (80.0, 100.0)
    assert found.covariance[0, 0] == pytest.approx(0.17**2)  # its rim is 25 degrees from the axis
    sure = ae.fit.constants_of_crystal(hits, radius=10.0, compression_error=0.01, **known)
    assert sure.covariance[0, 0] == pytest.approx(0.01**2)
    with pytest.raises(ValueError, match=r"compression_error must be .* < 0\.5"):
        ae.fit.constants_of_crystal(hits, radius=10.0, compression_error=0.5, **known)
    assert np.hypot(asked["hits"].x, asked["hits"].y).max() == pytest.approx(100 * math.radians(25), rel=0.01)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"orientation": ALUMINIUM}, "compression must be given with an orientation, got none"),
        ({"orientation": ALUMINIUM, "compression": 1.0, "element": "Ni"}, "orientation must be of Ni, .* got Al"),
        ({"orientation": "Al", "compression": 1.0}, "orientation must be an Orientation, got 'Al'"),
        ({"projection": "bas"}, "projection must be left out: a compression is found, got 'bas'"),
        ({"compressions": (1.25, 1.0)}, "compressions must be two numbers > 0, the smaller one first"),
    ],
)
def test_what_contradicts_the_search_is_one_sentence(changes, sentence):
    hits, _, known = crystal()
    with pytest.raises((ValueError, TypeError), match=sentence):
        ae.fit.constants_of_crystal(hits, **{**known, "radius": 10.0, **changes})


@pytest.mark.slow
def test_the_map_and_the_planes_of_a_crystal_with_poles():
    hits, directions, known = crystal(16.0, 2.5, 30.0)
    (density,) = ae.maps.master_patterns("fcc")[0].at(directions, sigma=0.7)[:1]
    kept = np.random.default_rng(1).random(len(hits)) < 0.5 * density
    found = ae.fit.constants_of_crystal(hits[kept], efficiency=kept.mean(), radius=13.0, **known)
    errors = np.sqrt(np.diag(found.covariance))
    assert found.indexing.decided and sum(one.is_used for one in found.poles) >= 3
    assert abs(found.constants["compression"] / COMPRESSION - 1) < 2 * errors[0]
    assert abs(found.constants["radius"] / 16.0 - 1) < 2 * errors[1]
    product = found.constants["radius"] * found.constants["compression"]
    assert product == pytest.approx(16.0 * COMPRESSION, rel=0.02)
    shuffled = hits[np.random.default_rng(2).permutation(len(hits))]
    with pytest.raises(ValueError, match=r"lattice planes at a pole|planes must agree"):
        ae.fit.constants_of_crystal(
            shuffled, efficiency=1.0, radius=16.0, orientation=ALUMINIUM, compression=COMPRESSION, **known
        )
