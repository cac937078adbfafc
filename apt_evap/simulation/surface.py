"""The surface of the specimen at the end of a run."""

from apt_evap._common.codec import from_plain
from apt_evap._common.validation import check_kind
from apt_evap.evaporation.charge_settings import ChargeSettings
from apt_evap.evaporation.emitter import Emitter
from apt_evap.evaporation.rule import RULES
from apt_evap.simulation.run import Run
from apt_evap.specimen.tip import Tip


def surface_after(run: Run, n_threads: int | None = None) -> Emitter:
    """Rebuild the surface of the specimen at the end of a run.

    Parameters
    ----------
    run : Run
        A run or a part of one, also from a file.
    n_threads : int, optional
        Number of threads of the emitter.

    Returns
    -------
    Emitter
        With the law `Extremal`. Its charges are relaxed after the last ion; those of the run have an error since their
        last relaxation.

    Raises
    ------
    ValueError
        If the run has no state, its specimen was made from positions, or its charging rule is not one of this package.
    """
    check_kind(run, "run", Run, "a Run")
    if run.state is None:
        raise ValueError(f"{run!r} does not contain the state of its surface")
    rule = from_plain(run.settings["rule"], *RULES, what="the charging rule")
    emitter = Emitter(
        Tip.from_settings(run.settings["tip"]),
        run.voltage,
        settings=from_plain(run.settings["charges"], ChargeSettings),
        n_threads=n_threads,
        rule=rule,
    )
    emitter.restore(run.state)
    if len(run):
        since = len(run.state.sites) - run.first_event - int(run.emissions.ions[0])
        emitter.remove(run.site[max(since, 0) :])
    return emitter
