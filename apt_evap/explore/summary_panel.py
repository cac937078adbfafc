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

_COLORS = {"alike": "#2e7d4f", "doubtful": "#a8741a", "not alike": "#a93a3a"}

READOUT_DELAY = 60
"""Delay of the numbers of a preview [ms]: a text changes the layout, which takes as long as to paint a map (50 ms)."""


class SummaryPanel:
    """Texts above the maps."""

    def __init__(self, explorer: Explorer | None, later: Callable[[Callable[[], None], int], Any]) -> None:
        self._later = later
        self._maps: ExplorerMaps | None = None
        self._explorer = explorer
        self._judged: tuple[Any, Any] = (None, None)  # registration and verdict of the last maps that were judged
        self._readout_waits = False
        self.facts = Div(sizing_mode="stretch_width")
        self.put_facts()
        self.readout = Div(sizing_mode="stretch_width")
        self.notes = Div(sizing_mode="stretch_width", styles={"color": "#d9822b"}, visible=False)

    def put_facts(self) -> None:
        """Say what the files contain."""
        facts = ["<b>apt-evap explore</b>"] if self._explorer is None else _facts(self._explorer)
        self.facts.text = " &nbsp; ".join(facts)

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
            self._judged = self._explorer.registration, likeness
        if maps is self._maps:
            self._put_numbers(maps)

    def put_verdict(self) -> None:
        """Show the verdict again, with the materials that are now known."""
        if self._maps is not None and not self._maps.preview:
            self._put_numbers(self._maps)

    def note(self, sentence: str) -> None:
        """Show a sentence, in place of all notes."""
        self._put_notes([sentence])

    def _put_preview(self):
        self._readout_waits = False
        if self._maps is not None and self._maps.preview:
            self._put_numbers(self._maps)

    def _put_numbers(self, maps):
        ions = "" if maps.simulated is None else f"{maps.simulated.shown_ions} on the map"
        if maps.preview:
            ions += ", preview"
        tone = "var(--faint)" if maps.preview else "var(--ink)"
        self.readout.text = f'<div style="color: {tone}">{self._sentence(maps)} <small>{ions}</small></div>'
        read = () if self._explorer is None else self._explorer.notes
        self._put_notes([*read, *(note for note in maps.notes if note not in read)])

    def _sentence(self, maps):
        """The verdict on both maps, with one number: the similarity of maps that are alike."""
        registration, likeness = self._judged
        if maps.similarity is None or likeness is None or self._explorer is None:
            return ""
        if registration is not self._explorer.registration:
            return ""  # of another registration
        sentence = likeness.reason
        if likeness.verdict == "alike":
            sentence = f"the maps have a similarity of {maps.similarity.value:.2f}"
            if maps.ceiling is not None:
                sentence += f"; two halves of the measurement have {maps.ceiling.value:.2f}"
        elif registration.doubtful:
            sentence += f"; the correlation of the registered maps is only {registration.score:.2f}"
        sentence = _materials(self._explorer) + sentence
        return (
            f'<b title="{escape(likeness.reason)}" style="background: {_COLORS[likeness.verdict]}; color: white;'
            f' border-radius: 10px; padding: 2px 10px; white-space: nowrap">{likeness.verdict}</b> {escape(sentence)}'
        )

    def _put_notes(self, notes: Sequence[str]) -> None:
        self.notes.update(text="<br>".join(map(escape, notes)), visible=bool(notes))


def _materials(explorer):
    """Materials of the run and of the measurement, as the beginning of a sentence; "" if one is not known."""
    measured = explorer.crystal_of_ions or explorer.crystal
    simulated = explorer.run.settings["tip"].get("material", {}).get("name") or ", ".join(explorer.run.elements)
    if not measured or not simulated:
        return ""
    if measured == simulated:
        return f"{simulated}, simulated and measured: "
    return f"the run is {simulated}, the measured ions are {measured}: "


def _facts(explorer):
    """Files, numbers of ions, axis, radius and voltage."""
    first, second = (escape(Path(name).name) for name in explorer.names)
    facts = []
    if explorer.run is not None:
        run = explorer.run
        tip = run.settings["tip"]
        parts = [f"{len(run):,} ions of {', '.join(dict.fromkeys(run.elements))}"]
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
            text = f"{np.count_nonzero(measured.detected):,} ions"
            if measured.voltage is not None and np.ptp(measured.voltage) > 0:
                text += f", {_voltages(measured.voltage)}"
        facts.append(f"<b>{second}</b> {text}")
    return facts


def _voltages(values):
    ends = [f"{voltage:,.0f}" for voltage in (float(np.min(values)), float(np.max(values)))]
    return f"{' to '.join(dict.fromkeys(ends))} V"
