"""`apt-evap map`: draw detector maps of a run or of measured ions."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap.cli._files import check_output, is_picture, picture_path, read, save_picture, select, selects
from apt_evap.cli._options import SHAPE, add_speech, reading_options, smoothing, tell, tell_json, whole
from apt_evap.config.map_panels import MapSettings, Panel, read_maps
from apt_evap.config.perturbation_text import read_perturbation, title_of
from apt_evap.detection.binning import MAX_BINS
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.emission.perturbations import Unperturbed
from apt_evap.simulation.run import Run


def add_parser(commands: Any) -> None:
    """Describe the command."""
    command = commands.add_parser(
        "map",
        parents=[reading_options()],
        help="draw detector maps of a run or of measured ions",
        description="Draw detector maps of a run or of measured ions, or a map.",
        epilog="example:\n"
        "  apt-evap map R5083.epos --bins 128\n"
        "  apt-evap map R5083.epos --ranges R5083.rrng --species Si --voltage 4000, --circle 15 -o silicon.png\n"
        "  apt-evap map ni111.h5 --perturbation Unperturbed --perturbation RollUp:0.3,0.1 -o energies.png\n\n"
        "a perturbation is NAME, NAME:NUMBERS or a TOML table:\n"
        "  Unperturbed              RollUp:0.2 (eV, all ions)    RollUp:0.155,0.155 (mean, standard deviation)\n"
        "  LateralVelocity:0.3,0.1  Combined:0.155,0.155,0.75 (the last number is the share of the roll-up)\n"
        '  \'{name = "RollUp", energy = {name = "Thermal", temperature = 50}}\'',
        **SHAPE,
    )
    command.add_argument("-o", "--output", metavar="MAP.png", help=".png, .pdf or .svg; default: FILE_map.png, here")
    command.add_argument(
        "--bins", type=whole(1, MAX_BINS), metavar="N", help="along the longer side; default: about sqrt(ions)"
    )
    command.add_argument("--smooth", type=smoothing, metavar="MM", help="sigma of a Gaussian; default: one bin")
    command.add_argument(
        "--perturbation", action="append", metavar="P", help="of the ions of a run; repeat it for maps side by side"
    )
    command.add_argument("--force", action="store_true", help="overwrite a file that apt-evap did not make")
    add_speech(command)
    command.set_defaults(command=_map)


def _map(options):
    picture = picture_path(options.output or f"{Path(options.file).stem}_map.png")
    check_output(picture, is_picture, options.force)
    held = read(options)
    if isinstance(held, Run):
        maps = run_maps(held, _map_settings(held, options), lambda hits: select(hits, options))
    elif options.perturbation:
        what = "a map" if isinstance(held, DetectorMap) else "measured ions"
        raise ValueError(f"--perturbation needs a run (.h5), {options.file!r} holds {what}")
    elif isinstance(held, DetectorMap):
        if options.bins is not None:
            raise ValueError(f"--bins is for ions, {options.file!r} is a map: its bins are {_bins_of(held)}")
        sigma = 0.0 if options.smooth is None and not held.is_counts else options.smooth
        maps = [_smoothed(held, sigma)], [Path(options.file).name]
    elif held.x is None or held.y is None:
        raise ValueError(
            f"{options.file!r} has no detector coordinates x and y, which a map needs, only {', '.join(held.columns)}"
        )
    else:
        chosen = select(held, options)
        drawn = chosen.map(options.bins or _bins_for(np.count_nonzero(chosen.detected)))
        part = f", {len(chosen):,} of {len(held):,} ions" if selects(options) else ""
        maps = [_smoothed(drawn, options.smooth)], [f"{Path(options.file).name}{part}"]
    save_picture(picture, *maps)
    tell(options, f"wrote {picture}")
    tell_json(options, {"wrote": str(picture), "file": options.file, "maps": described(*maps)})
    return 0


def described(maps: Any, titles: Sequence[str]) -> list[dict[str, Any]]:
    """What each map of a picture shows, in plain types: title, ions on it if known, bins, and the smoothing [mm]."""
    return [
        {"title": title, "ions": each.ions, "bins": list(each.values.shape[::-1]), "smoothing": each.smoothing}
        for each, title in zip(maps, titles, strict=True)
    ]


def _map_settings(run, options):
    """Settings of the maps of a run: those given, else those it was made with, else the usual ones."""
    settings = read_maps(run.provenance.get("maps", {}))
    if options.perturbation:
        chosen = [read_perturbation(text) for text in options.perturbation]
        panels = tuple(Panel(title_of(perturbation), perturbation) for perturbation in chosen)
        settings = replace(settings, panels=panels)
    elif "maps" not in run.provenance and run.responses is None:
        flown = tuple(perturbation for perturbation in run.perturbations if not isinstance(perturbation, dict))
        settings = MapSettings(tuple(Panel(title_of(each), each) for each in flown or (Unperturbed(),)))
    if options.bins is not None:
        # what was a good smoothing for other bins is not for these
        settings = replace(settings, bins=options.bins, smoothing=None)
    return settings if options.smooth is None else replace(settings, smoothing=options.smooth)


def run_maps(
    run: Run, settings: MapSettings, choose: Callable[[Hits], Hits] = lambda hits: hits
) -> tuple[list[DetectorMap], list[str]]:
    """Maps of the whole detector, of all ions or those that are chosen, and their titles."""
    half = run.detector.width / 2
    bins = settings.bins or _bins_for(len(run))
    maps = [
        choose(run.hits(panel.perturbation)).map(
            bins,
            extent=(-half, half, -half, half),
            quantum=None,
            mask=np.broadcast_to(True, (bins, bins)),  # the whole detector is simulated, no outline is to be found
        )
        for panel in settings.panels
    ]
    return [_smoothed(each, settings.smoothing) for each in maps], [panel.title for panel in settings.panels]


def _bins_of(drawn):
    return " x ".join(map(str, drawn.values.shape[::-1]))


def _bins_for(ions):
    """Bins along a side: the power of 2 from 32 to 256 that is closest to one ion per bin."""
    return int(2 ** np.clip(np.rint(np.log2(max(ions, 1)) / 2), 5, 8))


def _smoothed(drawn, sigma):
    return drawn.smoothed(max(drawn.bin_size) if sigma is None else sigma)
