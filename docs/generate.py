"""Pages that are made from the package: the API, the commands with their options, and the keys of a settings file."""

import argparse
import ast
import base64
import importlib
import inspect
import io
import json
import re
import tomllib
from pathlib import Path

import matplotlib
import numpy as np
from numpydoc.docscrape import FunctionDoc
from PIL import Image, ImageOps

import apt_evap
from apt_evap._common.codec import declared
from apt_evap.cli.parser import EXIT_CODES, make_parser
from apt_evap.maps.crystallography.directions import direction_normals
from apt_evap.maps.indexing import master_pattern
from apt_evap.studies.dataset.fields import TABLES

HERE = Path(__file__).parent


# thumbnails: a picture, and the part of it that is shown, as left, top, right and bottom fractions
_THUMBNAILS = {
    "map_an_epos": ("articles/common_rules/common_rules.png", (0.335, 0.03, 0.64, 0.49)),
    "mass_spectrum": ("docs/howto/mass_spectrum.png", (0.0, 0.0, 1.0, 1.0)),
    "find_orientation": ("articles/find_the_poles/find_orientation.png", (0.5, 0.06, 1.0, 0.5)),
    "simulate_my_specimen": ("articles/three_metals/three_metals.png", (0.05, 0.03, 0.36, 0.93)),
    "fit_energies": ("articles/hidden_energies/figure3.png", (0.5, 0.0, 1.0, 1.0)),
    "find_radius": ("articles/three_metals/three_metals.png", (0.61, 0.03, 0.88, 0.48)),
    "reconstruct": ("articles/small_specimens/superalloy.png", (0.0, 0.54, 0.47, 1.0)),
    "correct_distortion": ("articles/origins/origins.png", (0.0, 0.0, 0.33, 1.0)),
    "own_structure": ("docs/howto/own_structure.png", (0.0, 0.0, 0.62, 1.0)),
    "examples": ("docs/howto/examples/gamma_prime.png", (0.0, 0.0, 0.56, 0.86)),
    "precipitate_or_boundary": ("docs/howto/precipitate_or_boundary.png", (0.335, 0.04, 1.0, 0.5)),
    "visibility": ("articles/find_the_precipitate/find_the_precipitate.png", (0.34, 0.0, 1.0, 0.485)),
    "real_units": ("articles/microscope/course.png", (0.0, 0.0, 1.0, 1.0)),
    "precipitate_size": ("docs/howto/precipitate_size.png", (0.0, 0.0, 0.5, 1.0)),
    "measure_clusters": ("docs/howto/clusters.png", (0.0, 0.0, 0.5, 0.5)),
    "explore": ("docs/howto/explore.png", (0.0, 0.0, 1.0, 1.0)),
    "sweep": ("articles/three_metals/predictions.png", (0.0, 0.02, 1.0, 0.66)),
    "cluster": ("articles/hidden_energies/figure4.png", (0.0, 0.02, 0.66, 0.5)),
    "data_set": ("articles/find_the_precipitate/find_the_precipitate.png", (0.0, 0.48, 0.66, 1.0)),
    "resume": ("docs/soak.png", (0.0, 0.0, 1.0, 1.0)),
    "from_python": ("docs/ni111.png", (0.46, 0.137, 0.94, 0.98)),
    "convert_files": ("articles/small_specimens/superalloy.png", (0.0, 0.0, 0.44, 0.5)),
    "atlas": ("articles/find_the_poles/master_patterns.png", (0.22, 0.56, 0.435, 0.98)),
}


