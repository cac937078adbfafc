"""`apt-evap run`: simulate what a TOML file describes."""

import time
from dataclasses import replace
from typing import Any

from apt_evap._files import FileError, check_path
from apt_evap.checkpoint import Checkpoint
from apt_evap.cli._files import check_output, is_picture, picture_path, save_picture
from apt_evap.cli._options import INTERRUPTED, SHAPE, add_speech, minutes, say, tell, tell_json, whole
from apt_evap.cli.map import described, run_maps
from apt_evap.config import read_config
from apt_evap.run_file import is_run


def add_parser(commands: Any) -> None:
    """Describe the command."""
    command = commands.add_parser(
        "run",
        help="simulate what a TOML file describes",
        description="Simulate what a TOML file describes, save the run and draw its detector maps.\n"
        "Ctrl-C ends the simulation and saves what is done. While it goes on it is kept in RUN.h5.unfinished;\n"
        "killed, it goes on from there with --resume, and gives the same bits as if it had not been.",
        epilog="example: apt-evap run examples/ni111.toml -o ni.h5 --ions 5000",
        **SHAPE,
    )
    command.add_argument("config", metavar="CONFIG.toml")
    command.add_argument("-o", "--output", metavar="RUN.h5", help="default: output of the file, or its name with .h5")
    command.add_argument("--ions", type=whole(1), metavar="N", help="atoms to evaporate, instead of those of the file")
    command.add_argument("--threads", type=whole(1), metavar="N", help="default: all processors")
    command.add_argument("--seed", type=whole(0), metavar="N", help="instead of that of the file")
    command.add_argument("--map", metavar="MAP.png", help="picture of the maps; default: beside the run")
    command.add_argument("--resume", action="store_true", help="go on with an unfinished run, or make one longer")
    command.add_argument(
        "--checkpoint", type=minutes, default=10.0, metavar="MINUTES", help="time between two checkpoints; default: 10"
    )
    add_speech(command)
    command.add_argument(
        "--force", action="store_true", help="overwrite files that apt-evap did not make, and unfinished runs"
    )
    command.set_defaults(command=_run)


def _run(options):
    config = read_config(options.config)
    output = check_path(options.output or config.output or f"{config.path.stem}.h5")
    if output.suffix.lower() != ".h5":
        raise FileError(f"a run is saved in an HDF5 file whose name ends in .h5, got {str(output)!r}")
    picture = picture_path(options.map or output.with_suffix(".png"))
    # before the hours of computing, not after
    check_output(output, is_run, options.force)
    check_output(picture, is_picture, options.force)

    simulation = config.simulation(seed=options.seed, n_threads=options.threads)
    tell(options, f"{str(simulation.tip).strip('<>')}; {len(simulation.emitter):,} atoms on the surface")
    began = time.perf_counter()
    checkpoint = Checkpoint(output, options.checkpoint, resume=options.resume, overwrite=options.force)
    provenance = {"config": config.path.name, "maps": config.maps.to_dict()}
    try:
        run = simulation.run(
            options.ions or config.n_ions,
            config.emissions,
            responses=config.responses,
            progress=False if options.quiet else None,
            checkpoint=checkpoint,
        )
    except FileError as error:
        # the checkpoints speak of arguments of Python
        message = str(error).replace("resume=True", "--resume").replace("overwrite=True", "--force")
        raise FileError(message) from error
    except Exception as error:
        if run := getattr(error, "run", None):
            replace(run, provenance=run.provenance | provenance).save(output)
            say("note", f"the {len(run):,} ions done so far are in {str(output)!r}")
        raise
    seconds = time.perf_counter() - began
    run = replace(run, provenance=run.provenance | provenance)
    run.save(output)
    rate = "" if options.resume else f", {len(run) / seconds:,.0f} ions/s"  # it is not known how many are new
    tell(options, f"{len(run):,} ions in {seconds:.1f} s{rate}")
    for panel in config.maps.panels:
        hit, missed, never_left = run.hits(panel.perturbation).counts.values()
        tell(
            options, f"{panel.title}: {hit:,} hit the detector, {missed:,} missed it, {never_left:,} never left the tip"
        )
    if run.responses is not None:
        tell(options, f"responses: {run.marked.sum():,} ions marked as inexact")
    if run.ended:
        say("note", f"the run ended before its time: {run.ended}; the {len(run):,} ions so far are kept")
    tell(options, f"wrote {output}")
    try:
        maps = run_maps(run, config.maps)
        save_picture(picture, *maps)
    except ValueError as error:
        raise ValueError(f"no maps are drawn, the run is in {str(output)!r}: {error}") from error
    tell(options, f"wrote {picture}")
    counts = {key: value for key, value in run.summary().items() if key != "ended"}
    written = {"wrote": str(output), "picture": str(picture), "maps": described(*maps)}
    tell_json(options, {**written, **counts, "seconds": round(seconds, 3), "ended": run.ended or "as planned"})
    return INTERRUPTED if run.ended == "interrupted" else 0
