"""`apt-evap twin`: from a measured file to a simulation of its specimen, a fit and a report."""

import argparse
import json
import os
import shlex
import warnings
from pathlib import Path
from typing import Any

from apt_evap import plot
from apt_evap._common.codec import checked, choice, from_plain, number, settings, to_plain, vector
from apt_evap._common.files import FileError, check_path, sha256_of
from apt_evap._common.validation import check_sequence, short_text
from apt_evap.cli import run as run_command
from apt_evap.cli._files import lens_of, path_word
from apt_evap.cli._kept import KeptFiles
from apt_evap.cli._options import add_indexing, add_reading, add_specimen, number_type
from apt_evap.cli._output import put, say
from apt_evap.cli.compare import REPORT, compare
from apt_evap.cli.index import map_of
from apt_evap.cli.parser import make_parser
from apt_evap.cli.start import start_of, summary
from apt_evap.detection.projection import Projection
from apt_evap.emission.perturbations import LateralVelocity, RollUp
from apt_evap.fit.measured_constants import constants_of
from apt_evap.fit.start_settings import ENERGY, HEIGHT, ROLLS, SHARPNESS, near
from apt_evap.io.formats import read_ranges
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.indexing.index_map import Candidate
from apt_evap.maps.indexing.master_pattern import master_patterns
from apt_evap.maps.registration.register import at_bound, register
from apt_evap.plot.report.html_page import Page
from apt_evap.plot.report.measurement_report import measurement_section
from apt_evap.simulation.run import load
from apt_evap.simulation.run_hdf5 import is_run
from apt_evap.specimen.materials import material
from apt_evap.warnings import RegistrationWarning, warn

SETTINGS, FACTS, RUN, REGISTRATION, STUDY, ANSWER = (
    "specimen.toml", "start.json", "run.h5", "registration.json", "study", "answer.txt",
)  # fmt: skip
_REPORT = f"{STUDY}/{REPORT}"
_FRACTIONS = "0.2,0.4,0.6,0.8,1"  # that roll up, in the fit
# options that change no result; the threads only limit the size of the tip
_NO_MATTER = ("command", "arguments", "output", "threads")
_FILES = ("file", "ranges", "undistort")  # their content matters


def _text(value, name):
    if not isinstance(value, str):
        raise ValueError(f"{name} must be text, got {short_text(value)}")
    return value


def _candidates(value, name):
    if not value:
        raise ValueError(f"{name} must have at least one candidate, got none")
    return tuple(value)


def _read_candidates(plain, name):
    return [
        from_plain(candidate, _Candidate, what="a candidate") for candidate in check_sequence(plain, name, "tables")
    ]


@settings
class _Candidate:
    """A candidate, as it is in start.json."""

    axis: tuple = vector("Crystal direction along the axis of the specimen", 3)
    rotation: float = number("Rotation about the axis", unit="degrees")
    scale: float = number("Scale of the map", above=0, unit="mm/rad")
    centre: tuple = vector("Place of the axis", 2, unit="mm")
    score: float = number("Explained fraction of the structure", at_least=0, at_most=1)
    confidence: float = number("Confidence", at_least=0, at_most=1)
    rolled: float = number("Part of the pattern of ions that roll up", at_least=0, at_most=1)
    contrast: float = number("Sum of the amplitudes", at_least=0)
    angle_error: float = number("Standard error of the orientation", at_least=0, unit="degrees")
    pattern_radius: float = number("Radius of the tip of the pattern", above=0, unit="nm")
    compression: float | None = number("Image compression", default=None, above=0)


