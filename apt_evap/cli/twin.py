"""`apt-evap twin`: from a measured file to a simulation of its specimen, a fit and a report."""

import argparse
import json
import shlex
import warnings
from pathlib import Path

from apt_evap import plot
from apt_evap._common.codec import to_plain
from apt_evap._common.files import FileError, check_path, read_small_file, replace_file
from apt_evap.cli import run as run_command
from apt_evap.cli._files import lens_of
from apt_evap.cli._options import add_indexing, add_reading, add_specimen, number_type
from apt_evap.cli._output import put, say
from apt_evap.cli.compare import compare
from apt_evap.cli.index import map_of
from apt_evap.cli.parser import make_parser
from apt_evap.cli.start import is_start, start_of, summary
from apt_evap.crystallography.orientation import Orientation
from apt_evap.detection.projection import Projection
from apt_evap.emission.perturbations import LateralVelocity, RollUp
from apt_evap.indexing.index import Candidate
from apt_evap.indexing.master_pattern import master_patterns
from apt_evap.io.formats import read_ranges
from apt_evap.registration.register import at_bound, register
from apt_evap.report.measurement import measurement_section
from apt_evap.report.page import Page
from apt_evap.simulation.run import load
from apt_evap.specimen.materials import material
from apt_evap.twin.constants import constants_of
from apt_evap.twin.start import ENERGY, HEIGHT, ROLLS, SHARPNESS, near
from apt_evap.warnings import RegistrationWarning, warn

SETTINGS, FACTS, RUN, REGISTRATION, STUDY, ANSWER = (
    "specimen.toml", "start.json", "run.h5", "registration.json", "study", "answer.txt",
)  # fmt: skip
_LARGEST = 1 << 24  # bytes of start.json
_FRACTIONS = "0.2,0.4,0.6,0.8,1"  # that roll up, in the fit


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Index a measured map, simulate its specimen, register the simulated map on the measured one, fit\n"
        "the emission, and write a report. The same command continues after an interruption."
    )
    parser.epilog = (
        "writes to FOLDER:\n"
        "  specimen.toml, start.json   settings of the simulation, and the indexing\n"
        "  run.h5, run.png             the simulation\n"
        "  registration.json, study/   as of apt-evap compare; study/report.html has it all\n"
        "  answer.txt                  constants of the measurement, what they depend on, and checks\n\n"
        "example:\n"
        "  apt-evap twin R5083.epos --element Ni --distance 90 --minutes 10\n"
        "  apt-evap twin map.npz --element Ni --pole=-9.6,-0.4,1,1,1 --pole 2.4,6.2,1,1,3 --pole=-7.5,-13.5,1,3,1"
    )
    parser.add_argument("file", metavar="FILE", help="measured ions (.epos, ...) or a map (.npz)")
    parser.add_argument("-o", "--output", metavar="FOLDER", help="default: FILE_twin in this folder")
    add_reading(parser)
    add_indexing(parser)
    add_specimen(parser).add_argument(
        "--efficiency",
        type=number_type("1"),
        default=0.5,
        metavar="ETA",
        help="part of the evaporated atoms that are among the selected ions, for the angle of the shank; default: 0.5",
    )


def execute(options: argparse.Namespace) -> int:
    """Run the command; finished steps are not repeated."""
    folder = check_path(options.output or f"{Path(options.file).stem}_twin")
    folder.mkdir(exist_ok=True)
    facts = _start(options, folder)
    code = run_command.execute(_parsed("run", folder / SETTINGS, "-o", folder / RUN, "--resume", options=options))
    if code:
        return code
    measured_map, ions = map_of(options)
    run = load(folder / RUN)
    best = facts["candidates"][0]
    rolls = best["rolled"] >= ROLLS
    if not (folder / REGISTRATION).exists():
        emission: RollUp | LateralVelocity = LateralVelocity(ENERGY, HEIGHT)
        if rolls:
            emission = RollUp(ENERGY, best["rolled"], SHARPNESS, HEIGHT)
        registration = _registered(run.hits(emission), measured_map, near(best["centre"], best["scale"]))
        with replace_file(folder / REGISTRATION) as file:
            file.write((json.dumps(to_plain(registration), indent=1) + "\n").encode())
    told: list[str] = []
    if not (folder / ANSWER).exists():
        candidate = _candidate(best, options)
        measurement = _measurement(candidate, measured_map, ions, options)
        command = _reconstruct_command(measurement, options)
        arguments = [folder / RUN, options.file, "-o", folder / STUDY, "--registration", folder / REGISTRATION]
        emission_options = ["--mechanism", "lateral", "--option", f"height={HEIGHT}"]
        if rolls:
            emission_options = ["--mechanism", "roll-up", "--option", f"probability={_FRACTIONS}"]
            emission_options += ["--option", f"sharpness={SHARPNESS}", "--option", f"height={HEIGHT}"]
        given = _parsed("compare", *arguments, *emission_options, options=options)
        picture = _picture(candidate, measured_map, facts)
        section = measurement_section(measurement.constants, measurement.checks, command, picture)
        study = compare(given, measured_map if ions is None else ions, [section])
        _write_answer(folder / ANSWER, facts, study, measurement, command)
        told = study.lines()  # by `compare`
    answer = read_small_file(folder / ANSWER, _LARGEST, "an answer").decode().splitlines()
    put("\n".join(line for line in answer if line not in told))
    put(f"wrote {folder / STUDY / 'report.html'}")
    return 0


