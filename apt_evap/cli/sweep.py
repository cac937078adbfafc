"""`apt-evap sweep`: plan, run and collect many simulations of one study file."""

import argparse
import json
import shlex

from apt_evap.cli._options import MAX_BINS, SHAPE, add_speech, integer_type
from apt_evap.cli._output import put, say, tell, tell_json


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Run all points of a study file: all combinations of some settings, and single points. Every\n"
        "point has a folder of its own, and can be run by any process that sees it."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap sweep plan sweep                               the shipped example sweep.toml: four tips\n"
        "  apt-evap sweep plan study.toml                          folders, memory and hours; runs nothing\n"
        "  apt-evap sweep work study.toml --workers 4              on this machine\n"
        "  apt-evap sweep work study.toml --point 3                as one task of a cluster\n"
        "  apt-evap sweep status study.toml\n"
        "  apt-evap sweep collect study.toml                       tables, maps, a report, fit to a measured map"
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", dest="action", required=True)

    def add(name, text, **options):
        action = actions.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.", **options, **SHAPE)
        action.add_argument(
            "study", metavar="STUDY.toml", help="study file, its folder, or the name of a shipped example"
        )
        return action

    add_speech(add("plan", "make the folder of a sweep, and estimate memory and hours; nothing is run"))
    work = add("work", "run the points that are waiting")
    where = work.add_mutually_exclusive_group()
    where.add_argument("--workers", type=integer_type(1), default=1, metavar="N", help="processes; default: 1")
    where.add_argument(
        "--point",
        action="append",
        metavar="KEY",
        help="only this point, by its key or number from 0, in this process; may be repeated",
    )
    where.add_argument("--scheduler", choices=("dask",), help="let the workers of a Dask cluster work")
    work.add_argument("--address", metavar="TCP", help="address of the scheduler of Dask")
    work.add_argument("--retry", action="store_true", help="also try failed points again")
    add_speech(work)
    add_speech(add("status", "show the states of all points"))
    gather = add("collect", "collect the finished points: table, maps, report, and the fit to a measured map")
    gather.add_argument("--maps", metavar="MAPS.h5", help="default: maps.h5 in the folder of the sweep")
    gather.add_argument("--bins", type=integer_type(1, MAX_BINS), metavar="N", help="default: bins in [maps], or 128")
    gather.add_argument("--no-compare", action="store_true", help="without the comparison of [compare]")
    add_speech(gather)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap.cli._shipped import settings_file

    options.study = settings_file(options, options.study)
    return _ACTIONS[options.action](options)


def _plan(options):
    from apt_evap._common.codec import to_plain
    from apt_evap.simulation.config.cost_estimate import hours_text
    from apt_evap.studies.sweep.planning import plan_sweep

    sweep = plan_sweep(options.study)
    costs = [point.estimate for point in sweep.points]
    hours = [cost.hours for cost in costs]
    memory = [cost.memory for cost in costs if cost.memory is not None]
    content = {
        "folder": str(sweep.folder),
        "points": [{"key": point.key, "values": point.values, **to_plain(point.estimate)} for point in sweep.points],
    }
    if not (options.quiet or options.json):
        for point in sweep.points:
            put(f"{point.key}  {point.estimate}  {point}")
        most = f", {max(memory) / 1e9:.2g} GB at most" if memory else ""
        total = "" if None in hours else f", about {hours_text(sum(hours))} of one worker"
        put(f"{len(sweep.points):,} points in {sweep.folder}{most}{total}")
    tell_json(options, content)
    return 0


