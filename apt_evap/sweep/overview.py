"""Status of a sweep: states of all points, and the hours that are left."""

import statistics
from typing import Any

from apt_evap.sweep.planning import STATES, Sweep, ions_of
from apt_evap.sweep.study_file import POINTS


def status(sweep: Sweep) -> dict[str, Any]:
    """Status of a sweep in plain types.

    Parameters
    ----------
    sweep : Sweep
        The sweep.

    Returns
    -------
    dict
        folder, points (number), counts (by state), hours_left (of one worker; from the measured speed of finished
        points, before that as foreseen; None if not known), memory (largest of a point that is not done [bytes]) and
        table: for each point its key, values, state, message, tries, ions, n_ions, seconds.
    """
    table, speeds, left, memory = [], [], [], []
    for (point, state), needs in zip(sweep.states(), sweep.foresights, strict=True):
        seconds = sum(claim.end["seconds"] for claim in state.claims if claim.end)
        ions = ions_of(sweep.folder / POINTS / point.key)
        if state.name == "done" and needs.hours and all(claim.end for claim in state.claims):
            speeds.append(seconds / (3600 * needs.hours))
        if state.name in ("open", "running"):
            left.append(None if needs.hours is None else needs.hours * max(0.0, 1 - ions / needs.ions))
        if state.name != "done":
            memory.append(needs.memory or 0.0)
        table.append(
            {
                "key": point.key,
                "values": point.values,
                "state": state.name,
                "message": state.message,
                "tries": state.tries,
                "ions": ions,
                "n_ions": needs.ions,
                "seconds": round(seconds, 3),
            }
        )
    speed = statistics.median(speeds) if speeds else 1.0  # seconds per foreseen second
    hours = None if None in left else speed * sum(hours for hours in left if hours is not None)
    counts = {name: sum(row["state"] == name for row in table) for name in STATES}
    return {
        "folder": str(sweep.folder),
        "points": len(table),
        "counts": counts,
        "hours_left": hours,
        "memory": max(memory, default=0.0),
        "table": table,
    }
