"""Fits with settings in one line: `fit_energies` and `fit_tips` with the fields of both classes of settings."""

import apt_evap as ae
from apt_evap._common.codec import declared


def _parts(mechanism, options):
    parts = []
    for kind, own in ((ae.fit.EnergyGrid, {"mechanism": mechanism}), (ae.fit.FitSettings, {})):
        parts.append(kind(**own, **{name: options.pop(name) for name in declared(kind) if name in options}))
    return parts


def fit_energies(run, measured, mechanism="roll-up", **options):
    """`ae.fit_energies`, with the fields of `EnergyGrid` and `FitSettings` as arguments."""
    return ae.fit_energies(run, measured, *_parts(mechanism, options), **options)


def fit_tips(runs, measured, mechanism="roll-up", **options):
    """`ae.fit.fit_tips`, likewise."""
    return ae.fit.fit_tips(runs, measured, *_parts(mechanism, options), **options)
