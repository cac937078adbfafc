"""`apt-evap dataset`: make a data set from a study file, or verify one."""

import argparse
from pathlib import Path

from apt_evap.cli._options import add_speech, integer_type
from apt_evap.cli._output import say, tell, tell_json


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Run the simulations of a study file, record their ions as an instrument would, and write them\n"
        "with the truth: for machine learning and statistics. Time and size are estimated. The command can be killed\n"
        "and started again at any time; equal studies give equal bytes. For the folder of a data set, verify it."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap dataset dataset --plan                 the shipped example dataset.toml: ten tips\n"
        "  apt-evap dataset study.toml --plan              runs, examples, hours, size; runs nothing\n"
        "  apt-evap dataset study.toml -o set --workers 2  make the set, or finish it\n"
        "  apt-evap dataset set                            verify its checksums"
    )
    parser.add_argument(
        "study",
        metavar="STUDY.toml",
        help="study file with a table [dataset], the name of a shipped example, or a data set",
    )
    parser.add_argument("-o", "--output", metavar="FOLDER", help="default: name of the study with _set")
    parser.add_argument("--plan", action="store_true", help="only estimate time and size")
    parser.add_argument("--workers", type=integer_type(1), default=1, metavar="N", help="processes; default: 1")
    parser.add_argument(
        "--without-failed", action="store_true", help="leave out runs that have failed, instead of an error"
    )
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap.cli._shipped import settings_file
    from apt_evap.simulation.config.cost_estimate import hours_text
    from apt_evap.studies.dataset.making import make_dataset, plan_dataset
    from apt_evap.studies.dataset.set_description import ABOUT, verify_dataset

    path = Path(settings_file(options, options.study))
    if path.is_dir() and (path / ABOUT).exists():
        content = verify_dataset(path)
        tell(options, f"{path}: all files are as in its checksums")
    else:
        planned = plan_dataset(path)
        hours = "" if planned.hours is None else f"; about {hours_text(planned.hours)} of one worker left"
        tell(options, f"{len(planned.sweep.points):,} runs, {planned.examples:,} examples{hours}")
        tell(
            options,
            f"at most {_size(planned.bytes)} in the data set, about {_size(planned.run_bytes)} of runs in "
            f"{planned.sweep.folder}, which it does not need when it is finished",
        )
        if options.plan:
            tell_json(
                options,
                {
                    "runs": len(planned.sweep.points),
                    "examples": planned.examples,
                    "hours": planned.hours,
                    "bytes": planned.bytes,
                    "run_bytes": planned.run_bytes,
                },
            )
            return 0
        path = Path(options.output) if options.output else path.with_name(f"{path.stem}_set")
        content = make_dataset(
            planned,
            path,
            workers=options.workers,
            without_failed=options.without_failed,
            note=lambda text: tell(options, text),
        )
        for key, values in content["left_out"].items():
            say("note", f"run {key} has failed and is left out: {values}")
    for split, counts in content["counts"].items():
        tell(options, f"{split}: {counts['examples']:,} examples of {counts['runs']:,} runs, {counts['ions']:,} ions")
    size = sum(shard["bytes"] for shard in content["shards"])
    tell(options, f"{path}: {_size(size)}")
    tell_json(
        options,
        {"folder": str(path), "bytes": size, "counts": content["counts"], "left_out": list(content["left_out"])},
    )
    return 0


def _size(n_bytes):
    return f"{n_bytes / 1e9:.3g} GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.3g} MB"
