"""`apt-evap sweep`: plan, run and collect many simulations of one study file."""

import argparse
import json
import shlex

from apt_evap._common.codec import to_plain
from apt_evap._common.files import FileError
from apt_evap.cli._options import SHAPE, add_speech, integer_type
from apt_evap.cli._output import put, say, tell, tell_json
from apt_evap.detection.binning import MAX_BINS
from apt_evap.sweep.batch_system import largest_array, scripts, submit
from apt_evap.sweep.collection import collect
from apt_evap.sweep.foresight import hours_text
from apt_evap.sweep.overview import status
from apt_evap.sweep.planning import STATES, open_sweep, plan
from apt_evap.sweep.pool import work_locally, work_with_dask
from apt_evap.sweep.worker import retry, work, work_on


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Run all points of a study file: all combinations of some settings, and single points. Every\n"
        "point has a folder of its own, and can be run by any process that sees it."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap sweep plan study.toml                          folders, memory and hours; runs nothing\n"
        "  apt-evap sweep work study.toml --workers 4              on this machine\n"
        "  apt-evap sweep submit study.toml --scheduler slurm      on a cluster\n"
        "  apt-evap sweep status study.toml\n"
        "  apt-evap sweep collect study.toml                       tables, maps, a report, fit to a measured map"
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", dest="action", required=True)

    def add(name, text, **options):
        action = actions.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.", **options, **SHAPE)
        action.add_argument("study", metavar="STUDY.toml", help="study file, or the folder of its sweep")
        return action

    add_speech(add("plan", "make the folder of a sweep, and foresee memory and hours; nothing is run"))
    work = add("work", "work on the points that are open")
    where = work.add_mutually_exclusive_group()
    where.add_argument("--workers", type=integer_type(1), default=1, metavar="N", help="processes; default: 1")
    where.add_argument("--point", action="append", metavar="KEY", help="only this point, by its key or number")
    where.add_argument("--scheduler", choices=("dask",), help="let the workers of a Dask cluster work")
    work.add_argument("--address", metavar="TCP", help="address of the scheduler of Dask")
    work.add_argument("--retry", action="store_true", help="also try failed points again")
    add_speech(work)
    submit = add("submit", "submit the open points to a batch system, as job arrays")
    submit.add_argument("--scheduler", choices=("slurm", "pbs"), default="slurm", help="default: slurm")
    submit.add_argument("--dry-run", action="store_true", help="only print the scripts")
    submit.add_argument("--template", metavar="JOB.sh", help="script with placeholders such as @KEYS@ and @COMMAND@")
    submit.add_argument("--submit-command", metavar="COMMAND", help="default: sbatch --parsable, or qsub")
    submit.add_argument(
        "--option", action="append", metavar="OPTION", help="of the batch system, such as --option=--partition=short"
    )
    submit.add_argument(
        "--at-once", type=integer_type(1), metavar="N", help="tasks of an array that run at once (slurm)"
    )
    submit.add_argument(
        "--largest-array", type=integer_type(1), metavar="N", help="default: as the system allows, or 1000"
    )
    add_speech(submit)
    add("status", "show the states of all points").add_argument("--json", action="store_true", help="as JSON")
    gather = add("collect", "collect the finished points: table, maps, report, and the fit to a measured map")
    gather.add_argument("--maps", metavar="MAPS.h5", help="default: maps.h5 in the folder of the sweep")
    gather.add_argument("--bins", type=integer_type(1, MAX_BINS), metavar="N", help="default: bins in [maps], or 128")
    gather.add_argument("--no-compare", action="store_true", help="without the comparison of [compare]")
    add_speech(gather)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    return _ACTIONS[options.action](options)


def _plan(options):
    sweep = plan(options.study)
    hours = [needs.hours for needs in sweep.foresights]
    memory = [needs.memory for needs in sweep.foresights if needs.memory is not None]
    content = {
        "folder": str(sweep.folder),
        "points": [
            {"key": point.key, "values": point.values, **to_plain(needs)}
            for point, needs in zip(sweep.points, sweep.foresights, strict=True)
        ],
    }
    if not (options.quiet or options.json):
        for point, needs in zip(sweep.points, sweep.foresights, strict=True):
            put(f"{point.key}  {needs}  {point}")
        most = f", {max(memory) / 1e9:.2g} GB at most" if memory else ""
        total = "" if None in hours else f", about {hours_text(sum(hours))} of one worker"
        put(f"{len(sweep.points):,} points in {sweep.folder}{most}{total}")
    tell_json(options, content)
    return 0


