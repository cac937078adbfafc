"""Parts of a run: selection of its rows, and parts joined to a run."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from apt_evap._common.validation import short_text, without_mask
from apt_evap.emission.perturbations import described
from apt_evap.simulation.columns import check_sequence_of_ions, columns_of, every_column_of, parts_of
from apt_evap.simulation.history import CapHistory, History
from apt_evap.simulation.provenance import joined
from apt_evap.simulation.run_table import RunTable


def select_rows(run: RunTable, rows: Any) -> dict[str, Any]:
    """Arguments of `Run` that differ for a part of the run with these rows, see `Run.__getitem__`."""
    if not isinstance(rows, slice):
        indices = np.asarray(without_mask(rows, "rows", bool))
        if indices.ndim != 1 or (indices.size and indices.dtype.kind not in "biu"):
            raise ValueError(f"rows must be a slice, a mask or indices such as [5], got {short_text(rows)}")
        rows = indices if indices.size else np.empty(0, int)
    check_sequence_of_ions(run.emissions.ions[rows], "rows")
    arrays = {path: values[rows] for path, values in columns_of(run, every_column_of(run)).items()}
    return parts_of(arrays, run.emissions.nearest_neighbour_distance)


def join_parts(runs: Sequence[RunTable]) -> dict[str, Any]:
    """Arguments of `Run` of the joined parts that differ from those of the first one, see `Run.join`."""
    if not runs:
        raise ValueError("runs must be at least one part of a run, got none")
    first = runs[0]
    for number, run in enumerate(runs):
        if name := _difference(first, run):
            raise ValueError(f"runs must be parts of one run, got runs[{number}] whose {name} differ from runs[0]")
    check_sequence_of_ions(np.concatenate([run.emissions.ions for run in runs]), "ions of the joined runs")
    parts = [columns_of(run, every_column_of(run)) for run in runs]
    arrays = {path: np.concatenate([part[path] for part in parts]) for path in parts[0]}
    return parts_of(arrays, first.emissions.nearest_neighbour_distance) | {
        "history": History.join([run.history for run in runs]),
        "cap": CapHistory.join([run.cap for run in runs]),
        "provenance": joined([run.provenance for run in runs]),
    }


def _difference(one, other):
    """Name of the first property that differs between two parts of one run; "" if there is none."""
    if one is other:
        return ""
    pairs = {
        "settings": (one.settings, other.settings),
        "elements": (one.elements, other.elements),
        "perturbations": tuple([described(flown_as) for flown_as in run.perturbations] for run in (one, other)),
        "responses": (one.responses is None, other.responses is None),
        "real units": (one.units, other.units),
        "columns": tuple([column.path for column in every_column_of(run)] for run in (one, other)),
    }
    return next((name for name, (first, second) in pairs.items() if first is not second and first != second), "")