def thumbnails(folder):
    """Write a small picture for each page of the guides, made from larger ones."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, (source, fractions) in _THUMBNAILS.items():
        with Image.open(HERE.parent / source) as picture:
            edges = [round(part * size) for part, size in zip(fractions, 2 * picture.size, strict=True)]
            part = ImageOps.pad(picture.convert("RGB").crop(edges), (420, 260), color="white")
        path, file = folder / f"{name}.png", io.BytesIO()
        part.quantize(128).save(file, "PNG", optimize=True)
        if not path.exists() or path.read_bytes() != file.getvalue():
            path.write_bytes(file.getvalue())


# pages that explain the names of a namespace
_GUIDES = {
    "detection": "instruments microscope howto/correct_distortion",
    "emission": "emission charge_states extending",
    "evaporation": "charging_rules laws temperature extending_physics",
    "fit": "fits howto/fit_energies howto/simulate_my_specimen",
    "io": "formats",
    "maps": "map_measures howto/find_orientation howto/correct_distortion",
    "measures": "howto/measure_clusters",
    "reconstruction": "reconstruction reconstruction_errors",
    "simulation": "flights howto/resume real_units field_ion_image",
    "specimen": "specimens materials howto/own_structure",
    "spectra": "howto/mass_spectrum charge_states",
    "studies": "howto/sweep howto/data_set howto/visibility",
    "units": "conventions",
}


def namespaces():
    """Public modules of the package: name and module."""
    found = {name: getattr(apt_evap, name) for name in apt_evap.__all__}
    return {name: thing for name, thing in found.items() if inspect.ismodule(thing)}


def api(folder):
    """Write a page for the top-level names, one for each namespace, and their table of contents."""
    spaces = namespaces()
    front = [name for name in apt_evap.__all__ if name not in spaces and name != "__version__"]
    pages = {"apt_evap": ("The names used most. ``import apt_evap as ae``, then ``ae.Tip``.", {"": front})}
    for name, module in spaces.items():
        guides = ", ".join(f":doc:`/{page}`" for page in _GUIDES.get(name, "").split())
        text = f"{_sentence(inspect.getdoc(module).splitlines()[0])} {f'See {guides}.' if guides else ''}".strip()
        pages[f"apt_evap.{name}"] = (text, _by_subject(name, module))
    contents = [".. toctree::", "   :maxdepth: 1", ""]
    for title, (text, subjects) in pages.items():
        lines = [title, "=" * len(title), "", text, "", ".. currentmodule:: apt_evap", ""]
        for subject, names in subjects.items():
            lines += [f".. rubric:: {subject}", ""] if subject else []
            lines += [".. autosummary::", "   :toctree: ..", "", *(f"   {public}" for public in names), ""]
        page = title.replace(".", "_")
        _write(folder / f"{page}.rst", lines)
        contents.append(f"   generated/api/{page}")
    _write(folder / "pages.inc", contents)


def _by_subject(name, module):
    """Public names of a namespace by their subject: those of its modules, then those of each package inside it."""
    subjects = {"": []}
    stub = Path(module.__file__).with_suffix(".pyi")
    if not stub.exists():  # a single module, described as a whole
        return {"": [name]}
    for node in ast.parse(stub.read_text()).body:
        inner = f"{module.__name__}.{node.module.split('.')[0]}"
        inside = (stub.parent / inner.rpartition(".")[2]).is_dir()
        subject = inspect.getdoc(importlib.import_module(inner)).splitlines()[0].rstrip(".") if inside else ""
        subjects.setdefault(subject, []).extend(f"{name}.{item.name}" for item in node.names)
    return {subject: sorted(names) for subject, names in subjects.items() if names}


def commands(path):
    """Write a section for each command of the parser."""
    lines = []
    for name, parser in _subparsers(make_parser()).items():
        lines += _command(f"apt-evap {name}", parser, "-")
        for action, below in _subparsers(parser).items():
            lines += _command(f"apt-evap {name} {action}", below, "~")
    codes = re.findall(r"^  (\d+) +(.*)$", EXIT_CODES, re.MULTILINE)
    _write(path, [*lines, "Exit codes", "----------", "", *_table("10 90", codes)])


def settings(path):
    """Write a section with the keys of each table in settings.toml."""
    lines = []
    for table in tomllib.loads((HERE / "settings.toml").read_text())["table"]:
        module, _, name = table["object"].rpartition(".")
        described = getattr(importlib.import_module(f"apt_evap.{module}".rstrip(".")), name)
        rows = [("Key", "Value", "Default", "Meaning"), *_keys(described)]
        text = f"{table['text'].strip()} In Python: `{table['object']}`."
        lines += [table["title"], "-" * len(table["title"]), "", text, "", *_table("15 20 15 50", rows, 1)]
    _write(path, lines)


def dataset_fields(path):
    """Write a table of the fields for each table of a data set."""
    lines = []
    for name, fields in TABLES.items():
        rows = [("Field", "Type", "Shape of a row", "Unit", "Meaning")]
        for field in fields:
            rows.append((f"``{field.name}``", field.kind, str(field.row) if field.row else "", field.unit, field.text))
        lines += [f".. rubric:: {name}", "", *_table("15 10 12 8 55", rows, 1)]
    _write(path, lines)


def materials(path):
    """Write a table of the known materials."""
    rows = [("Material", "Structure", "a, c [nm]", "Field [V/nm]", "Charge [e]", "Mass [Da]", "Cohesive energy [eV]")]
    for entry in apt_evap.specimen.materials.MATERIALS.values():
        lengths = f"{entry.a:.3f}" if entry.c is None else f"{entry.a:.3f}, {entry.c:.3f}"
        computed = " (computed)" if "computed" in entry.sources["evaporation_field"] else ""
        field = f"{entry.evaporation_field:g}{computed}"
        numbers = (str(entry.charge_state), f"{entry.mass:g}", f"{entry.cohesive_energy:.2f}")
        rows.append((entry.name, entry.structure, lengths, field, *numbers))
    _write(path, _table("10 12 14 20 10 14 20", rows, 1))


def atlas(path):
    """Write the page of the atlas: the master patterns as pictures, poles and zone axes of each crystal."""
    crystals = {}
    for element in ("Ni", "W", "Si", "Ti"):
        material = apt_evap.material(element)
        hexagonal = material.structure == "hcp"
        poles, zones = apt_evap.maps.poles(material, 7), apt_evap.maps.zones(material)
        views = {"[0001]": (0, 0, 0, 1), "[10-10]": (1, 0, -1, 0), "[11-20]": (1, 1, -2, 0)} if hexagonal else {
            "[001]": (0, 0, 1), "[011]": (0, 1, 1), "[111]": (1, 1, 1), "[112]": (1, 1, 2)}  # fmt: skip
        normals = direction_normals(material, list(views.values()))
        crystals[material.structure] = {
            "name": f"{material.structure} ({element})",
            "radii": {
                f"{pattern.apex_radius:g}": [_png(each) for each in pattern.smoothed(0.3)]
                for pattern in apt_evap.maps.master_patterns(material.structure)
            },
            "poles": [
                [*normal.round(5).tolist(), "".join(f"{abs(i)}\u0305" if i < 0 else str(i) for i in plane.tolist()),
                 round(float(spacing / poles.spacings.max()), 3)]
                for normal, plane, spacing in zip(poles.normals, poles.planes, poles.spacings, strict=True)
            ],
            "zones": [
                [*axis.round(5).tolist(), int(family)]
                for axis, family in zip(zones.directions, zones.families, strict=True)
            ],
            "axes": [[label, axis.round(5).tolist()] for label, axis in zip(views, normals, strict=True)],
        }  # fmt: skip
    colours = (matplotlib.colormaps["inferno"](range(256))[:, :3] * 255).round().astype("uint8")
    text = (HERE / "atlas.html").read_text()
    for name, value in {
        "DATA": json.dumps(crystals, ensure_ascii=False),
        "HALF": master_pattern.HALF,
        "PIXEL": repr(master_pattern.PIXEL),
        "BRIGHTEST": repr(master_pattern.BRIGHTEST),
        "COLOURS": base64.b64encode(colours.tobytes()).decode(),
    }.items():
        text = text.replace(f"@{name}@", str(value))
    _write(path, text.splitlines())


def _png(densities):
    """Square roots of densities in 64 levels of grey, as a PNG in base64."""
    levels = (np.sqrt(np.clip(densities, 0, master_pattern.BRIGHTEST) / master_pattern.BRIGHTEST) * 63).round() * (
        255 / 63
    )
    file = io.BytesIO()
    Image.fromarray(levels.round().astype("uint8")).save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def _keys(described):
    """Key, type with unit and bounds, default and text of each parameter that a file can contain."""
    defaults = inspect.signature(described).parameters
    known = declared(described)
    entries = [(name, _value(each.kind, each.unit, each.bounds), each.text) for name, each in known.items()]
    if not known:
        entries = [
            (name, _value(kind.removesuffix(", optional"), "", ""), " ".join(words))
            for name, kind, words in FunctionDoc(described)["Parameters"]
            if name != "phases"  # a table of its own
        ]
    return [(f"``{name}``", value, _default(defaults[name].default), text) for name, value, text in entries]


# types as they are called in TOML
_TYPES = {
    r"sequence of float, shape \((\d+),\)": r"list of \1 numbers",
    r"(sequence|tuple) of float": "list of numbers",
    r"(sequence|tuple) of int": "list of integers",
    r"(sequence|tuple) of (\w+)": r"list of \2",
    r"\bfloat\b": "number",
    r"\bint\b": "integer",
    r"\bbool\b": "true or false",
    r"\bstr\b": "text",
    r"\bmapping\b": "table",
    r" or callable\b|[{}]": "",
}


def _value(kind, unit, bounds):
    for written, plain in _TYPES.items():
        kind = re.sub(written, plain, kind)
    return ", ".join(filter(None, (f"{kind} [{unit}]" if unit else kind, _short(bounds))))


def _short(number):
    """Text of numbers with exponents as a user writes them: 1e6, 1e-5."""
    return re.sub(r"e([+-])0?", lambda found: f"e{found[1]}".rstrip("+"), number)


def _subparsers(parser):
    found = [action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return found[0] if found else {}


def _command(title, parser, underline):
    """Description, usage, options by group, and examples of a command."""
    lines = [f".. program:: {title}", "", title, underline * len(title), "", _sentence(parser.description), ""]
    if not _subparsers(parser):
        lines += _block(parser.format_usage().removeprefix("usage: "))
    for group in parser._action_groups:
        actions = [each for each in group._group_actions if not isinstance(each, _NOT_SHOWN)]
        if actions and group.title not in ("positional arguments", "options"):
            lines += [f".. rubric:: {group.title[0].upper()}{group.title[1:]}", "", _sentence(group.description), ""]
        for action in actions:
            lines += [f".. option:: {_signature(action)}", "", f"   {_sentence(action.help or 'required')}", ""]
    return lines + _block(parser.epilog or "")


_NOT_SHOWN = (argparse._SubParsersAction, argparse._HelpAction)


def _signature(action):
    value = action.metavar or ("{" + ",".join(action.choices) + "}" if action.choices else action.dest)
    value = "" if action.nargs == 0 else f"[{value}]" if action.nargs == "?" else value
    return ", ".join(f"{name} {value}".rstrip() for name in action.option_strings) or value


def _sentence(text):
    """Text of the help as a sentence, with options and commands in double quotes."""
    text = re.sub(r"([*|`\\])", r"\\\1", " ".join((text or "").split()))
    text = re.sub(r"(?<![\w/-])(--?[a-z][\w-]*|pip install '[^']*')", r"``\1``", text)
    return text[:1].upper() + text[1:] + ("." if text and text[-1] not in ".:," else "")


def _block(text):
    lines = [f"    {line}".rstrip() for line in text.rstrip().splitlines()]
    return [".. code-block:: text", "", *lines, ""] if lines else []


def _default(value):
    """Default of a parameter as it is written in TOML; empty if it is None or an object."""
    if value is inspect.Parameter.empty:
        return "required"
    if isinstance(value, bool):
        return f"``{str(value).lower()}``"
    if isinstance(value, tuple) and all(isinstance(each, int | float) for each in value):
        return f"``{list(value)}``"
    if isinstance(value, float):
        return f"``{_short(repr(value) if value < 1e6 else f'{value:g}')}``"
    return f'``"{value}"``' if isinstance(value, str) else f"``{value}``" if isinstance(value, int) else ""


def _table(widths, rows, heads=0):
    lines = [".. list-table::", f"   :header-rows: {heads}", f"   :widths: {widths}", ""]
    for row in rows:
        lines += [f"   {' ' if column else '*'} - {cell}" for column, cell in enumerate(row)]
    return [*lines, ""]


def _write(path, lines):
    """Write a page that has changed: Sphinx reads only these again."""
    text = "\n".join(lines).rstrip() + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text() != text:
        path.write_text(text)
