"""
Find the precipitate: a baseline on the data set
================================================

    apt-evap dataset study.toml -o set --workers 2
    python baseline.py set

The hits are reconstructed with the true constants. Two classical methods mark ions as those of a precipitate:

* composition: the Cu fraction of the k nearest ions, with the ion itself, is larger than c;
* separation: a Cu ion with n Cu ions closer than d is a core, as in DBSCAN, and all ions closer to a core than e belong
  to a precipitate. Lengths are in units of the mean distance of Cu ions.

Their parameters are those with the best score on the training split: the mean F1 of the three sizes. The script prints
precision and recall on the test split, also at the true sites, with errors from a bootstrap of the tips. It writes
table.json and find_the_precipitate.png.
"""

import argparse
import json
import time
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import apt_evap as ae

ALUMINIUM = ae.material("Al")
ATOMIC_VOLUME = ALUMINIUM.a**3 / 4
SIZES = (0.5, 1.0, 2.0)  # nm
FIELDS = ((0.8, 0.93), (0.93, 1.07), (1.07, 1.2))  # of the precipitates, relative to that of the matrix
FRACTIONS = ((0.2, 0.4), (0.4, 0.6))  # Cu in the precipitates
PLACES = ("measured", "sites")
NEAR = 1.0  # nm: a wrong ion counts for the precipitate within this distance
FEWEST = 5  # recorded ions of a precipitate that counts
GRIDS = {
    "composition": {"k": (5, 10, 15, 20, 30, 40, 60, 80), "c": np.arange(0.04, 0.41, 0.02).round(2).tolist()},
    "separation": {"d": (0.45, 0.6, 0.8, 1.0, 1.2), "n": (1, 2, 3, 4, 6, 9, 13, 18), "e": (0.15, 0.25, 0.35, 0.5, 0.7)},
}


class Specimen:
    """What a user has of an example, and the truth."""

    def __init__(self, example):
        about, hits = example.about, example.hits
        instrument = about["instrument"]
        reconstruction = ae.reconstruct(
            hits,
            atomic_volume=ATOMIC_VOLUME,
            distance=instrument["distance"],
            detector_radius=instrument["field_of_view"] / 2,
            efficiency=instrument["efficiency"],
            projection="compressed",
            compression=about["compression"],
            radius=float(np.median(example.cap["radius"])),
        )
        own = reconstruction.hits
        self.run, self.emission = about["run"], emission_name(about["emission"])
        self.measured, self.sites = reconstruction.positions, own.positions
        self.copper = np.array(about["elements"])[own.extra["species"]] == "Cu"  # not the species: it tells the phase
        self.truth = own.extra["phase"] == 1
        phase, matrix = about["settings"]["phases"][1], about["settings"]["phases"][0]
        self.field = phase["evaporation_field"] / matrix["evaporation_field"]
        self.fraction = phase["solutes"]["Cu"]
        self.spacing = (ATOMIC_VOLUME / instrument["efficiency"] / max(self.copper.mean(), 1e-3)) ** (1 / 3)
        self.spheres = sorted(phase["region"]["regions"], key=lambda sphere: -sphere["radius"])
        self.number = np.full(len(self.truth), -1)  # of the sphere of an ion; the largest one in an overlap
        self.size = np.zeros(len(self.truth))
        for number, sphere in reversed(list(enumerate(self.spheres))):
            within = np.linalg.norm(self.sites - sphere["centre"], axis=1) < sphere["radius"] + 1e-3
            self.number[within & self.truth] = number
            self.size[within & self.truth] = sphere["radius"]

    @cache  # noqa: B019
    def nearest(self, place):
        """Size and distance of the nearest ion of a precipitate, for each ion."""
        positions = getattr(self, place)
        if not self.truth.any():
            return np.zeros(len(positions)), np.full(len(positions), np.inf)
        distance, index = cKDTree(positions[self.truth]).query(positions)
        return self.size[self.truth][index], distance


def emission_name(emission):
    """Name of an emission, also for a part of the ions."""
    return emission["name"] + (" of a part" if emission.get("probability", 1) < 1 else "")


def composition(positions, specimen, settings):
    """Whether the Cu fraction of the k nearest ions of each ion is larger than c."""
    for k in settings["k"]:
        _, nearest = cKDTree(positions).query(positions, list(range(1, k + 1)))
        fraction = specimen.copper[nearest].mean(axis=1)
        for c in settings["c"]:
            yield {"k": k, "c": c}, fraction > c


