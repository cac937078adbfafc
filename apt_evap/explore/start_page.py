"""The page without a file: files of the folder, those that were opened last, an example, a place to drop one."""

import tomllib
from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import Button, Div, InlineStyleSheet

from apt_evap._common.files import replace_file
from apt_evap.detection.projection import Projection
from apt_evap.explore.dropped_file import TOLD
from apt_evap.explore.recent_files import recent_files
from apt_evap.explore.run_progress import RunProgress, ServerState
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.indexing.master_pattern import master_patterns

RUNS, MEASUREMENTS = (".h5",), (".epos", ".pos", ".apt", ".raw", ".nxs", ".npz")
"""Suffixes of files that can be opened."""
RANGES = (".rrng", ".rng", ".env", ".xrng")
"""Suffixes of ranges of mass, which are shown with a measurement."""
EXAMPLE = "example_ni111.npz"
"""File of the example, a map as nickel gives it; it is written when it is opened."""
_MOST = 40  # files of a kind
_LARGEST_SETTINGS = 1 << 20  # bytes
_UNITS = ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))
_CARDS = ":host { display: grid; grid-template-columns: repeat(auto-fit, minmax(300px, 1fr)); gap: 24px; }"
_CARD = """
:host .bk-btn.bk-btn-default { text-align: left; border: 1px solid var(--edge); border-radius: 6px; padding: 7px 10px;
  background: var(--panel); color: var(--link); font-size: 14px; cursor: pointer; }
:host .bk-btn.bk-btn-default:hover { border-color: #2f6fb3; text-decoration: underline; }
:host .bk-btn.bk-btn-default::after { content: "→"; float: right; color: var(--faint); }
"""
_DROP_STYLE = """
:host { border: 2px dashed var(--edge); border-radius: 12px; padding: 28px; text-align: center; font-size: 16px; }
:host(.over) { border-color: #2f6fb3; background: var(--panel); }
"""


class StartPage:
    """Widgets of the page without a file."""

    def __init__(
        self,
        open_file: Callable[[str], None],
        state: ServerState,
        later: Callable[[Callable[[], None], int], Any],
    ) -> None:
        self._open = open_file
        self.stop = Button(width=120, visible=False)
        self.text = Div(sizing_mode="stretch_width", margin=0)
        self.progress = RunProgress(state, self.text, {self.stop: ""}, later, open_file)
        self.stop.on_click(self.progress.stop)
        self.zone = Div(
            text="Drop a measured file or a run here", sizing_mode="stretch_width", name=TOLD,
            stylesheets=[InlineStyleSheet(css=_DROP_STYLE)],
        )  # fmt: skip
        self.buttons: dict[str, Button] = {}
        folder = _files()
        cards = [
            self._card("Measurements in this folder", folder[0], "no .epos, .pos, .apt, .raw, .nxs or .npz"),
            self._card("Runs in this folder", folder[1], "no .h5"),
            self._card("Ranges, with their measurement", folder[2], "no .rrng, .rng, .env or .xrng"),
            self._card("Settings: a click simulates", _settings(), "no .toml of a simulation"),
            self._card("Opened last", [path for path in recent_files() if Path(path).is_file()], "nothing yet"),
            self._card("Example", [EXAMPLE], ""),
        ]
        hint = (
            f"<b style='font-size: 22px'>What does this map show?</b><br>"
            f"Open a measured file: its peaks are named, its crystal is found, and a simulation of the specimen is "
            f"one button away. Files of <b>{escape(str(Path.cwd()))}</b>:"
        )
        self.column = column(
            Div(text=hint, sizing_mode="stretch_width", styles={"font-size": "15px", "line-height": "1.7"}),
            self.zone,
            row(self.text, self.stop, sizing_mode="stretch_width"),
            column(*cards, sizing_mode="stretch_width", stylesheets=[InlineStyleSheet(css=_CARDS)]),
            sizing_mode="stretch_width",
            styles={"max-width": "1200px", "margin": "24px auto", "gap": "20px", "padding": "0 24px"},
        )

    def _card(self, title: str, paths: Sequence[str], empty: str) -> Any:
        """Files of a kind, each of which a click opens."""
        rows = []
        for path in paths[:_MOST]:
            label = "nickel [111], as an instrument would see it" if path == EXAMPLE else _label(path)
            button = Button(label=label, sizing_mode="stretch_width", stylesheets=[InlineStyleSheet(css=_CARD)])
            button.on_click(partial(self._run if path.endswith(".toml") else self._open, path))
            self.buttons[path] = button
            rows.append(button)
        more = len(paths) - _MOST
        text = f"{more} more: type their names above" if more > 0 else "" if rows else empty
        head = Div(text=f"<b>{title}</b>", styles={"font-size": "15px"})
        told = [Div(text=f"<small>{text}</small>")] if text else []
        return column(head, *rows, *told, sizing_mode="stretch_width")

    def close(self) -> None:
        """Show the run no longer; it goes on."""
        self.progress.close()

    def _run(self, path):
        """Run a settings file; its run is opened at its end."""
        if self.progress.active:
            self.text.text = "a run is active: stop it first"
            return
        self.progress.start(Path(path).absolute())


