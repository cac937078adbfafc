"""`apt-evap twin`: from a measured file to a simulation of its specimen, a fit and a report."""

import argparse
import json
import math
from pathlib import Path

from apt_evap._common.codec import to_plain
from apt_evap._common.files import FileError, check_path, read_small_file, replace_file
from apt_evap.cli import run as run_command
from apt_evap.cli._files import lens_of
from apt_evap.cli._output import put, say
from apt_evap.cli.compare import compare
from apt_evap.cli.index import map_of
from apt_evap.cli.parser import make_parser
from apt_evap.cli.start import is_start, start_of, summary
from apt_evap.emission.perturbations import LateralVelocity, RollUp
from apt_evap.registration.register import Registration, register
from apt_evap.simulation.run import load
from apt_evap.twin.start import ENERGY, FIELD_FACTOR, HEIGHT, ROLLS, SHARPNESS

SETTINGS, FACTS, RUN, REGISTRATION, STUDY, ANSWER = (
    "specimen.toml", "start.json", "run.h5", "registration.json", "study", "answer.txt",
)  # fmt: skip
_LARGEST = 1 << 24  # bytes of start.json
_ROTATIONS, _SCALES, _TILT = (-5.0, 5.0), (0.94, 1.06), 3.0  # degrees, factor, degrees: bounds of the registration
_FRACTIONS = "0.2,0.4,0.6,0.8,1"  # that roll up, in the fit


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
        near = Registration(0.0, 1.0, tuple(best["centre"]))
        # the indexing knows rotation, scale and place better than a search
        registration = register(
            run.hits(emission), measured_map, start=near, rotations=_ROTATIONS, scales=_SCALES, tolerance=_shift(best)
        )
        with replace_file(folder / REGISTRATION) as file:
            file.write((json.dumps(to_plain(registration), indent=1) + "\n").encode())
    if not (folder / STUDY / "report.html").exists():
        arguments = [folder / RUN, options.file, "-o", folder / STUDY, "--registration", folder / REGISTRATION]
        emission_options = ["--mechanism", "lateral", "--option", f"height={HEIGHT}"]
        if rolls:
            emission_options = ["--mechanism", "roll-up", "--option", f"probability={_FRACTIONS}"]
            emission_options += ["--option", f"sharpness={SHARPNESS}", "--option", f"height={HEIGHT}"]
        given = _parsed("compare", *arguments, *emission_options, options=options)
        study = compare(given, measured_map if ions is None else ions)
        _write_answer(folder / ANSWER, facts, study, options)
    put(read_small_file(folder / ANSWER, _LARGEST, "an answer").decode().rstrip())
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


def _parsed(command, *arguments, options):
    """Options of another command."""
    threads = [] if options.threads is None else ["--threads", str(options.threads)]
    given = make_parser().parse_args([command, *map(str, arguments), *threads])
    given.arguments = options.arguments
    return given


def _shift(candidate):
    """Largest shift of the registration [mm]."""
    return math.radians(_TILT) * candidate["scale"]


def _write_answer(path, facts, study, options):
    """Constants of the measurement, and what they depend on."""
    best = facts["candidates"][0]
    lines = [
        f"indexing: {facts['verdict']}, {facts['reason']}",
        f"axis [{' '.join(f'{each:.3f}' for each in best['axis'])}] at the centre of the map, rotation "
        f"{best['rotation']:.1f}, errors {best['angle_error']:.1f} degrees by noise",
        f"scale {best['scale']:.1f} mm/rad",
    ]
    reconstruct = ["apt-evap", "reconstruct", options.file, "--element", options.element]
    if options.distance is not None:
        compression = options.distance / best["scale"]
        lines[-1] += (
            f": image compression {compression:.2f}, only as sure as the flight length of {options.distance:g} mm"
        )
        reconstruct += ["--distance", f"{options.distance:g}", "--compression", f"{compression:.2f}"]
    first, last = (math.nan if each is None else each for each in facts["radii"])
    lens = lens_of(options)
    if math.isnan(first):
        lines.append("radius: not known, the file has no voltages")
    else:
        why = "the lens" if lens is not None else f"k_f = {options.field_factor or FIELD_FACTOR:g}"
        lines.append(f"radius {first:.1f} to {last:.1f} nm by {why}: k_f, F and R are known only as the product V")
        if lens is None:
            reconstruct += ["--field-factor", f"{options.field_factor or FIELD_FACTOR:g}"]
    lines.append(f"simulated with R = {facts['simulated_radius']:.1f} nm")
    if options.lens is not None:
        reconstruct += ["--lens", options.lens]
    lines += study.lines()
    lines.append("the energies depend on the radius and the voltage, and on the rule of the roll-up")
    lines.append(f"reconstruct with: {' '.join(reconstruct)}")
    with replace_file(path) as file:
        file.write(("\n".join(lines) + "\n").encode())
