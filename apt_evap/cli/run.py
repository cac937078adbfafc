"""`apt-evap run`: run the simulation of a TOML file."""

import argparse
import contextlib
import sys
import time
from pathlib import Path

from apt_evap._common.files import FileError, check_path
from apt_evap._common.progress import progress_bar
from apt_evap.analysis.description import real_units_line
from apt_evap.cli._files import check_output, is_picture, picture_path, save_picture
from apt_evap.cli._options import add_speech, integer_type, number_type
from apt_evap.cli._output import INTERRUPTED, say, tell, tell_json
from apt_evap.cli.map import run_maps, summaries
from apt_evap.config.cost_estimate import estimate_cost
from apt_evap.config.simulation_file import config_of, read_document
from apt_evap.plot.map_figures import specimen_title
from apt_evap.simulation.checkpoint import Checkpoint
from apt_evap.simulation.recorder import RunInterrupted
from apt_evap.simulation.run_hdf5 import is_run
from apt_evap.simulation.stop_reason import StopReason

SECONDS_BETWEEN_LINES = 60.0
_BAR = "{percentage:3.0f}%|{bar:20}| {n_fmt} of {total_fmt} ions, {remaining} left"
_CONTINUE = "the same command with --resume continues"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Run the simulation of a TOML file, save the run and draw its detector maps.\n"
        "Ctrl-C or SIGTERM ends the simulation and saves the ions so far. During the simulation checkpoints are\n"
        "stored in RUN.h5.unfinished. After a crash --resume continues from there, with the same bits as an\n"
        "uninterrupted run. The progress bar shows: charges (RMS residual relative to the mean charge); fractions\n"
        "of the last ions that missed, never left the tip, or are flagged (inexact responses). Without a terminal:\n"
        "one line per minute."
    )
    parser.epilog = "example: apt-evap run examples/ni111.toml -o ni.h5 --ions 5000"
    parser.add_argument("config", metavar="CONFIG.toml")
    parser.add_argument("-o", "--output", metavar="RUN.h5", help="default: output in the file, or its name with .h5")
    parser.add_argument(
        "--ions", type=integer_type(1), metavar="N", help="number of atoms to evaporate; default: ions in the file"
    )
    parser.add_argument("--threads", type=integer_type(1), metavar="N", help="default: all processors")
    parser.add_argument("--seed", type=integer_type(0), metavar="N", help="default: seed in the file")
    parser.add_argument("--map", metavar="MAP.png", help="picture of the maps; default: beside the run")
    parser.add_argument("--resume", action="store_true", help="continue an unfinished run, or extend a run")
    parser.add_argument(
        "--checkpoint",
        type=number_type("min"),
        default=10.0,
        metavar="MINUTES",
        help="time between two checkpoints; default: 10",
    )
    add_speech(parser)
    parser.add_argument(
        "--force", action="store_true", help="overwrite unfinished and other runs, and files not made by apt-evap"
    )


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    document = read_document(options.config)
    own = {"ions": options.ions, "seed": options.seed}
    document["simulation"] = document.get("simulation", {}) | {
        name: value for name, value in own.items() if value is not None
    }
    config = config_of(document, Path(options.config), own_classes=True)
    if "responses" in document and not config.responses:
        say("note", "the table [responses] is not used: [simulation] has responses = false")
    output = check_path(options.output or config.output or f"{config.path.stem}.h5")
    if output.suffix.lower() != ".h5":
        raise FileError(f"a run is saved in an HDF5 file with the suffix .h5, got {str(output)!r}")
    picture = picture_path(options.map or output.with_suffix(".png"))
    # before the long computation
    check_output(output, is_run, options.force)
    check_output(picture, is_picture, options.force)

    n_ions = config.n_ions
    tell(options, f"{estimate_cost(config, 1)} of one thread")
    tell(options, "building the specimen and relaxing the charges of its surface")
    simulation = config.simulation(n_threads=options.threads)
    tell(options, f"{str(simulation.tip).strip('<>')}; {len(simulation.emitter):,} atoms on the surface")
    began = time.perf_counter()
    checkpoint = Checkpoint(output, options.checkpoint, resume=options.resume, overwrite=options.force)
    replaced, unfinished = output.exists(), checkpoint.unfinished.exists()
    n_previous = checkpoint.ions_there() if options.resume else 0
    if 0 < n_previous < n_ions:
        tell(options, f"resumed at {n_previous:,} of {n_ions:,} ions")
    run = _simulate(options, config, simulation, checkpoint, n_ions, n_previous)
    seconds = time.perf_counter() - began
    if n_previous == n_ions and not unfinished and run.provenance.get("settings") == config.key:
        tell(options, f"{output} is complete: nothing to do")
        tell_json(options, {"wrote": None, "picture": None, "maps": [], **_counts(run, seconds)})
        return 0
    run = config.as_saved(run)
    run.save(output)
    new = "" if not n_previous else f", {len(run) - n_previous:,} of them new,"
    tell(options, f"{len(run):,} ions{new} in {seconds:.1f} s, {(len(run) - n_previous) / seconds:,.0f} ions/s")
    _tell_outcomes(options, config, run, output, n_ions)
    if run.units is not None:
        tell(options, real_units_line(run))
    tell(options, f"{'replaced' if replaced and not options.resume else 'wrote'} {output}")
    try:
        maps = run_maps(run, config.maps)
        save_picture(picture, *maps, title=specimen_title(run))
    except ValueError as error:
        raise ValueError(f"no maps are drawn, the run is in {str(output)!r}: {error}") from error
    tell(options, f"wrote {picture}")
    files = {"wrote": str(output), "picture": str(picture), "maps": summaries(*maps)}
    tell_json(options, {**files, **_counts(run, seconds)})
    return INTERRUPTED if run.ended == StopReason.INTERRUPTED else 0