def separation(positions, specimen, settings):
    """Whether each ion is close to a Cu ion that has n other Cu ions closer than d, for each n and e."""
    copper = positions[specimen.copper]
    tree = cKDTree(copper)
    for d in settings["d"]:
        others = tree.query_ball_point(copper, d * specimen.spacing, return_length=True) - 1
        for n in settings["n"]:
            core = copper[others >= n]
            distance = cKDTree(core).query(positions)[0] if len(core) else np.full(len(positions), np.inf)
            for e in settings["e"]:
                yield {"d": d, "n": n, "e": e}, distance < e * specimen.spacing


METHODS = {"composition": composition, "separation": separation}


def counts(specimen, marked, place):
    """Counts of ions by name: right, marked and true ones of each size, and wrong ones far from all precipitates."""
    wrong, row = marked & ~specimen.truth, {}
    nearest, distance = specimen.nearest(place)
    row["far"], row["matrix"] = np.sum(wrong & (distance > NEAR)), np.sum(~specimen.truth)
    row["right"], row["marked"], row["true"] = np.sum(marked & specimen.truth), marked.sum(), specimen.truth.sum()
    for size in SIZES:
        own = specimen.truth & (specimen.size == size)
        row[f"right {size:g}"], row[f"true {size:g}"] = np.sum(own & marked), own.sum()
        row[f"marked {size:g}"] = np.sum(own & marked) + np.sum(wrong & (distance <= NEAR) & (nearest == size))
    return row


def precipitates(specimen, marked):
    """Number of precipitates of each size, and of those with at least half of their ions marked."""
    row = {}
    for size in SIZES:
        numbers = np.unique(specimen.number[specimen.truth & (specimen.size == size)])
        ions = [each for each in (specimen.number == n for n in numbers) if each.sum() >= FEWEST]
        row[f"precipitates {size:g}"] = len(ions)
        row[f"found {size:g}"] = sum(marked[each].mean() >= 0.5 for each in ions)
    return row


def score(total):
    """Mean F1 of the three sizes: wrong ions far from all precipitates count for each of them."""
    parts = [
        2 * total[f"right {size:g}"] / max(1, total[f"marked {size:g}"] + total["far"] + total[f"true {size:g}"])
        for size in SIZES
    ]
    return float(np.mean(parts))


def chosen(method, specimens, place):
    """Parameters with the best score, and this score."""
    totals = {}
    for specimen in specimens:
        for parameters, marked in METHODS[method](getattr(specimen, place), specimen, GRIDS[method]):
            totals.setdefault(json.dumps(parameters), Counter()).update(counts(specimen, marked, place))
    best = max(totals, key=lambda each: score(totals[each]))
    return json.loads(best), score(totals[best])


def bootstrap(rows, runs, function, draws=300):
    """A function of the sums of the counts, and its standard deviation from a bootstrap of the tips."""
    tips = {}
    for row, run in zip(rows, runs, strict=True):
        tips.setdefault(run, Counter()).update(row)
    names, table = list(rows[0]), np.array([[each[name] for name in rows[0]] for each in tips.values()], float)
    picks = np.random.default_rng(0).integers(len(table), size=(draws, len(table)))
    values = [function(dict(zip(names, table[pick].sum(axis=0), strict=True))) for pick in (..., *picks)]
    return values[0], float(np.nanstd(values[1:])) if np.isfinite(values[1:]).any() else np.nan


def ratio(rows, runs, first, second):
    """Ratio of two sums, and its error."""
    return bootstrap(rows, runs, lambda total: total[first] / total[second] if total[second] else np.nan)


def results(rows, runs):
    """Precision, recall and share of the precipitates found, by size; and the score. Each with its error."""
    names = (("precision", "right", "marked"), ("recall", "right", "true"), ("found", "found", "precipitates"))
    table = {
        f"{size:g}": {name: ratio(rows, runs, f"{up} {size:g}", f"{down} {size:g}") for name, up, down in names}
        for size in SIZES
    }
    table["all"] = {name: ratio(rows, runs, up, down) for name, up, down in names[:2]}
    return table | {"score": bootstrap(rows, runs, score), "far": ratio(rows, runs, "far", "matrix")}


def recall_of(size):
    """Recall of a size, as a function of the counts."""
    return lambda total: total[f"right {size}"] / total[f"true {size}"] if total[f"true {size}"] else np.nan


def difference(rows, runs, function):
    """A function of the counts: that of the first place minus that of the second one, with the error for equal tips."""
    keys = list(rows[0][0])
    both = [
        {(place, key): row[key] for place, row in enumerate(pair) for key in keys} for pair in zip(*rows, strict=True)
    ]
    one = [lambda total, place=place: function({key: total[place, key] for key in keys}) for place in (0, 1)]
    return bootstrap(both, runs, lambda total: one[0](total) - one[1](total))


