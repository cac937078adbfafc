"""Report of a sweep: one row for each point, the best one first."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from apt_evap import plot
from apt_evap._common.codec import for_json, from_plain
from apt_evap._common.types import AnyPath
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.plot.map_figures import default_smoothing
from apt_evap.plot.report.html_page import Markup, Page, escape, heading, paragraph, switched, table, text_of
from apt_evap.plot.report.origin import add_origin, origin
from apt_evap.plot.report.pictures import blinking_pictures

_STUDY = ("mean energy [eV]", "doubts")
_MOST_SETTINGS, _MOST_MAPS, _MOST_TITLES = 4, 12, 3  # in the pictures


@dataclass(frozen=True)
class SweepRow:
    """A point of a sweep, with its results.

    Parameters
    ----------
    name : str
        Name of the point.
    settings : dict
        Settings that differ between the points, by name, as numbers or text.
    results : dict
        Further results of the point, by name with the unit in brackets, such as ``{"ions": 15000}``.
    study : dict, optional
        Result of `Study.to_dict`, also read from study.json; None without a comparison.
    maps : dict
        Maps by title with the same bins, which blink on one place; the first one is the measured one.
    panels : dict
        Simulated maps by the title of their emission, with the same titles and bins for all points.
    message : str
        What is missing or failed; empty for a complete point.
    """

    name: str
    settings: Mapping[str, Any]
    results: Mapping[str, Any] = field(default_factory=dict)
    study: Mapping[str, Any] | None = None
    maps: Mapping[str, DetectorMap] = field(default_factory=dict)
    panels: Mapping[str, DetectorMap] = field(default_factory=dict)
    message: str = ""

    @property
    def is_corrected(self) -> bool:
        """Whether the score is corrected for noise, as far as that means anything."""
        return self.study is not None and not (self.study["settings"]["allow_noise"] and self.study["no_score"])

    @property
    def score(self) -> Mapping[str, Any]:
        """Largest similarity with the measured map, and its error; -inf without a study."""
        if self.study is None:
            return {"value": -np.inf, "error": None}
        return self.study["optimum"]["score"] if self.is_corrected else self.study["plain"]["optimum"]

    @property
    def alike(self) -> bool:
        """Whether the maps are alike; scores of others are not comparable with theirs."""
        return self.study is not None and self.study["likeness"]["verdict"] == "alike"


def write_sweep(
    rows: Sequence[SweepRow],
    path: AnyPath,
    *,
    title: str = "Sweep",
    pictures: int = 3,
    files: Sequence[AnyPath] = (),
    command: str = "",
    warnings: Sequence[str] = (),
) -> None:
    """Write a sweep as one HTML file, with a row for each point.

    The points whose maps are alike are first, in the order of their similarity with the measured map; points without
    a study are last, in their own order. The file needs no network. The rows are inside as data (`read_report`).

    Parameters
    ----------
    rows : sequence of SweepRow
        The points.
    path : str or path-like
        File to write or replace.
    title : str
        Title of the page.
    pictures : int
        Number of points whose maps are drawn beside the measured one, from the best one.
    files : sequence of str or path-like
        Files of the sweep, whose names, sizes and SHA-256 are listed.
    command : str
        Command line to repeat the sweep.
    warnings : sequence of str
        Warnings of the sweep.

    Raises
    ------
    ValueError
        If there is no row.
    FileError
        If the file cannot be written, or one of `files` cannot be read.
    """
    if not rows:
        raise ValueError("rows must contain a point of the sweep, got none")
    rows = sorted(rows, key=lambda row: (not row.alike, -row.score["value"]))
    made = origin(files, command, warnings)
    page = Page(title)
    page.add(*(paragraph(f"Warning: {text}", "doubt") for text in made["warnings"]))
    failed = sum(bool(row.message) for row in rows)
    points = f"{len(rows)} point" + "s" * (len(rows) != 1)
    page.add(paragraph(f"{points}, {failed} of them incomplete." if failed else f"{points}, all complete."))
    compared = any(row.study for row in rows)
    page.add(heading("Points"), _table(rows, compared))
    if same := _same(rows):
        page.add(paragraph("The same for all points: " + "; ".join(f"{name} {value}" for name, value in same.items())))
    if compared:
        page.add(
            paragraph(
                "The best point is first. Scores and energies are given for maps that are alike: the mean after the "
                "truncation, at the field of the experiment if it is known, with the interval of 95 %. Compare scores "
                "only for the same bins and the same smoothing.",
                "note",
            )
        )
    if pictures:
        page.add(*_course(page, rows), *_gallery(page, rows))
    for row in [row for row in rows if row.maps][:pictures]:
        page.add(heading(_short(row).replace("\n", ", ")), blinking_pictures(page, row.maps, 5.0))
    add_origin(page, made)
    page.data("points", [_data(row) for row in rows])
    page.save(path)


def _course(page, rows):
    """Similarity against each setting that is a number; seeds only tell specimens apart."""
    compared = [row for row in rows if row.alike]
    varied = [name for name in _names(row.settings for row in compared) if not name.endswith("seed")]
    values = {name: [_number(row.settings.get(name)) for row in compared] for name in varied}
    names = [name for name in varied if len({*values[name]} - {None}) > 1][:_MOST_SETTINGS]
    if not names:
        return []
    figure = plot.new_figure((3.4 * len(names) + 0.6, 3.2))
    for ax, name in zip(figure.subplots(1, len(names), squeeze=False, sharey=True)[0], names, strict=True):
        points = [(x, row) for x, row in zip(values[name], compared, strict=True) if x is not None]
        errors = [row.score["error"] or 0.0 for _, row in points]
        ax.errorbar([x for x, _ in points], [row.score["value"] for _, row in points], errors, fmt="o", markersize=4)
        units = {text.partition(" ")[2] for _, row in points if isinstance(text := row.settings[name], str)}
        ax.set_xlabel(f"{name} [{units.pop()}]" if len(units) == 1 else name)
        ax.grid(alpha=0.3)
    figure.axes[0].set_ylabel(f"largest {_score_name(compared)}")
    return [heading("Similarity against the settings"), page.picture(figure, alt="Similarity against the settings")]


def _score_name(compared):
    """Name of the scores of the studies: "SSIM", or "concordance" of folded maps."""
    return from_plain({"objective": compared[0].study["settings"]["objective"]}, FitSettings).score_name


def _number(value):
    """Value of a setting as a number, also of a text such as "18 a"; None if it is none."""
    if isinstance(value, str):
        try:
            return float(value.partition(" ")[0])
        except ValueError:
            return None
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _gallery(page, rows):
    """Maps of the first points, one picture for each emission."""
    shown = [row for row in rows if row.panels][:_MOST_MAPS]
    if not shown:
        return []
    drawn = []
    for title in shown[0].panels:
        maps = [row.panels[title] for row in shown]
        maps = [map.smoothed(default_smoothing(map, map.ions)) if map.values.any() else map for map in maps]
        axes = plot.detector_maps(
            maps, [_short(row) for row in shown], columns=min(math.ceil(math.sqrt(len(shown))), 3), title=title
        )
        drawn.append(page.picture(axes[0].figure, alt=title))
    parts = [heading("Maps"), switched(drawn) if len(drawn) > 1 else drawn[0]]
    left = sum(bool(row.panels) for row in rows) - len(shown)
    return [*parts, paragraph(f"{left} more points are in the file of the maps.", "note")] if left else parts


def _short(row):
    """Settings of a point, for a title; its name if it has none."""
    values = [f"{name.rpartition('.')[2]} {text_of(value)}" for name, value in row.settings.items()]
    return "\n".join(values[:_MOST_TITLES]) or row.name


def _table(rows, compared):
    same = _same(rows)
    settings, results = (
        [name for name in _names(getattr(row, part) for row in rows) if name not in same]
        for part in ("settings", "results")
    )
    of_study = [_score_name([row for row in rows if row.study]), *_STUDY] if compared else []
    lines = []
    for row in rows:
        cells = [text_of(row.settings.get(name)) for name in settings]
        cells += [text_of(row.results.get(name)) for name in results]
        cells += _study_cells(row) * compared
        lines.append((*cells, row.name, row.message))
    head = [*settings, *results, *of_study, "Point", "Message"]
    if not any(row.message for row in rows):
        head, lines = head[:-1], [line[:-1] for line in lines]
    return table(lines, head, best=0 if any(row.alike for row in rows) else None)


def _same(rows):
    """Settings and results that all of several points have alike, as texts."""
    if len(rows) < 2:
        return {}
    values = {name: {text_of(row.settings.get(name)) for row in rows} for name in _names(row.settings for row in rows)}
    values |= {name: {text_of(row.results.get(name)) for row in rows} for name in _names(row.results for row in rows)}
    return {name: next(iter(texts)) for name, texts in values.items() if len(texts) == 1}


def _study_cells(row):
    """Score and mean energy, if they are results, and doubts."""
    content, score, alike = row.study, row.score, row.alike
    if content is None:
        return [""] * (1 + len(_STUDY))
    error = f" ± {score['error']:.3f}" if score["error"] is not None else ""
    text = f"{score['value']:.3f}{error}" + ("" if row.is_corrected else ", not corrected for noise")
    reasons = [
        Markup(f'<span class="red">{escape(content["likeness"]["verdict"])}</span>') if not alike else "",
        Markup('<span class="red">registration doubtful</span>') if content["registration"]["doubtful"] else "",
        content["no_energy"] if alike else "",
        "end of the grid" if content["optimum"]["at_edge"] and alike else "",
    ]
    return [text if alike else "", content["energy"], Markup(", ".join(escape(reason) for reason in reasons if reason))]


def _names(parts):
    """Names in the order of their first appearance."""
    return list(dict.fromkeys(name for part in parts for name in part))


def _data(row):
    return for_json({name: getattr(row, name) for name in ("name", "settings", "results", "study", "message")})
