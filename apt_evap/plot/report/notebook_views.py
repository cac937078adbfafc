"""Views of maps, runs, ions, specimens, materials and studies in a notebook: a picture or a table."""

import io
from html import escape
from typing import Any

from matplotlib.figure import Figure

from apt_evap._common.codec import declared, to_plain
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.fit.study import Study
from apt_evap.plot.map_figures import detector_map
from apt_evap.simulation.description import UNITS, describe
from apt_evap.specimen.materials import Material

_DPI = 90


def picture(map: DetectorMap) -> bytes:
    """Picture of a detector map as PNG, bytes."""
    figure = Figure((5.0, 4.2))  # not of pyplot, which would draw it a second time
    detector_map(map, figure.subplots())
    with io.BytesIO() as file:
        figure.savefig(file, format="png", dpi=_DPI, bbox_inches="tight")
        return file.getvalue()


def folded_table(data: Any) -> str:
    """Description of the data in one line, and a folded table of the output of `apt-evap info`, as HTML."""
    if isinstance(data, Material):
        contents = to_plain(data)
        contents["sources"] = [f"{name}: {source}" for name, source in contents["sources"].items()]
        rows = _table(contents, {name: setting.unit for name, setting in declared(Material).items() if setting.unit})
    elif isinstance(data, Study):
        scores = {name: str(score) for name, score in data.baselines.items()}
        rows = _table({"result": data.lines(), "similarity": {"best": str(data.optimum.score)} | scores}, {})
    elif callable(contents := getattr(data, "notebook_contents", None)):  # of a package above this one
        rows = _table(contents(), UNITS)
    else:
        rows = _table(describe(data), UNITS)
    return f"<details><summary><code>{escape(repr(data))}</code></summary>{rows}</details>"


def _table(contents, units):
    rows = []
    for key, value in contents.items():
        label = key.replace("_", " ") + (f" [{units[key]}]" if key in units else "")
        rows.append(f'<tr><th style="text-align:left">{escape(label)}</th><td>{_cell(value, units)}</td></tr>')
    return f"<table>{''.join(rows)}</table>"


def _cell(value, units):
    if isinstance(value, dict) and value:
        return _table(value, units)
    if isinstance(value, list | dict):
        return ", ".join(_cell(item, units) for item in value) or "none"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "none" if value is None else escape(f"{value:g}" if isinstance(value, float) else str(value))