def _simulate(options, config, simulation, checkpoint, n_ions, n_previous):
    """Run the simulation; after an interrupt or an error a note names the file of its ions."""
    if options.quiet:
        progress = contextlib.nullcontext(False)
    else:
        progress = _Bar(n_ions, n_previous) if sys.stderr.isatty() else contextlib.nullcontext(_Lines())
    try:
        with progress as shown:
            return simulation.run(
                n_ions, config.emissions, responses=config.responses, progress=shown, checkpoint=checkpoint
            )
    except KeyboardInterrupt:
        if ions := checkpoint.ions_there():
            where = checkpoint.unfinished if checkpoint.unfinished.exists() else checkpoint.path
            say("note", f"{ions:,} of {n_ions:,} ions are in {str(where)!r}; {_CONTINUE}")
        raise
    except RunInterrupted as error:
        config.with_origin(error.run).save(checkpoint.path)
        say("note", f"the {len(error.run):,} ions so far are in {str(checkpoint.path)!r}")
        raise


def _tell_outcomes(options, config, run, output, n_ions):
    """Print the numbers of hits, and notes about problems."""
    frequent_misses = []
    for panel in config.maps.panels:
        hit, missed, never_left, outside = run.hits(panel.perturbation).counts.values()
        frequent_misses += [missed] if 2 * missed > len(run) else []
        view = "" if run.field_of_view is None else f", {outside:,} are outside the field of view"
        tell(
            options,
            f"{panel.title}: {hit:,} hit the detector, {missed:,} missed it, {never_left:,} never left the tip{view}",
        )
    if run.responses is not None:
        view = "" if run.field_of_view is None else f", {run.not_flown.sum():,} ions not flown"
        tell(options, f"responses: {run.flagged.sum():,} ions flagged as inexact{view}")
    if frequent_misses:
        say(
            "note",
            f"{max(frequent_misses):,} of {len(run):,} ions miss the detector, which is {run.detector.width:g} mm "
            f"wide at {run.detector.distance:g} mm: use a larger width or a smaller distance in [detector]",
        )
    if run.ended == StopReason.INTERRUPTED:
        say("note", f"interrupted; {len(run):,} of {n_ions:,} ions are in {str(output)!r}; {_CONTINUE}")
    elif run.ended:
        say("note", f"the run ended early: {run.ended}; its {len(run):,} ions are saved")


def _counts(run, seconds):
    return run.summary() | {"seconds": round(seconds, 3), "ended": run.ended or "as planned"}


class _Bar:
    """Progress of a run in a terminal: a bar of a fixed width, which fits into 80 columns with its numbers."""

    def __init__(self, n_ions: int, n_previous: int) -> None:
        self._bar = progress_bar(total=n_ions, initial=n_previous, bar_format=_BAR, unit=" ions", mininterval=0.5)

    def __enter__(self) -> "_Bar":
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()

    def __call__(self, ions: int, n_ions: int) -> None:
        self._bar.update(ions - self._bar.n)


class _Lines:
    """Progress of a run on stderr: one line per minute, after the first minute."""

    def __init__(self) -> None:
        self._began = self._printed = self._first = 0.0

    def __call__(self, ions: int, n_ions: int) -> None:
        now = time.monotonic()
        if not self._began:
            self._began, self._printed, self._first = now, now, ions
        elif now - self._printed >= SECONDS_BETWEEN_LINES and ions > self._first:
            self._printed = now
            rate = (ions - self._first) / (now - self._began)
            remaining, speed = _duration((n_ions - ions) / rate), f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
            line = f"{ions:,} of {n_ions:,} ions ({ions / n_ions:.0%}), {speed} ions/s, {remaining} left"
            print(line, file=sys.stderr, flush=True)


def _duration(seconds):
    """Text of a time in a suitable unit."""
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"