@settings
class _Facts:
    """Result of the first step, as it is in start.json."""

    verdict: str = choice("Verdict of the indexing", ("indexed", "undecided"))
    reason: str = checked("Its reason", "str", _text)
    simulated_radius: float = number("Radius of the simulated tip", above=0, unit="nm")
    candidates: tuple = checked("Candidates", "tuple", _candidates, read=_read_candidates)
    radii: Any = checked("Radii of the specimen, which are in the settings, too", "list", lambda radii, _: radii)

    @property
    def best(self) -> _Candidate:
        """The first candidate."""
        return self.candidates[0]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Index a measured map, simulate its specimen, register the simulated map on the measured one, fit\n"
        "the emission, and write a report. The same command continues after an interruption. A folder belongs\n"
        "to one FILE and one set of options: others are refused."
    )
    parser.epilog = (
        "writes to FOLDER:\n"
        "  specimen.toml, start.json   settings of the simulation, and the indexing\n"
        "  run.h5, run.png             the simulation\n"
        "  registration.json, study/   as of apt-evap compare; study/report.html has it all\n"
        "  answer.txt                  constants of the measurement, what they depend on, and checks\n"
        "  twin.json                   SHA-256 of these files and of FILE, and the options\n\n"
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
    files, values = _made_from(options)
    kept = KeptFiles(folder, files, values, (SETTINGS, FACTS, RUN, REGISTRATION, STUDY, ANSWER))
    facts = _start(options, kept)
    candidate = _candidate(facts.best, options, folder)
    if os.path.lexists(folder / RUN) and not is_run(folder / RUN):
        raise FileError(f"{str(folder / RUN)!r} is not a run: remove it, or give another folder with -o")
    code = run_command.execute(_parsed("run", folder / SETTINGS, "-o", folder / RUN, "--resume", options=options))
    if code:
        return code
    told: list[str] = []
    if not (kept.has(REGISTRATION) and kept.has(ANSWER) and kept.has(_REPORT)):
        measured_map, ions = map_of(options)
        rolls = facts.best.rolled >= ROLLS
        if not kept.has(REGISTRATION):
            kept.forget(ANSWER, _REPORT)
            emission: RollUp | LateralVelocity = LateralVelocity(ENERGY, HEIGHT)
            if rolls:
                emission = RollUp(ENERGY, facts.best.rolled, SHARPNESS, HEIGHT)
            run = load(folder / RUN)
            registration = _registered(run.hits(emission), measured_map, near(facts.best.centre, facts.best.scale))
            kept.write({REGISTRATION: (json.dumps(to_plain(registration), indent=1) + "\n").encode()})
        kept.forget(ANSWER, _REPORT)
        measurement = _measurement(candidate, measured_map, ions, options)
        command = _reconstruct_command(measurement, options)
        arguments = [folder / RUN, Path(options.file), "-o", folder / STUDY, "--registration", folder / REGISTRATION]
        emission_options = ["--mechanism", "lateral", "--option", f"height={HEIGHT}"]
        if rolls:
            emission_options = ["--mechanism", "roll-up", "--option", f"probability={_FRACTIONS}"]
            emission_options += ["--option", f"sharpness={SHARPNESS}", "--option", f"height={HEIGHT}"]
        given = _parsed("compare", *arguments, *emission_options, options=options)
        picture = _picture(candidate, measured_map, facts)
        section = measurement_section(measurement.constants, measurement.checks, command, picture)
        study = compare(given, measured_map if ions is None else ions, [section])
        kept.write({ANSWER: _answer(facts, study, measurement, command)}, [_REPORT])
        told = study.lines()  # by `compare`
    answer = kept.read(ANSWER).decode(errors="replace").splitlines()
    put("\n".join(line for line in answer if line not in told))
    put(f"wrote {folder / _REPORT}")
    return 0


def _made_from(options):
    """SHA-256 of the input files, and all options that change a result."""
    lens = lens_of(options)
    values = {name: value for name, value in vars(options).items() if name not in (*_NO_MATTER, *_FILES)}
    values["lens"] = None if lens is None else to_plain(lens)
    paths = {"FILE": options.file, "file of --ranges": options.ranges, "file of --undistort": options.undistort}
    return {name: None if path is None else sha256_of(path) for name, path in paths.items()}, values


def _start(options, kept):
    """Facts of the first step, made with the settings, or read."""
    if not (kept.has(SETTINGS) and kept.has(FACTS)):
        start = start_of(options)
        put(str(start.indexing))
        if not start.indexing.decided:
            say(
                "warning", "the map does not decide: the first candidate is simulated; --pole, --line and --scales help"
            )
        kept.forget(SETTINGS, FACTS, REGISTRATION, ANSWER, _REPORT)
        facts = (json.dumps(summary(start), indent=1) + "\n").encode()
        kept.write({SETTINGS: start.text.encode(), FACTS: facts})
    path = kept.folder / FACTS
    try:
        return from_plain(json.loads(kept.read(FACTS)), _Facts, what="the result of the first step")
    except (ValueError, RecursionError) as error:
        raise FileError(f"{str(path)!r} is not a result of apt-evap twin: {error}") from None


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
    given = make_parser().parse_args([command, *map(path_word, arguments), *threads])
    given.arguments = options.arguments
    return given


def _candidate(best, options, folder):
    """The first candidate."""
    crystal = material(options.element)
    patterns = master_patterns(crystal.structure)
    try:
        return Candidate(
            orientation=Orientation(crystal, best.axis, best.rotation),
            projection=Projection(best.scale, best.centre, compression=best.compression),
            pattern=min(patterns, key=lambda pattern: abs(pattern.apex_radius - best.pattern_radius)),
            **{name: getattr(best, name) for name in ("score", "confidence", "rolled", "contrast", "angle_error")},
        )
    except ValueError as error:
        raise FileError(f"{str(folder / FACTS)!r} is not a result of apt-evap twin: {error}") from None


def _picture(candidate, measured_map, facts):
    """Measured map with the poles and zone lines of the candidate, as HTML."""
    shown = measured_map.smoothed(max(measured_map.bin_size)) if measured_map.is_counts else measured_map
    ax = plot.detector_map(shown, title=f"{candidate}")
    plot.poles(ax, candidate.orientation, candidate.projection, region=shown, families=8)
    return Page("").picture(ax.figure, f"Measured map with the poles and zone lines that it was simulated with "
                                       f"({facts.verdict}).")  # fmt: skip


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
    words = ["apt-evap", "reconstruct", path_word(Path(options.file)), "--element", options.element]
    for name in ("distance", "detector_radius", "efficiency", "compression", "field_factor", "projection"):
        if name in known:
            value = known[name] if isinstance(known[name], str) else f"{known[name]:.4g}"
            words += [f"--{name.replace('_', '-')}", value]
    words += ["--lens", options.lens] if options.lens is not None else []
    for name in ("ions", "mass", "voltage"):
        if (bounds := getattr(options, name)) is not None:
            words += [f"--{name}", ",".join("" if each is None else f"{each:.10g}" for each in bounds)]
    words += ["--ranges", path_word(Path(options.ranges))] if options.ranges is not None else []
    words += [f"--species={options.species}"] if options.species is not None else []
    return shlex.join(words)


def _answer(facts, study, measurement, command):
    """Constants of the measurement, and what they depend on, as the content of a file."""
    best = facts.best
    lines = [
        f"indexing: {facts.verdict}, {facts.reason}",
        f"axis [{' '.join(f'{index:.3f}' for index in best.axis)}] at the centre of the map, rotation "
        f"{best.rotation:.1f}, errors {best.angle_error:.1f} degrees by noise",
        *str(measurement).splitlines(),
    ]
    if not measurement.arguments:
        lines.append("radius: not known, the file has no voltages")
    lines.append(f"simulated with R = {facts.simulated_radius:.1f} nm")
    lines += study.lines()
    lines.append("the energies depend on the radius and the voltage, and on the rule of the roll-up")
    if command:
        lines.append(f"reconstruct with: {command}")
    return ("\n".join(lines) + "\n").encode(errors="backslashreplace")
