"""Pairs of ions of one pulse: against a loop, and lines of dissociation between their ends."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from made_spectra import made

import apt_evap as ae
from apt_evap.detection import dissociation_line
from apt_evap.spectra.dead_time import isotope_losses


def test_pairs_are_those_of_a_loop():
    rng = np.random.default_rng(1)
    pulse, mass = rng.integers(0, 60, 150), rng.uniform(1, 100, 150)
    pairs = ae.Hits(mass_to_charge=mass, pulse_id=pulse).correlation()
    expected = [
        (min(mass[i], mass[j]), max(mass[i], mass[j]))
        for i in range(150)
        for j in range(i + 1, 150)
        if pulse[i] == pulse[j]
    ]
    assert sorted(zip(pairs.first, pairs.second, strict=True)) == sorted(expected)
    counts, edges = pairs.histogram(50, (0, 100))
    assert counts.sum() == 2 * len(expected) and (counts == counts.T).all() and len(edges) == 51
    numbers = np.bincount(np.bincount(pulse))[1:]
    assert pairs.pulses.tolist() == numbers.tolist()
    assert pairs.multiple_part == pytest.approx(1 - numbers[0] / 150)


def test_too_many_pairs_are_counted_and_refused(monkeypatch):
    monkeypatch.setattr("apt_evap.detection.correlation._MOST_PAIRS", 6)
    ions = ae.Hits(mass_to_charge=np.arange(7.0) + 1, pulse_id=[0, 0, 0, 0, 1, 1, 2])
    assert len(ions[:4].correlation().first) == 6  # of four ions
    with pytest.raises(ValueError, match="at most 6 pairs, got 7: select fewer"):
        ions.correlation()


def test_the_error_of_a_loss_is_that_of_new_counts():
    """1,000 draws of a tenth of the major isotope lost among multiples: known to 2 %."""
    rng, minor = np.random.default_rng(3), np.array([1, 2])
    alone, together = [8000.0, 1000.0, 500.0], [720.0, 100.0, 50.0]
    counts = [(rng.poisson(alone).astype(float), rng.poisson(together).astype(float)) for _ in range(1000)]
    parts, errors = np.transpose([isotope_losses(0, minor, *both, both) for both in counts])
    assert parts.mean() == pytest.approx(0.1, abs=0.01)  # a ratio of counts has a bias
    assert errors.mean() == pytest.approx(parts.std(), rel=0.1)


def test_a_line_of_dissociation_goes_from_the_fragments_to_the_ion():
    """GaN2+ of 41.46 Da into Ga+ and N+; in the middle the m/n of the equation, by hand."""
    first, second = dissociation_line(41.46, 68.93, 14.0, 3)
    assert first == pytest.approx([68.93, 68.93 / (1 - 0.5 * (1 - 68.93 / 41.46)), 41.46])
    assert second == pytest.approx([14.0, 14.0 / (1 - 0.5 * (1 - 14.0 / 41.46)), 41.46])
    with pytest.raises(ValueError, match="parent must be"):
        dissociation_line(-1.0, 2.0, 3.0)


def test_a_correlation_is_drawn_with_the_ions_that_may_break():
    hits = made({("Ga", 1): 30, ("N", 1): 20, ("Ga", 2): 20, ("GaN", 2): 10}, 20_000)
    hits = ae.Hits(mass_to_charge=hits.mass_to_charge, pulse_id=np.arange(len(hits)) // 2)
    spectrum = ae.spectrum(hits)
    assert [name for name, _ in spectrum.dissociations()] == ["GaN²⁺ → Ga⁺ + N⁺"]
    ax = ae.plot.correlation(hits.correlation(), spectrum, dissociations=[(28.0, 14.0, 56.0)])
    assert len(ax.lines) == 4 and ax.get_xlim()[1] > 69
    plt.close(ax.figure)
    with pytest.raises(ValueError, match="needs pulses with two ions"):
        ae.plot.correlation(ae.Hits(mass_to_charge=[1.0, 2.0], pulse_id=[1, 2]).correlation())
    with pytest.raises(ValueError, match="pulse_id"):
        ae.Hits(mass_to_charge=[1.0]).correlation()


def test_losses_of_the_dead_time_show_in_the_isotopes():
    """Pairs of aluminium and boron, of which the second ion of the same isotope is never seen."""
    rng = np.random.default_rng(2)
    n = 60_000
    kind = rng.random(2 * n) < 0.5  # boron, else aluminium with one isotope
    boron = rng.choice([10.0129, 11.0093], 2 * n, p=[0.199, 0.801])
    mass = np.where(kind, boron, 26.9815).reshape(n, 2)
    alone = rng.random(n) < 0.9
    lost = ~alone & (mass[:, 0] == mass[:, 1]) & (mass[:, 0] < 20)
    second = ~alone & ~lost
    pulse = np.repeat(np.arange(n)[:, None], 2, axis=1)
    kept = np.stack([np.ones(n, bool), second], axis=1)
    hits = ae.Hits(
        mass_to_charge=mass[kept] * (1 + rng.normal(0, 4e-4, kept.sum()) + rng.exponential(1e-3, kept.sum())),
        pulse_id=pulse[kept],
    )
    spectrum = ae.spectrum(hits, ["B", "Al"])
    losses = spectrum.losses()
    part, error = losses.lost["B⁺"]
    # pulses that lost an ion count as single: the pairs that remain have fewer 11B than the natural ratio says
    assert part > 5 * error > 0 and losses.matters and losses.shift["B"] > 0
    assert spectrum.dead_time_note() == str(losses)
    pure = ae.spectrum(hits[hits.mass_to_charge < 20], ["B"])
    assert pure.losses().lost["B⁺"][0] > 0.1 and pure.dead_time_note() == ""  # an element alone has 100 at.%
    assert f"not corrected for it: with these ions there would be {losses.shift['B']:.2f} at.% more B" in str(losses)
    assert ae.spectrum(hits, ranges=spectrum.ranges()).dead_time_note() == ""  # an ion has no rivals to be clean of
    assert ae.spectrum(ae.Hits(mass_to_charge=hits.mass_to_charge), ["B", "Al"]).dead_time_note() == ""  # no pulses
    without = ae.Hits(
        mass_to_charge=np.where(kind, boron, 26.9815) * (1 + rng.normal(0, 4e-4, 2 * n)), pulse_id=pulse.ravel()
    )
    whole = ae.spectrum(without[np.append(np.arange(n), n + np.arange(0, n, 2))], ["B", "Al"])
    assert not whole.losses().matters and whole.dead_time_note() == ""