def write_example() -> None:
    """Write the map of the example to the current folder, unless it is there."""
    path = Path(EXAMPLE)
    if path.exists():
        return
    orientation = Orientation("Ni", axis=(1, 1, 1), rotation=20.0)
    projection = Projection(25.0, (-3.0, 1.5))
    counts = master_patterns("fcc")[0].map(orientation, projection, width=34.0, ions=80_000, rolled=0.5, seed=1)
    with replace_file(path) as file:
        np.savez_compressed(
            file, counts=counts.values, inside=counts.mask, x_edges_mm=counts.x_edges, y_edges_mm=counts.y_edges
        )


def files_to_open() -> list[str]:
    """Files of the current folder and the folders in it that can be opened."""
    return [path for kind in _files() for path in kind]


def ranges_near(path: str) -> list[str]:
    """Files of ranges in the folder of a measurement, those with its name first."""
    stem, folder = Path(path).stem, Path(path).parent
    found = [str(each) for each in sorted(folder.glob("*")) if each.suffix.lower() in RANGES and each.is_file()]
    return sorted(found, key=lambda each: Path(each).stem != stem)


def measurement_of(ranges: str) -> str:
    """The measurement of a file of ranges: that of its name, or the only one of its folder."""
    found = [each for each in sorted(Path(ranges).parent.glob("*")) if each.suffix.lower() in MEASUREMENTS[:-1]]
    same = [each for each in found if each.stem == Path(ranges).stem]
    if len(same or found) != 1:
        many = ", ".join(each.name for each in (same or found)[:4]) or "none"
        raise ValueError(f"open the measurement of {Path(ranges).name} first: in its folder are {many}")
    return str((same or found)[0])


def _files():
    """Measurements, runs and ranges in the current folder and the folders in it."""
    paths = [path for pattern in ("*", "*/*") for path in sorted(Path().glob(pattern)) if path.is_file()]
    return tuple([str(path) for path in paths if path.suffix.lower() in kind] for kind in (MEASUREMENTS, RUNS, RANGES))


def _settings():
    """Settings files of simulations in the current folder and the folders in it."""
    paths = [path for pattern in ("*.toml", "*/*.toml") for path in sorted(Path().glob(pattern)) if path.is_file()]
    return [str(path) for path in paths if _is_simulation(path)]


def _is_simulation(path):
    if path.stat().st_size > _LARGEST_SETTINGS:
        return False
    try:
        return {"tip", "simulation"} <= tomllib.loads(path.read_text(encoding="utf-8")).keys()
    except (OSError, ValueError, RecursionError):
        return False


def _label(path):
    """Path and size of a file."""
    try:
        size = Path(path).stat().st_size
    except OSError:
        return path
    factor, unit = next(((factor, unit) for factor, unit in _UNITS if size >= factor), (1.0, "bytes"))
    return f"{path}   ({size / factor:.3g} {unit})"
