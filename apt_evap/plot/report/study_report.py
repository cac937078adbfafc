"""Report of a study: maps that blink on one place, energies with intervals and doubts, similarities, settings."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from apt_evap import plot
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_kind
from apt_evap.fit.study import PREDICTED, RULE_OF_METAL, Score, Study
from apt_evap.maps.crystallography.directions import plain_label
from apt_evap.plot.report.composition_report import composition_section
from apt_evap.plot.report.html_page import (
    Page,
    collapsed,
    color_scale,
    escape,
    flat,
    paragraph,
    table,
    text_of,
)
from apt_evap.plot.report.origin import add_origin, origin
from apt_evap.plot.report.pictures import blinking_pictures
from apt_evap.simulation.description import lens_text
from apt_evap.spectra.mass_spectrum import Spectrum

_COLORS = "viridis"  # of the matrix, as of `plot.score_matrix`
_LONG = ("run", "registered", "share_above_energy_limit")  # settings in tables of their own, or only for programs
_SHOWN = 2  # doubts that are not folded
_RARE = 0.05
"""Largest fraction of resamples without gain, and of energies above the limit of the responses, without a doubt."""


def write_study(
    study: Study,
    path: AnyPath,
    *,
    title: str = "",
    figures: Mapping[str, Figure] | None = None,
    files: Sequence[AnyPath] = (),
    command: str = "",
    warnings: Sequence[str] = (),
    sections: Sequence[str] = (),
    spectrum: Spectrum | None = None,
) -> None:
    """Write a study as one HTML file.

    Measured and simulated map are side by side, each on its own colour scale, with the poles of the simulated crystal;
    a press on a map or the key B puts both on one place and switches between them, so that errors of the registration
    are visible as motion. One sentence has the result. The rest is folded. The file contains its pictures and needs no
    network. The content of `Study.to_dict` is inside, too (`read_report`).

    Parameters
    ----------
    study : Study
        Result of `fit_energies`.
    path : str or path-like
        File to write or replace.
    title : str
        Title of the page; by default the mechanism.
    figures : dict, optional
        Figures by caption, in addition to the maps.
    files : sequence of str or path-like
        Files of the study, whose names, sizes and SHA-256 are listed.
    command : str
        Command line to repeat the study.
    warnings : sequence of str
        Warnings of the study.
    sections : sequence of str
        More parts of the page, as HTML.
    spectrum : Spectrum, optional
        Spectrum of the measured ions, for their composition.

    Raises
    ------
    FileError
        If the file cannot be written, or one of `files` cannot be read.
    """
    check_kind(study, "study", Study, "a Study")
    content, made = study.to_dict(), origin(files, command, warnings)
    page = Page(title or f"Emission energies: {study.grid.mechanism}")
    reasons = [*doubts(content), *(f"Warning: {line}" for line in made["warnings"])]
    page.add(_maps(page, study))
    page.add(paragraph(_sentence(study), "result"))
    page.add(*(paragraph(text, "doubt") for text in reasons[:_SHOWN]))
    if reasons[_SHOWN:]:
        page.add(collapsed("More doubts", "\n".join(paragraph(text, "doubt") for text in reasons[_SHOWN:])))
    page.add(*_evidence(page, study), *sections)
    if spectrum is not None:
        page.add(composition_section(page, check_kind(spectrum, "spectrum", Spectrum, "a Spectrum")))
    if study.likeness.verdict == "alike":
        page.add(collapsed("Energies", _energies(study)), collapsed("Scores on the grid", _grid(study)))
    for caption, figure in (figures or {}).items():
        page.add(collapsed(caption, page.picture(figure, alt=caption)))
    page.add(collapsed("Registration", _registration(content["registration"])))
    settings = content["settings"]
    comparison = {name: value for name, value in settings.items() if name not in _LONG}
    for name, part in (("Settings of the comparison", comparison), ("Settings of the simulated run", settings["run"])):
        page.add(collapsed(name, table((key, text_of(value)) for key, value in flat(part).items())))
    add_origin(page, made)
    page.data("study", content)
    page.save(path)


def _sentence(study):
    """The verdict and the result."""
    text = study.lines()[0]
    known = study.likeness.verdict == "alike" or not study.registration.doubtful
    return f"{text[0].upper()}{text[1:]}." + ("" if known else " The registration is doubtful.")


def doubts(content: Mapping[str, Any]) -> list[str]:
    """Reasons to doubt the energies of a study whose maps are alike; none of others, which have no energies.

    Parameters
    ----------
    content : dict
        Result of `Study.to_dict`, also read from study.json.
    """
    settings, edges = content["settings"], content["optimum"]["at_edge"]
    others: list[str] = []
    if content["likeness"]["verdict"] != "alike":
        return others
    if edges:
        names = {"mean": "the mean", "relative_spread": "standard deviation / mean"}
        labels = " and ".join(names.get(name, name) for name in edges)
        others.append(f"The best point is at the end of the grid in {labels}: better values may be beyond it.")
    if not content["refined"]["intervals"]:
        others.append("The errors are not known, because there are no resamples.")
    elif content["gain_share"] < 1 - _RARE:
        share = f"{content['gain_share']:.0%}"
        others.append(f"The best map is better than the unperturbed one in only {share} of the resamples.")
    above = np.max(settings["share_above_energy_limit"])
    if above > _RARE:
        others.append(
            f"At one end of the grid, {above:.0%} of the energies are above the limit of the responses: their hit "
            "positions are extrapolated."
        )
    if settings["measured_noise"] == "not known" and settings["allow_noise"]:
        others.append(
            "The noise of the measured densities is not known and not corrected: the best energies have slightly more "
            "contrast than the true ones."
        )
    return others


# ---- parts of the page -----------------------------------------------------------------------------------------------


def _energies(study):
    """The mean after the truncation at the field of the experiment, and the parameters of the grid."""
    best, refined, (factor, where) = study.optimum, study.refined, study.real_factor
    after = {"true_mean": "mean energy [eV]", "true_standard_deviation": "standard deviation [eV]"}
    rows = [(f"{label}, {where}", refined.scaled(name, factor)) for name, label in after.items()]
    if study.no_energy:
        rows.append(("not a result, because", study.no_energy))
    names = {"mean": "mean [eV]", "relative_spread": "standard deviation / mean"}
    if study.grid.mechanism == "combined":
        names["rollup_fraction"] = "roll-up fraction"
    varied = [(label, f"{getattr(best, name):.3g}", refined.bounded(name)) for name, label in names.items()]
    varied += [(name, f"{value:.3g}", refined.bounded(name)) for name, value in best.options.items()]
    voltage = f"{study.provenance['run']['voltage']:g} V"
    note = "Fitted energies scale with the assumed tip radius and voltage."
    if study.provenance.get("microscope"):
        note += f" The run is behind a {lens_text(study.provenance['microscope'])}."
    head = (f"parameters of {study.grid.name}", "best on the grid", "between its points")
    return (
        table(rows, ("after truncation", "value" + " (interval of 95 %)" * bool(refined.intervals)))
        + table(varied, head)
        + paragraph(f"Parameters are those before the truncation, at the voltage of the run, {voltage}. {note}", "note")
    )


def _grid(study):
    """Scores of the maps, and of all points of the grid."""
    note = "Rows: standard deviation / mean. Columns: mean before the truncation [eV]. Frame: the best point."
    parts = [_scores(study), '<div class="matrices">', *_matrices(study), "</div>", _scale(study)]
    return "\n".join([*parts, paragraph(note, "note")])


def _scores(study):
    corrected = (
        f"noise-corrected {study.settings.score_name}" if study.settings.allow_noise else study.settings.score_name
    )
    scores = {**study.baselines, "optimum": study.optimum.score}
    thermal = f"thermal, {study.settings.temperature:g} K"
    labels = {"thermal": thermal, RULE_OF_METAL: f"{PREDICTED}, not fitted", "optimum": "best"}
    rows = [(labels.get(name, name), score, study.plain[name]) for name, score in scores.items()]
    head = ["Map", corrected, f"uncorrected {study.settings.score_name}"]
    if not study.settings.allow_noise:
        rows, head = [row[:2] for row in rows], head[:2]
    elif study.no_score:
        rows, head = [(name, plain) for name, _, plain in rows], [head[0], head[2]]
    facts = f"Gain over unperturbed: {study.gain}."
    if study.settings.allow_noise and study.no_score:
        facts = f"Not corrected for noise: {study.no_score}."
    if study.ceiling is not None:
        facts += f" Two halves of the measured ions: {study.ceiling} (uncorrected)."
    width, height = study.measured.bin_size
    return table(rows, head) + paragraph(
        f"{facts} {study.provenance['bins_compared']:,} bins of {width:.3g} × {height:.3g} mm compared, smoothed by "
        f"{study.settings.smoothing:.3g} mm. Errors: standard deviations of {study.settings.resamples} resamples.",
        "note",
    )


def _scale(study):
    """Colours of the matrices."""
    low, high = float(study.scores.min()), float(study.scores.max())
    shades = [matplotlib.colors.to_hex(matplotlib.colormaps[_COLORS](part)) for part in np.linspace(0, 1, 9)]
    return color_scale(shades, f"{low:z.3f}", f"{high:z.3f}", study.settings.score_name)


def _evidence(page, study):
    """Folded maps, and what they say."""
    scores = study.structure
    if scores is None or not scores.evidence:
        return []
    parts = [paragraph(f"{scores.evidence[:1].upper()}{scores.evidence[1:]}.")]
    maps = {"measured": scores.measured, "simulated": scores.optimum}
    known = {title: scores_of_map.folded for title, scores_of_map in maps.items() if scores_of_map.folded is not None}
    if len(known) > 1:
        pole = plain_label(scores.plane)
        parts.append(
            page.picture(
                plot.folded_maps(known)[0].figure,
                f"Maps folded about the pole ({pole}) by its symmetry, {known['measured'].symmetry}, and flattened.",
            )
        )
    return [collapsed("Folded maps", "\n".join(parts))]


def _matrices(study):
    """A table for each roll-up fraction and option."""
    *_, rows, columns = study.grid.shape
    values, errors, shares = (
        values.reshape(-1, rows, columns) for values in (study.scores, study.errors, study.shares)
    )
    at = study.best_cell
    best = int(np.ravel_multi_index(at[:-2], study.grid.shape[:-2]))
    for layer, title in enumerate(study.grid.layers):
        yield _matrix(study, title, values[layer], errors[layer], shares[layer], at[-2:] if layer == best else None)


def _matrix(study, title, values, errors, shares, best):
    """Similarities for one roll-up fraction as a table; a cell shows its details under the pointer or the focus."""
    grid = study.grid
    colors = matplotlib.colormaps[_COLORS]
    low, high = float(study.scores.min()), float(study.scores.max())
    shades = colors((values - low) / (high - low) if high > low else np.zeros_like(values))
    lines = ['<table class="matrix">']
    if title:
        lines.append(f"<caption>{escape(title)}</caption>")
    for row in reversed(range(len(grid.relative_spreads))):  # as in the picture, upwards
        cells = []
        for column, mean in enumerate(grid.means):
            shade = shades[row, column, :3]
            light = np.dot(shade, (0.299, 0.587, 0.114)) > 0.5
            score = Score(float(values[row, column]), float(errors[row, column]))
            details = f"mean {mean:g} eV, standard deviation / mean {grid.relative_spreads[row]:.4g}: "
            details += f"{study.settings.score_name} {score}"
            if len(study.resampled):
                details += f", best in {shares[row, column]:.0%} of the resamples"
            frame = ' class="best"' if (row, column) == best else ""
            color = matplotlib.colors.to_hex(shade)
            cells.append(
                f'<td{frame} tabindex="0" style="background:{color};color:{"#000" if light else "#fff"}">'
                f"{score.value:z.3f}<span>{escape(details)}</span></td>"
            )
        lines.append(f"<tr><th>{grid.relative_spreads[row]:.3g}</th>{''.join(cells)}</tr>")
    lines.append(f"<tr><th></th>{''.join(f'<th>{mean:.4g}</th>' for mean in grid.means)}</tr></table>")
    return "\n".join(lines)


def _registration(content):
    scores = {"correlation": content["score"], "common area": content["overlap"], "residual [mm]": content["residual"]}
    rows = [
        ("mirrored", content["mirror"]),
        ("rotation [degrees]", content["rotation"]),
        ("scale [measured mm per simulated mm]", content["scale"]),
        ("shift in x, y [mm]", content["shift"]),
        *((name, value) for name, value in scores.items() if value is not None),
        ("origin", content["method"] or "given"),
        ("other transforms that are equally good", len(content["ties"])),
    ]
    return table((name, text_of(value)) for name, value in rows)


def _maps(page, study):
    """The measured and the best map side by side, with the poles of the simulated crystal as registered."""
    maps = {"measured": study.measured, "simulated": study.maps["optimum"]}
    crystal = None
    if study.orientation is not None and study.projection is not None:
        crystal = study.orientation, study.projection
    return blinking_pictures(page, {title: study.compared(map) for title, map in maps.items()}, crystal=crystal)