def groups(specimens):
    """Specimens by field, composition and emission."""
    found = {"all": specimens}
    found |= {f"field {low:g} to {high:g}": [s for s in specimens if low <= s.field <= high] for low, high in FIELDS}
    found |= {f"Cu {low:g} to {high:g}": [s for s in specimens if low <= s.fraction <= high] for low, high in FRACTIONS}
    found |= {name: [s for s in specimens if s.emission == name] for name in sorted({s.emission for s in specimens})}
    return {name: members for name, members in found.items() if members}


def cells(pairs):
    """Cells of a table."""
    return " | ".join("–" if np.isnan(value) else f"{value:.2f} ± {error:.2f}" for value, error in pairs)


def report(specimens, marks):
    """Print the table of a method, and return it.

    Columns: precipitates; precision, recall and share found at the first of `PLACES`, and at the second one; difference
    of both recalls. For all ions: tips; precision, recall and score, and the difference of both scores.
    """
    rows = {
        place: {s: counts(s, m, place) | precipitates(s, m) for s, m in zip(specimens, marks[place], strict=True)}
        for place in PLACES
    }
    table = {}
    for name, members in groups(specimens).items():
        runs = [s.run for s in members]
        own = [[rows[place][s] for s in members] for place in PLACES]
        both = [results(each, runs) for each in own]
        table[name] = dict(zip(PLACES, both, strict=True))
        for size in map("{:g}".format, SIZES):
            number = sum(each[f"precipitates {size}"] for each in own[0])
            change = difference(own, runs, recall_of(size))
            parts = (cells(one[size].values()) for one in both)
            print(f"| {name} | {size} | {number} |", " | ".join([*parts, cells([change])]), "|")
        parts = (f"{cells(one['all'].values())} | {cells([one['score']])}" for one in both)
        change = difference(own, runs, score)
        print(f"| {name} | all | {len(set(runs))} tips |", " | ".join([*parts, cells([change])]), "|")
    for place in PLACES:
        value, error = table["all"][place]["far"]
        print(f"far from all precipitates, {place}: {100 * value:.3f} ± {100 * error:.3f} % of the matrix")
    return table


def draw(specimens, marks, path):
    """View along the axis of three specimens, one for each field: the precipitates, and what is marked."""
    figure = ae.plot.new_figure((9.0, 5.8))
    figure.set_layout_engine("constrained")
    panels = figure.subplots(2, 3, sharex=True, sharey=True)
    for column, (low, high) in enumerate(FIELDS):
        both = [(s, m) for s, m in zip(specimens, marks, strict=True) if low <= s.field <= high]
        if not both:
            continue
        s, marked = max(both, key=lambda pair: (len(np.unique(pair[0].size)), pair[0].emission == "RollUp of a part"))
        parts = (
            [(f"{size:g} nm", s.size == size) for size in SIZES],
            [("wrong", marked & ~s.truth), ("right", marked & s.truth), ("missed", s.truth & ~marked)],
        )
        for ax, part, colours in zip(panels[:, column], parts, (("C0", "C1", "C3"), ("k", "C2", "C9")), strict=True):
            ax.scatter(*s.measured[:, :2].T, s=0.3, color="0.7")
            for (name, ions), colour in zip(part, colours, strict=True):
                ax.scatter(*s.measured[ions, :2].T, s=3, color=colour, label=name)
            ax.set(aspect="equal", ylabel="" if column else "y [nm]")
            if not column:
                ax.legend(fontsize="x-small", loc="upper left", markerscale=3)
        panels[0, column].set_title(f"field {s.field:.2f}, {s.fraction:.0%} Cu", fontsize="medium")
        panels[1, column].set_xlabel("x [nm]")
    figure.savefig(path, dpi=80)


def main():
    """Choose the parameters, and score the methods."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path, help="folder of the data set")
    parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder for the table and the picture")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    start = time.process_time()
    data = ae.load_dataset(options.set)
    train, test = ([Specimen(example) for example in data.split(name)] for name in ("train", "test"))
    for name, part in (("train", train), ("test", test)):
        ions = sum(len(s.truth) for s in part)
        print(f"{name}: {len({s.run for s in part})} tips, {len(part)} examples, {ions:,} ions")
    table = {}
    for method, function in METHODS.items():
        marks, settings = {}, {}
        for place in PLACES:
            settings[place], best = chosen(method, train, place)
            print(f"\n{method}, {place}: {settings[place]}, score on the training split {best:.2f}")
            one = {name: [value] for name, value in settings[place].items()}
            marks[place] = [next(function(getattr(s, place), s, one))[1] for s in test]
        table[method] = {"settings": settings, "scores": report(test, marks)}
        if method == "composition":
            draw(test, marks["measured"], options.output / "find_the_precipitate.png")
    (options.output / "table.json").write_text(json.dumps(table, indent=1))
    print(f"\n{time.process_time() - start:.0f} s of processor time")


if __name__ == "__main__":
    main()
