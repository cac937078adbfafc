"""Scores of answers to the benchmark: ``python score.py TRUTH ANSWERS [ANSWERS ...] [-o TABLE.csv]``.

TRUTH is a folder with ``NAME.h5``, each folder of ANSWERS has ``NAME.csv`` and ``NAME_positions.csv``, or ``NAME.h5``.
A .csv has the columns ``quantity,value`` and perhaps ``error``, that of positions ``x,y,z``; an .h5 file a data set for
each quantity, with the value or the value and its error, and ``positions``. Lengths are in nm, shares in at.%. See
docs/ground_truth.rst. Needs NumPy and h5py only.
"""

import argparse
import csv
import json
import sys
from pathlib import Path

import h5py
import numpy as np

TASKS = {
    "axis": ("angle from the true axis", "degrees"),
    "constants": ("difference of a constant from the best one", "%"),
    "lateral": ("RMS error of the positions across the axis", "nm"),
    "depth": ("RMS error of the positions along the axis", "nm"),
    "composition": ("difference of a share", "at.%"),
    "number": ("precipitates or clusters too many or too few", "clusters"),
    "structure": ("difference of a size, a spacing or an excess", "%"),
}
"""Tasks, what is measured of each, and its unit: the positions have two numbers."""

DRAWS = 2000


def read_answers(folder, name):
    """Values with errors by quantity, and positions or None.

    Errors that are not stated are NaN; a component of the axis is a quantity, ``axis h``, ``axis k`` and ``axis l``.
    """
    values, positions = {}, None
    if (path := folder / f"{name}.h5").exists():
        with h5py.File(path) as file:
            for quantity, item in file.items():
                if quantity == "positions":
                    positions = item[()].astype(float)
                else:
                    numbers = np.atleast_1d(item[()]).astype(float)
                    values[quantity] = (numbers[0], numbers[1] if len(numbers) == 2 else np.nan)
    if (path := folder / f"{name}.csv").exists():
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                try:
                    value, error = float(row["value"]), float(row.get("error") or "nan")
                    values[row["quantity"].strip()] = (value, error)
                except (KeyError, TypeError, ValueError):
                    raise SystemExit(
                        f"{path} must have the columns quantity, value and perhaps error, with numbers, got {row}"
                    ) from None
    if (path := folder / f"{name}_positions.csv").exists():
        try:
            positions = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
        except ValueError as error:
            raise SystemExit(f"{path} must have a line x,y,z and three numbers a line: {error}") from None
    return values, positions


def read_truth(path):
    """Answers, sites of the recorded ions, and whether the seed is withheld."""
    with h5py.File(path) as file:
        return json.loads(file.attrs["answers"]), file["positions"][()], bool(file.attrs["withheld"])


def axis_angle(found, true):
    """Angle between two directions of a cubic crystal, whichever of the equivalent ones are named [degrees]."""
    first, second = (np.sort(np.abs(vector)) / np.linalg.norm(vector) for vector in (found, true))
    return float(np.degrees(np.arccos(np.clip(first @ second, -1, 1))))


def position_errors(positions, sites):
    """RMS errors across and along the axis after the shift and the turn about the axis that fit best [nm].

    Ions without a position have NaN; at least half must have one, else the errors are NaN.
    """
    if positions.shape != sites.shape:
        raise SystemExit(f"positions must have one row of x, y and z for each of {len(sites):,} ions, got "
                         f"{' x '.join(map(str, positions.shape))}")  # fmt: skip
    rows = np.isfinite(positions).all(axis=1)
    if rows.mean() < 0.5:
        return np.nan, np.nan
    first, second = (part[rows] - part[rows].mean(axis=0) for part in (positions, sites))
    plane, true = first[:, 0] + 1j * first[:, 1], second[:, 0] + 1j * second[:, 1]
    product = np.vdot(plane, true)
    turn = product / abs(product) if abs(product) else 1.0
    lateral = np.sqrt(np.mean(np.abs(plane * turn - true) ** 2))
    return float(lateral), float(np.sqrt(np.mean((first[:, 2] - second[:, 2]) ** 2)))


def task_of(quantity):
    """Task that a quantity of the truth belongs to."""
    if quantity in ("axis", "number"):
        return quantity
    if quantity in ("apex radius", "compression"):
        return "constants"
    return "composition" if " of " in quantity else "structure"