def _work(options):
    sweep = open_sweep(options.study)
    if options.retry:
        tell(options, f"{retry(sweep):,} failed points are tried again")
    if options.scheduler == "dask":
        if options.address is None:
            raise ValueError("--scheduler dask needs --address, such as tcp://10.0.0.1:8786")
        work_with_dask(sweep, options.address)
    elif options.address is not None:
        raise ValueError(f"--address is only for --scheduler dask, got {options.address!r}")
    elif options.point is not None:
        keys = [sweep.check_key(point) for point in options.point]
        states = {key: work_on(sweep, key) for key in keys}
        for key, state in states.items():
            tell(options, f"{key}: {state.name}{f', {state.message}' if state.message else ''}")
        wrong = ("failed", "damaged", "foreign")
        failed = [f"{key}: {state.message}" for key, state in states.items() if state.name in wrong]
        tell_json(options, {key: state.name for key, state in states.items()})
        if failed:
            raise ValueError(f"point {'; '.join(failed)}")
        return 0
    elif options.workers > 1:
        work_locally(sweep, options.workers)
    else:
        work(sweep)
    content = status(sweep)
    _tell_counts(options, content)
    tell_json(options, {"folder": content["folder"], **content["counts"]})
    return 0


def _submit(options):
    sweep = open_sweep(options.study)
    keys = [point.key for point, state in sweep.states() if state.name == "open"]
    if not keys:
        tell(options, "no point is open: nothing to submit")
        tell_json(options, {"jobs": [], "points": 0})
        return 0
    largest = options.largest_array or (largest_array(options.scheduler) if not options.dry_run else None)
    texts = scripts(
        sweep,
        keys,
        options.scheduler,
        template=options.template,
        options=options.option or (),
        at_once=options.at_once,
        **({} if largest is None else {"largest": largest}),
    )
    if options.dry_run:
        if options.json:
            tell_json(options, {"scripts": texts, "points": len(keys)})
        else:
            put("\n".join(texts).removesuffix("\n"))
        return 0
    answers = submit(sweep, texts, options.scheduler, options.submit_command)
    for path, answer in answers:
        tell(options, f"submitted {path}: {answer}")
    tell_json(
        options, {"jobs": [{"script": str(path), "answer": answer} for path, answer in answers], "points": len(keys)}
    )
    return 0


def _status(options):
    content = status(open_sweep(options.study))
    if options.json:
        put(json.dumps(content, allow_nan=False))
        return 0
    for row in content["table"]:
        values = ", ".join(f"{path} = {json.dumps(value)}" for path, value in row["values"].items())
        message = f"  {row['message']}" if row["message"] else ""
        tries = f"{row['tries']} {'try' if row['tries'] == 1 else 'tries'}"
        put(f"{row['key']}  {row['state']:7}  {row['ions']:,} of {row['n_ions']:,} ions, {tries}  {values}{message}")
    _tell_counts(argparse.Namespace(quiet=False, json=False), content)
    return 0


def _tell_counts(options, content):
    counts = content["counts"]
    shown = [name for name in STATES if counts[name] or name not in ("damaged", "foreign")]
    text = ", ".join(f"{counts[name]:,} {name}" for name in shown)
    left = content["hours_left"]
    hours = f"; about {hours_text(left)} of one worker left" if left else ""
    tell(options, f"{content['points']:,} points: {text}{hours}")
    wrong = [row for row in content["table"] if row["state"] in ("failed", "damaged", "foreign")]
    for row in wrong[:3]:
        say("note", f"point {row['key']}, {row['state']}: {row['message']}")
    if counts["failed"]:
        say("note", "after the reason is removed, apt-evap sweep work --retry tries failed points again")
    if counts["damaged"] or counts["foreign"]:
        say("note", "after a damaged or foreign run.h5 is removed, apt-evap sweep work runs its point again")


def _collect(options):
    sweep = open_sweep(options.study)
    result = collect(
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
    tell(options, f"wrote {', '.join(result['files'])}")
    return 0


_ACTIONS = {"plan": _plan, "work": _work, "submit": _submit, "status": _status, "collect": _collect}
