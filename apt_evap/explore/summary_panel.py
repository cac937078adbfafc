"""Panel of the summary: what the files contain, the similarity of both maps, and notes."""

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.models import Div

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.explore.explorer import Explorer, ExplorerMaps
from apt_evap.maps.registration.verdict import Likeness

READOUT_DELAY = 60
"""Delay of the numbers of a preview [ms]: a text changes the layout, which takes as long as to paint a map (50 ms)."""


class SummaryPanel:
    """Texts above the maps.

    Parameters
    ----------
    explorer : Explorer or None
        What is open.
    later : callable
        As for `Page`.
    """

    def __init__(self, explorer: Explorer | None, later: Callable[[Callable[[], None], int], Any]) -> None:
        self._later = later
        self._maps: ExplorerMaps | None = None
        self._explorer = explorer
        self._judged: tuple[Any, str] = (None, "")  # registration and verdict of the last maps that were judged
        self._readout_waits = False
        facts = ["<b>apt-evap explore</b>"] if explorer is None else _facts(explorer)
        self.facts = Div(text=" &nbsp; ".join(facts), sizing_mode="stretch_width")
        self.readout = Div(width=330)
        self.notes = Div(sizing_mode="stretch_width", styles={"color": "#d9822b"})

    def put(self, maps: ExplorerMaps) -> None:
        """Show the numbers and the notes of maps, those of a preview a little later."""
        self._maps = maps
        if not maps.preview:
            self._put_numbers(maps)
        elif not self._readout_waits:
            self._readout_waits = True
            self._later(self._put_preview, READOUT_DELAY)

    def judge(self, maps: ExplorerMaps, likeness: Likeness) -> None:
        """Take the verdict on maps: the similarity is a number for maps that are alike."""
        if self._explorer is not None:
            self._judged = self._explorer.registration, likeness.verdict
        if maps is self._maps:
            self._put_numbers(maps)

    def note(self, sentence: str) -> None:
        """Show a sentence, in place of all notes."""
        self._put_notes([sentence])

    def _put_preview(self):
        self._readout_waits = False
        if self._maps is not None and self._maps.preview:
            self._put_numbers(self._maps)

    def _put_numbers(self, maps):
        text = ""
        registration, verdict = self._judged
        if self._explorer is None or registration is not self._explorer.registration:
            verdict = ""  # of another registration
        if maps.similarity is not None:
            text = f"no similarity: the maps are {verdict}<br>" if verdict else ""
        if maps.similarity is not None and verdict == "alike":
            halves = "" if maps.ceiling is None else f"; of two halves of the measurement {maps.ceiling.value:.3f}"
            text = f'<span style="font-size: 26px">{maps.similarity.value:.3f}</span> similarity{halves}<br>'
        ions = "" if maps.simulated is None else f"{maps.simulated.shown_ions} on the map"
        if maps.preview:
            ions += ", preview"
        tone = "var(--faint)" if maps.preview else "var(--ink)"
        self.readout.text = f'<div style="color: {tone}">{text}<small>{ions}</small></div>'
        self._put_notes(maps.notes)

    def _put_notes(self, notes: Sequence[str]) -> None:
        self.notes.text = "<br>".join(map(escape, notes))


def _facts(explorer):
    """Files, numbers of ions, axis, radius and voltage."""
    first, second = (escape(Path(name).name) for name in explorer.names)
    facts = []
    if explorer.run is not None:
        run = explorer.run
        tip = run.settings["tip"]
        parts = [f"{len(run):,} ions of {', '.join(run.elements)}"]
        if "axis" in tip:
            parts.append(f"[{' '.join(f'{index:g}' for index in tip['axis'])}]")
        if tip.get("apex_radius"):
            parts.append(f"R = {tip['apex_radius']:.3g} nm")
        parts.append(_voltages(run.voltages))
        facts.append(f"<b>{first}</b> {escape(', '.join(parts))}")
    if explorer.measured is not None:
        measured = explorer.measured
        if isinstance(measured, DetectorMap):
            text = f"{measured.values.shape[1]} × {measured.values.shape[0]} bins"
        else:
            text = f"{len(measured):,} ions"
            if measured.voltage is not None and np.ptp(measured.voltage) > 0:
                text += f", {_voltages(measured.voltage)}"
        facts.append(f"<b>{second}</b> {text}")
    return facts


def _voltages(values):
    ends = [f"{voltage:,.0f}" for voltage in (float(np.min(values)), float(np.max(values)))]
    return f"{' to '.join(dict.fromkeys(ends))} V"