def score_specimen(values, positions, answers, sites):
    """Rows (task, quantity, error, whether 1.96 stated errors hold the truth) of a specimen; NaN without answer."""
    rows = []
    for quantity, true in answers.items():
        task, error, held = task_of(quantity), np.nan, np.nan
        if task == "axis":
            found = [values.get(f"axis {index}", (np.nan, np.nan))[0] for index in "hkl"]
            if np.isfinite(found).all() and np.any(found):
                error = axis_angle(np.array(found), np.array(true))
        elif quantity in values and np.isfinite(values[quantity][0]):
            value, stated = values[quantity]
            error = abs(value - true)
            if stated >= 0:  # a stated error of 0 is one, too
                held = float(error <= 1.96 * stated)
            if task in ("constants", "structure"):
                error *= 100 / abs(true)
        rows.append((task, quantity, error, held))
    lateral, depth = (np.nan, np.nan) if positions is None else position_errors(positions, sites)
    return [*rows, ("lateral", "positions", lateral, np.nan), ("depth", "positions", depth, np.nan)]


def interval(values, seed=0):
    """95 % interval of a median over specimens, by drawing specimens: each is a list of its errors."""
    random = np.random.default_rng(seed)
    errors, specimen = np.concatenate(values), np.repeat(np.arange(len(values)), [len(part) for part in values])
    order = np.argsort(errors)
    chosen = random.integers(len(values), size=(DRAWS, len(values)))
    times = np.count_nonzero(chosen[:, :, None] == np.arange(len(values)), axis=1)  # that a specimen is drawn
    up_to = np.cumsum(times[:, specimen[order]], axis=1)  # errors drawn, up to each in their order
    middle = (up_to[:, -1:] - [[1, 0]]) // 2
    places = np.count_nonzero(up_to[:, None] <= middle[:, :, None], axis=2)
    drawn = errors[order][places].mean(axis=1)
    return tuple(np.quantile(drawn, (0.025, 0.975)).tolist())


def score(truth, folder):
    """Rows (specimen, withheld, task, quantity, error, held) of a folder of answers."""
    paths = sorted(truth.glob("*.h5"))
    if not paths:
        raise SystemExit(f"{truth} must be a folder with the .h5 files of the truth, got none")
    rows = []
    for path in paths:
        answers, sites, withheld = read_truth(path)
        parts = score_specimen(*read_answers(folder, path.stem), answers, sites)
        rows += [(path.stem, withheld, *part) for part in parts]
    return rows


def summary(rows):
    """Lines (task, answered, asked, median, its interval, largest, held, stated), public and withheld."""
    lines = []
    for withheld in (False, True):
        for task in TASKS:
            chosen = [row for row in rows if row[1] == withheld and row[2] == task]
            known = [row for row in chosen if np.isfinite(row[4])]
            held = [row[5] for row in known if np.isfinite(row[5])]
            line = {"withheld": withheld, "task": task, "unit": TASKS[task][1], "asked": len(chosen)}
            line |= {"answered": len(known), "held": int(sum(held)), "stated": len(held)}
            if known:
                names = dict.fromkeys(row[0] for row in known)
                errors = [np.array([row[4] for row in known if row[0] == name]) for name in names]
                low, high = interval(errors)
                every = np.concatenate(errors)
                line |= {"median": float(np.median(every)), "low": low, "high": high, "largest": float(every.max())}
            lines.append(line)
    return lines


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", type=Path)
    parser.add_argument("answers", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, help="write all lines to this .csv")
    parser.add_argument("--all", action="store_true", help="print each answer, the largest error of each task first")
    options = parser.parse_args(arguments)
    table = []
    for folder in options.answers:
        rows = score(options.truth, folder)
        print(f"{folder.name}: median error [95 % interval], largest; answers of questions; intervals that hold")
        for line in summary(rows):
            if not line["asked"]:
                continue
            table.append({"answers": folder.name} | line)
            head = f"  {'withheld' if line['withheld'] else 'public':9}{line['task']:12}"
            if not line["answered"]:
                print(f"{head}no answer of {line['asked']}")
                continue
            numbers = f"{line['median']:8.3g} [{line['low']:.3g}, {line['high']:.3g}], {line['largest']:.3g} "
            counts = f"{line['unit']}; {line['answered']} of {line['asked']}; {line['held']} of {line['stated']}"
            print(head + numbers + counts)
        if options.all:
            for name, _, task, quantity, error, _ in sorted(
                rows, key=lambda row: (row[2], -np.nan_to_num(row[4], nan=-1))
            ):
                print(f"    {task:12} {name:20} {quantity:18} {error:.4g} {TASKS[task][1]}")
    if options.output:
        with options.output.open("w", newline="") as file:
            writer = csv.DictWriter(
                file, table[0] | {"median": 0, "low": 0, "high": 0, "largest": 0}, lineterminator="\n"
            )
            writer.writeheader()
            writer.writerows(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