def _start(options, folder):
    """Settings and facts of the first step, made or read."""
    if not (folder / FACTS).exists():
        settings = folder / SETTINGS
        if settings.exists() and not is_start(settings):
            raise FileError(f"{str(settings)!r} was not made by apt-evap: give another folder with -o")
        start = start_of(options)
        put(str(start.indexing))
        if not start.indexing.decided:
            say(
                "warning", "the map does not decide: the first candidate is simulated; --pole, --line and --scales help"
            )
        start.save(settings)
        with replace_file(folder / FACTS) as file:
            file.write((json.dumps(summary(start), indent=1) + "\n").encode())
    return json.loads(read_small_file(folder / FACTS, _LARGEST, "the facts of a start"))


def _registered(hits, measured_map, bounds):
    """Registration of a run; its scale is that of the indexing if the maps do not determine one within the bounds."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RegistrationWarning)
        found = register(hits, measured_map, **bounds)
    low, high = bounds["scales"]
    if at_bound(found.scale, (low, high)):
        # poles of a smaller tip are wider, and a smaller scale makes them narrower again
        say("note", f"the maps do not determine the scale of the registration within {low:g} to {high:g}: "
                    "that of the indexing is kept")  # fmt: skip
        return register(hits, measured_map, **(bounds | {"scales": 1.0}))
    for each in caught:
        warn(str(each.message), RegistrationWarning)
    return found


def _parsed(command, *arguments, options):
    """Options of another command."""
    threads = [] if options.threads is None else ["--threads", str(options.threads)]
    given = make_parser().parse_args([command, *map(str, arguments), *threads])
    given.arguments = options.arguments
    return given


def _candidate(best, options):
    """The first candidate, as it is in start.json."""
    crystal = material(options.element)
    patterns = master_patterns(crystal.structure)
    return Candidate(
        orientation=Orientation(crystal, tuple(best["axis"]), best["rotation"]),
        projection=Projection(best["scale"], tuple(best["centre"]), compression=best["compression"]),
        pattern=min(patterns, key=lambda each: abs(each.apex_radius - best["pattern_radius"])),
        **{name: best[name] for name in ("score", "confidence", "rolled", "contrast", "angle_error")},
    )


def _picture(candidate, measured_map, facts):
    """Measured map with the poles and zone lines of the candidate, as HTML."""
    shown = measured_map.smoothed(max(measured_map.bin_size)) if measured_map.is_counts else measured_map
    ax = plot.detector_map(shown, title=f"{candidate}")
    plot.poles(ax, candidate.orientation, candidate.projection, region=shown, families=8)
    return Page("").picture(ax.figure, f"Measured map with the poles and zone lines that it was simulated with "
                                       f"({facts['verdict']}).")  # fmt: skip


def _measurement(candidate, measured_map, ions, options):
    """Constants of the measurement."""
    return constants_of(
        measured_map,
        candidate,
        ions,
        lens=lens_of(options),
        field_factor=options.field_factor,
        distance=options.distance,
        efficiency=options.efficiency,
        ranges=None if options.ranges is None else read_ranges(options.ranges),
    )


def _reconstruct_command(measurement, options):
    """Command that reconstructs with the constants of the measurement, "" if it has no ions or no flight length."""
    known = measurement.arguments
    if "distance" not in known:
        return ""
    words = ["apt-evap", "reconstruct", options.file, "--element", options.element]
    for name in ("distance", "detector_radius", "efficiency", "compression", "field_factor", "projection"):
        if name in known:
            value = known[name] if isinstance(known[name], str) else f"{known[name]:.4g}"
            words += [f"--{name.replace('_', '-')}", value]
    words += ["--lens", options.lens] if options.lens is not None else []
    for name in ("ions", "mass", "voltage"):
        if (bounds := getattr(options, name)) is not None:
            words += [f"--{name}", ",".join("" if each is None else f"{each:.10g}" for each in bounds)]
    for name in ("ranges", "species"):
        words += [f"--{name}", getattr(options, name)] if getattr(options, name) is not None else []
    return shlex.join(words)


def _write_answer(path, facts, study, measurement, command):
    """Constants of the measurement, and what they depend on."""
    best = facts["candidates"][0]
    lines = [
        f"indexing: {facts['verdict']}, {facts['reason']}",
        f"axis [{' '.join(f'{each:.3f}' for each in best['axis'])}] at the centre of the map, rotation "
        f"{best['rotation']:.1f}, errors {best['angle_error']:.1f} degrees by noise",
        *str(measurement).splitlines(),
    ]
    if not measurement.arguments:
        lines.append("radius: not known, the file has no voltages")
    lines.append(f"simulated with R = {facts['simulated_radius']:.1f} nm")
    lines += study.lines()
    lines.append("the energies depend on the radius and the voltage, and on the rule of the roll-up")
    if command:
        lines.append(f"reconstruct with: {command}")
    with replace_file(path) as file:
        file.write(("\n".join(lines) + "\n").encode())
