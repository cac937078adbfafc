"""
Losses between pulses, with explicit times
==========================================

Simulates the evaporation of a small tip of a binary alloy by the next reaction method, with the rates at the top of the
pulses and at the standing voltage between them. Every event is one or the other. The shares of the ions that are lost
are compared with `apt_evap.evaporation.conditions`. Draws the figure of the page "The choice of conditions".

    python conditions.py
"""

import argparse
import heapq
import math

import numpy as np

import apt_evap as ae

ELEMENTS, SOLUTE = ("Al", "Cu"), 0.1
LOCAL = 1000  # atoms; more are asked for in a relaxation only


class Pulsed:
    """Law with the waits of a thermal law, in pulses of the voltage: at the top of the pulses, and between them.

    The next reaction method (Gibson and Bruck 2000): every atom has the time of its event; when its field changes, the
    rest of its wait is divided by the factor of its rate. The largest key is the event that comes first.
    """

    def __init__(self, law, control, level, seed):
        self.law, self.control, self.level = law, control, level
        self.random = np.random.default_rng(seed)
        self.now, self.times, self.rates, self.shares, self.queue = 1e-12, {}, {}, {}, []
        self.events = []

    def rates_of(self, tip, atoms, fields):
        """Events per pulse at its top and between pulses, each of shape (n,)."""
        sensitivities = self.law.sensitivities(tip)[tip.species[atoms]]
        lengths = np.array([self.law.working_point(each, self.control)[1] for each in self.law.sensitivities(tip)])
        x = self.level * fields / tip.evaporation_fields[tip.species[atoms]]
        stiffness = sensitivities / (ae.units.BOLTZMANN * self.law.temperature)
        frequency = self.law.attempt_frequency
        top = frequency * lengths[tip.species[atoms]] * np.exp(np.minimum(-stiffness * (1 - x), 0.0))
        standing = x / (1 + self.control.pulse_fraction)
        rest = frequency / (1e3 * self.control.pulse_frequency) * np.exp(np.minimum(-stiffness * (1 - standing), 0.0))
        return top, rest

    def keys(self, tip, atoms, fields, bonds):
        left = self._next()
        if left is not None and left not in set(atoms.tolist()):  # it has left: this was its event
            self.now = self.times.pop(left)
            self.events.append((int(tip.species[left]), self.shares[left]))
        elif len(atoms) > LOCAL:  # a relaxation: the voltage is set for the rate
            self.level = self._level(tip, atoms, fields)
        top, rest = self.rates_of(tip, atoms, fields)
        result = np.zeros(len(atoms))
        for k, (atom, rate) in enumerate(zip(atoms.tolist(), top + rest, strict=True)):
            if not tip.evaporable[atom] or not rate > 1e-250:
                continue
            if atom in self.times:
                wait = (self.times[atom] - self.now) * self.rates[atom] / rate
            else:
                wait = self.random.exponential() / rate
            # an atom that a pulse uncovers, and that leaves at a high rate, leaves before this pulse ends
            share = rest[k] / rate * math.exp(-top[k] / 2)
            self.times[atom], self.rates[atom], self.shares[atom] = self.now + wait, rate, share
            heapq.heappush(self.queue, (self.times[atom], atom))
            result[k] = 1 / self.times[atom]
        return result

    def _next(self):
        """The atom whose event comes first."""
        while self.queue and self.times.get(self.queue[0][1]) != self.queue[0][0]:
            heapq.heappop(self.queue)
        return self.queue[0][1] if self.queue else None

    def _level(self, tip, atoms, fields):
        """Factor of the fields at which the wanted number of ions leaves per pulse, at its top."""
        may = tip.evaporable[atoms]
        low, high = 0.01 * self.level, 100 * self.level
        for _ in range(60):
            self.level = math.sqrt(low * high)
            many = self.rates_of(tip, atoms[may], fields[may])[0].sum() > self.control.rate
            low, high = (low, self.level) if many else (self.level, high)
        return self.level


def simulated(sensitivity, field_ratio, temperature, fraction, events, seed):
    """Share of the ions of each element that leave between pulses, with its standard error."""
    law, control = (
        ae.Arrhenius(temperature, sensitivity=sensitivity),
        ae.evaporation.VoltageControl(pulse_fraction=fraction),
    )
    host = ae.material(ELEMENTS[0])
    solute = ae.Material(ELEMENTS[1], "fcc", host.a, field_ratio * host.evaporation_field, charge_state=1, mass=63.5)
    tip = ae.Tip(host, 10 * host.a, axis=(0, 0, 1), shank_length=5 * host.a, solutes={solute: SOLUTE}, seed=seed)
    pulsed = Pulsed(law, control, 0.1, seed)
    settings = ae.evaporation.ChargeSettings(sweep_interval=10)  # the voltage is controlled as often
    for _ in ae.evaporation.Emitter(tip, law=pulsed, settings=settings).advance(events):
        pass
    species, shares = np.array(pulsed.events[events // 4 :]).T  # the first ions are those of a smooth cap
    return [(shares[species == k].mean(), shares[species == k].std() / math.sqrt((species == k).sum())) for k in (0, 1)]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", default="conditions.png", help="the figure")
    options = parser.parse_args()
    temperatures, fractions = np.linspace(20.0, 100.0, 41), np.linspace(0.1, 0.3, 21)
    law = ae.Arrhenius(50.0, sensitivity=dict(zip(ELEMENTS, (1.0, 0.6), strict=True)))
    composition = dict(zip(ELEMENTS, (1 - SOLUTE, SOLUTE), strict=True))
    found = ae.evaporation.conditions(composition, temperatures=temperatures, pulse_fractions=fractions, law=law)
    ae.plot.conditions(found, ELEMENTS[1])[0].figure.savefig(options.output, dpi=150)
    for solute, ratio, temperature, fraction in (
        (0.6, 1.0, 50.0, 0.2),
        (0.5, 1.0, 50.0, 0.2),
        (0.5, 1.0, 80.0, 0.2),
        (0.5, 1.0, 80.0, 0.3),
        (1.0, 0.8, 50.0, 0.2),
        (1.0, 0.8, 50.0, 0.3),
        (1.0, 1.25, 50.0, 0.2),
        (0.5, 0.8, 50.0, 0.2),
    ):
        sensitivity = dict(zip(ELEMENTS, (1.0, solute), strict=True))
        law = ae.Arrhenius(temperature, sensitivity=sensitivity)
        one = ae.evaporation.conditions(composition, temperatures=temperature, pulse_fractions=fraction, law=law)
        expected = one.lost.ravel()
        found = simulated(sensitivity, ratio, temperature, fraction, options.events, options.seed)
        texts = [
            f"{name} {mean:.2g} +- {error:.1g} ({formula:.2g})"
            for name, (mean, error), formula in zip(ELEMENTS, found, expected, strict=True)
        ]
        print(f"C {solute:g} eV, field {ratio:g}, {temperature:g} K, p {fraction:g}: {', '.join(texts)}", flush=True)


if __name__ == "__main__":
    main()
