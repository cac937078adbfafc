"""The data sheet of a data set: what it contains, how it was made, and its limits."""

from typing import Any

_HOW = """\
Each run is a specimen whose atoms were field evaporated one after the other (package apt_evap, after Shaikh et al.,
arXiv:2509.13744). The charges of the surface give the field of each atom; the atom with the largest ratio of field to
evaporation field leaves, or one drawn by its rate. Its ion flies through the field of all charges. The emissions add a
velocity at the start. The run is brought to the evaporation field, and an instrument records its ions."""

_LIMITS = """\
* The model is that of the package: its page on limits applies. Above all, the start of the ions (roll-up, lateral
  velocities) is a description, not a result of atomistic dynamics.
* Positions of poles and zone lines are those of directions in the crystal, by the mean image compression of the run.
  Ions near a pole do not lie exactly there. They are missing (NaN) for runs with too few ions.
* Examples of one run share their sequence of evaporation. Parts are therefore separated by specimen.
* Ions that the instrument does not record are not in the data. `number` tells how many atoms evaporated between two."""

_LOAD = """\
```python
import apt_evap as ae

data = ae.load_dataset("FOLDER")
example = data.split("train")[0]
example.ions["x"], example.ions["site"], example.poles["indices"]
```"""


def datasheet(content: dict[str, Any]) -> str:
    """Text of the data sheet in Markdown."""
    settings, counts = content["dataset"], content["counts"]
    parts = [f"# {content['title']}"]
    if settings["description"]:
        parts.append(settings["description"])
    parts += ["## What it contains", _table(("part", "runs", "examples", "ions"), _counts(counts))]
    parts.append(
        "A run is the evaporation of one specimen. An example is what an instrument records of it for one emission. "
        f"Files: {settings['format']}, {settings['runs_per_file']} runs in each at most."
    )
    for name, fields in content["tables"].items():
        rows = [
            (f"`{field['name']}`", field["type"], _shape(field["shape"]), field["unit"], field["description"])
            for field in fields
        ]
        parts += [f"### {name}", _table(("field", "type", "shape of a row", "unit", "meaning"), rows)]
    parts += ["## How it was made", _HOW]
    for name, text in content["study"].items():
        parts += [f"`{name}`:", f"```toml\n{text.strip()}\n```"]
    fractions = ", ".join(f"{fraction:g}" for fraction in settings["split"])
    parts.append(
        f"Fractions for training, validation and test: {fractions}, by a hash of the specimen. All seeds follow from "
        "these files; that of each example is in the table of the examples."
    )
    if content["left_out"]:
        left_out = [f"* {key}: {values}" for key, values in content["left_out"].items()]
        parts += ["Runs that failed and are left out:", "\n".join(left_out)]
    parts += ["## Limits", _LIMITS, "## How to read it", _LOAD]
    parts += ["`sha256sum -c SHA256SUMS` or `apt-evap dataset FOLDER` verifies all files."]
    parts += ["## Licence", settings["licence"], "## Versions"]
    parts.append(_table(("package", "version"), content["versions"].items()))
    return "\n\n".join(parts) + "\n"


def _counts(counts):
    rows = [(name, *(f"{number:,}" for number in row.values())) for name, row in counts.items()]
    sums = zip(*(row.values() for row in counts.values()), strict=True)
    return [*rows, ("all", *(f"{sum(column):,}" for column in sums))]


def _shape(shape):
    return " x ".join(map(str, shape))


def _table(head, rows):
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