def _work(options):
    from apt_evap.studies.sweep.planning import open_sweep, retry, sweep_status
    from apt_evap.studies.sweep.working import run_sweep, run_sweep_with_dask

    sweep = open_sweep(options.study)
    if options.retry:
        tell(options, f"{retry(sweep):,} failed points are tried again")
    if options.address is not None and options.scheduler is None:
        raise ValueError(f"--address is only for --scheduler dask, got {options.address!r}")
    if options.point is not None:
        return _work_on_points(options, sweep)
    if options.scheduler == "dask":
        if options.address is None:
            raise ValueError("--scheduler dask needs --address, such as tcp://10.0.0.1:8786")
        states = run_sweep_with_dask(sweep, options.address)
    else:
        states = run_sweep(sweep, workers=options.workers)
    for key, state in states.items():
        if state.name == "waiting":
            say("note", f"point {key} will continue: {state.message}")
    content = sweep_status(sweep)
    _tell_counts(options, content)
    tell_json(options, {"folder": content["folder"], **content["counts"]})
    return 0


def _work_on_points(options, sweep):
    """Run points in this process, as in a job of a batch system, which should see whether they are done."""
    from apt_evap.studies.sweep.point_folder import run_point

    keys = [sweep.check_key(point) for point in options.point]
    states = {key: run_point(sweep.folder_of(key), sweep.job.threads, sweep.job.checkpoint) for key in keys}
    texts = {key: f"{key}: {state.name}{f', {state.message}' * bool(state.message)}" for key, state in states.items()}
    for text in texts.values():
        tell(options, text)
    tell_json(options, {key: state.name for key, state in states.items()})
    if unfinished := [text for key, text in texts.items() if states[key].name != "done"]:
        raise ValueError(f"point {'; '.join(unfinished)}")
    return 0


def _status(options):
    from apt_evap.studies.sweep.planning import open_sweep, sweep_status

    content = sweep_status(open_sweep(options.study))
    if options.json:
        tell_json(options, content)
        return 0
    for row in content["table"]:
        values = ", ".join(f"{path} = {json.dumps(value)}" for path, value in row["values"].items())
        message = f"  {row['message']}" if row["message"] else ""
        tell(options, f"{row['key']}  {row['state']:7}  {row['ions']:,} of {row['n_ions']:,} ions  {values}{message}")
    _tell_counts(options, content)
    return 0


def _tell_counts(options, content):
    from apt_evap.simulation.config.cost_estimate import hours_text
    from apt_evap.studies.sweep.point_folder import STATES

    counts = content["counts"]
    shown = [name for name in STATES if counts[name] or name != "wrong"]
    text = ", ".join(f"{counts[name]:,} {name}" for name in shown)
    left = content["hours_left"]
    hours = f"; about {hours_text(left)} of one worker left" if left else ""
    tell(options, f"{content['points']:,} points: {text}{hours}")
    for row in [row for row in content["table"] if row["state"] in ("failed", "wrong")][:3]:
        say("note", f"point {row['key']}, {row['state']}: {row['message']}")
    if counts["failed"]:
        say("note", "after the reason is removed, apt-evap sweep work --retry tries failed points again")
    if counts["wrong"]:
        say("note", "after a wrong file is removed, apt-evap sweep work runs its point again")


def _collect(options):
    from apt_evap._common.files import FileError
    from apt_evap.studies.sweep.collection import INDEX, collect_sweep
    from apt_evap.studies.sweep.planning import open_sweep

    sweep = open_sweep(options.study)
    done = "replaced" if (sweep.folder / INDEX).exists() else "wrote"
    result = collect_sweep(
        sweep,
        maps=options.maps,
        bins=options.bins,
        compare=not options.no_compare,
        note=lambda text: tell(options, text),
        command=shlex.join(["apt-evap", *options.arguments]),
    )
    for key, reason in result["wrong"].items():
        say("note", f"point {key} is not collected: {reason}")
    if not result["done"]:
        raise FileError(f"no point of {str(sweep.folder)!r} is done: apt-evap sweep work runs them")
    fit = result.pop("fit")
    if fit is not None:
        tell(options, repr(fit).strip("<>"))
        for name, reason in fit.failed.items():
            say("note", f"point {name} is not compared: {reason}")
        tell_json(options, result | {"best": fit.best, "table": fit.rows()})
    else:
        tell_json(options, result)
    tell(options, f"{done} {', '.join(result['files'])}")
    return 0


_ACTIONS = {"plan": _plan, "work": _work, "status": _status, "collect": _collect}
