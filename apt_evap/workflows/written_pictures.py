"""Pictures of maps as files with the mark of this package, and files that never replace those of other programs."""

import io
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from apt_evap import plot
from apt_evap._common.files import FileError, check_path, open_for_reading, replace_file
from apt_evap._common.types import AnyPath
from apt_evap._common.version import __version__
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.orientation import Orientation

DPI = 200
"""Resolution of the pictures [dots per inch]."""
_MARK = f"apt_evap {__version__}"
_MARK_RANGE = 1 << 16  # bytes: the mark is at the beginning of a .png or .svg, and at the end of a .pdf
_MARK_KEYS = {".png": "Software", ".pdf": "Creator", ".svg": "Creator"}


def picture_path(path: AnyPath) -> Path:
    """Path of a picture; FileError if its suffix is not that of one."""
    path = check_path(path)
    if path.suffix.lower() not in _MARK_KEYS:
        raise FileError(f"a picture is a {', '.join(_MARK_KEYS)} file, got {str(path)!r}")
    return path


def save_picture(
    path: Path,
    maps: Sequence[DetectorMap],
    titles: Sequence[str],
    title: str | None = None,
    crystal: tuple[Orientation, Projection] | None = None,
    *,
    width: float | None = None,
    phases: Sequence[Mapping[str, DetectorMap]] = (),
    **colors: Any,
) -> str:
    """Draw maps side by side into a file, perhaps with the poles of a crystal; return what `save_figure` does.

    With a width [mm] the figure is one of a paper, without titles and outlines of `phase_maps`. `colors` are
    ``colormap`` and ``label``.
    """
    from apt_evap.detection.color_limits import common_limits  # with Matplotlib
    from apt_evap.plot._labels import legend_below
    from apt_evap.plot.phase_outlines import phase_outlines

    if width is None:
        axes = plot.detector_maps(maps, titles, limits=common_limits(maps), title=title, **colors)
    else:
        axes = plot.paper_maps(maps, width, **colors)
    if crystal is not None:
        for ax, detector_map in zip(axes, maps, strict=True):
            plot.poles(ax, *crystal, region=detector_map, families=8, size=9 if width is None else 6)
    if width is None:
        if phases:
            phase_outlines(list(axes), maps, phases)
        legend_below(list(axes))
    return save_figure(path, axes[0].figure)


def save_figure(path: Path, figure: Any) -> str:
    """Write a figure; return "wrote PATH" or "replaced PATH".

    It is drawn in memory, so that a kill in the second that it takes leaves no temporary file.
    """
    suffix, drawn = path.suffix.lower(), io.BytesIO()
    try:
        figure.savefig(drawn, format=suffix[1:], dpi=DPI, metadata={_MARK_KEYS[suffix]: _MARK})
    except OSError as error:  # such as a font that cannot be read
        raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error
    done = "replaced" if path.exists() else "wrote"
    with replace_file(path) as file:
        file.write(drawn.getbuffer())
    return f"{done} {path}"


def is_picture(path: Path) -> bool:
    """Whether a picture has the mark of this package, near its beginning or its end."""
    with open_for_reading(path) as file:
        beginning = file.read(_MARK_RANGE)
        file.seek(max(0, path.stat().st_size - _MARK_RANGE))
        return b"apt_evap" in beginning or b"apt_evap" in file.read(_MARK_RANGE)


def check_output(path: AnyPath, is_ours: Callable[[Path], bool], overwrite: bool) -> None:
    """Check that a file can be written, and that no file of another program would be overwritten."""
    target = Path(os.path.realpath(path))
    try:
        if target.is_dir():
            raise IsADirectoryError(None, "Is a directory")
        with tempfile.TemporaryFile(dir=target.parent):
            pass
        if target.exists():
            if not target.is_file():
                raise OSError(None, "Not a regular file")
            if not overwrite:
                with open_for_reading(path):
                    pass  # the origin of an unreadable file is not known
                if not is_ours(target):
                    remedy = "--force overwrites it (overwrite=True in Python)"
                    raise FileError(f"{str(path)!r} exists and was not made by apt-evap: {remedy}")
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error
