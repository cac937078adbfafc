"""Extended XYZ, a text format of OVITO and ASE: species, position [Angstrom] and other columns of every ion."""

from collections.abc import Sequence

import numpy as np

from apt_evap._common.files import replace_file
from apt_evap._common.types import AnyPath
from apt_evap.detection.hits import Hits
from apt_evap.io._points import numbered, points_and_data

_CHUNK = 1 << 14
_ANGSTROM_PER_NM = 10


def write_xyz(path: AnyPath, hits: Hits, *, species: str | Sequence[str] | None = None) -> None:
    """Write ions as extended XYZ.

    Positions are in Angstrom, with five decimals. All other columns are in the units of `Hits`, with at most nine
    digits for float32 and seventeen for float64, so that reading restores the exact values. Integers beyond 32 bits
    are declared as real numbers, because ASE does not support them. Texts, such as the phases of simulated ions, are
    words with _ for spaces. Ions whose positions are not finite are left out. Ions that missed the detector are
    written.
    """
    chosen, positions, data = points_and_data(path, hits)
    if species is None:  # a name of the user may have several words
        species = _words(hits.extra["element"]) if "element" in hits.extra else "X"
        data.pop("element", None)
    labels = _labels(species, len(hits))
    properties = ["species:S:1", "pos:R:3"]
    formats = ["%s", "%.5f", "%.5f", "%.5f"]
    for name, values in data.items():
        width = 1 if values.ndim == 1 else values.shape[1]
        if values.dtype.kind == "U":
            data[name] = _words(values)
            properties.append(f"{name}:S:1")
            formats.append("%s")
            continue
        # integers of ASE have 32 bits
        is_integer = values.dtype.kind in "iu" and -(2**31) <= values.min() and values.max() < 2**31
        properties.append(f"{name}:{'I' if is_integer else 'R'}:{width}")
        formats += ["%d" if values.dtype.kind in "iu" else "%.17g" if values.dtype.itemsize > 4 else "%.9g"] * width
    row = " ".join(formats) + "\n"
    labels = labels[chosen] if labels.ndim else labels
    n = len(positions)
    with replace_file(path) as file:
        file.write(f'{n}\nProperties={":".join(properties)} pbc="F F F"\n'.encode())
        for start in range(0, n, _CHUNK):
            part = slice(start, min(start + _CHUNK, n))
            rows = part.stop - part.start
            columns = [(labels[part] if labels.ndim else np.full(rows, labels)).tolist()]
            columns += (positions[part].astype(np.float64) * _ANGSTROM_PER_NM).T.tolist()
            for values in data.values():
                columns += values[part].reshape(rows, -1).T.tolist()
            file.write("".join([row % values for values in zip(*columns, strict=True)]).encode())


def _words(texts):
    """Texts as single words."""
    names, numbers = numbered(texts)
    return np.array(["_".join(name.split()) or "_" for name in names], "U")[numbers]


def _labels(species, n):
    labels = np.asarray(species)
    if labels.dtype.kind != "U" or labels.shape not in ((), (n,)):
        raise ValueError(f"species must be a str or one str for each of the {n} ions, got {species!r:.80}")
    for label in np.unique(labels):
        if len(str(label).split()) != 1 or '"' in label:
            raise ValueError(f"species must be single words, got {str(label)!r:.80}")
    return labels
