"""Command lines and Python lines that give the same maps as the explorer, or select the same ions."""

import shlex
from typing import Any, NamedTuple

from apt_evap._common.codec import to_python
from apt_evap.detection.hits import Hits
from apt_evap.explore.explorer_maps import ExplorerSettings
from apt_evap.simulation.config.perturbation_text import write_perturbation


class Commands(NamedTuple):
    """Text that repeats what the explorer shows."""

    shell: str
    """Command line."""
    python: str
    """Python lines; the maps are `simulated` and `measured`, a selection of ions is `hits`."""


class ExplorerText:
    """Text of an `Explorer`."""

    def __init__(self, explorer: Any) -> None:
        self._explorer = explorer

    def commands(self, settings: ExplorerSettings) -> Commands:
        """Command line and Python lines that give the same maps."""
        # a picture of `map` is neither registered nor flattened
        one = self._explorer.measured is None or self._explorer.run is None
        command = "map" if one and not settings.flattening else "explore"
        # options of the run follow both files
        of_run, of_measurement = self._explorer.words_of_run, self._explorer.words_of_measurement
        shell = ["apt-evap", command, *of_run[:1], *of_measurement, *of_run[1:]]
        shell += self._shell_options(settings, command)
        if settings.flattening:
            shell += ["--flatten", repr(settings.flattening)]
        if self._explorer.registered and self._explorer.registration is not None:
            shell += [f"--registration={self._explorer.registration.to_text()}"]
        return Commands(shlex.join(shell), "\n".join([*self._python_hits(settings), *self._python_maps(settings)]))

    def selection(self, settings: ExplorerSettings, x: tuple[float, float], y: tuple[float, float]) -> Commands:
        """Command line and Python lines that select the ions within a rectangle with these bounds on the map [mm].

        They are of the measured ions if there are any, else of the run. `hits` are the simulated ions in both cases. A
        measured map, which has no ions, has an empty command line.
        """
        bounds = tuple(float(f"{value:.6g}") for value in (*sorted(x), *sorted(y)))
        box = f"--box={','.join(map(repr, bounds))}"
        window = f".window(x=({bounds[0]!r}, {bounds[1]!r}), y=({bounds[2]!r}, {bounds[3]!r}))"
        python = [*self._python_hits(settings)]
        if self._explorer.run is not None:
            python[-1] += window
        shell = ""
        if self._explorer.measured is None:
            shell = shlex.join(
                ["apt-evap", "map", *self._explorer.words_of_run, *self._shell_options(settings, "map"), box]
            )
        elif isinstance(self._explorer.measured, Hits):
            shell = shlex.join(["apt-evap", "map", *self._explorer.words_of_measurement, box])
            python.append(f"measured = {self._explorer.code_of_measurement}{window}")
        return Commands(shell, "\n".join(python))

    def _shell_options(self, settings, command):
        options = [] if self._explorer.run is None else ["--perturbation", write_perturbation(settings.perturbation)]
        options += ["--bins", str(settings.bins), "--smooth", repr(settings.smoothing)]
        if settings.ions is not None:
            # --ions of `explore` selects measured ions
            options += ["--ions" if command == "map" else "--simulated", "{},{}".format(*settings.ions)]
        return options

    def _python_hits(self, settings):
        if self._explorer.run is None:
            return ["import apt_evap as ae", ""]
        lines = ["import apt_evap as ae", "", f"run = {self._explorer.run_code}"]
        hits = f"run.hits({to_python(settings.perturbation)})"
        if self._explorer.registration is not None:
            r = self._explorer.registration
            lines.append(f"registration = ae.Registration({r.rotation!r}, {r.scale!r}, {r.shift!r}, {r.mirror!r})")
            hits = f"registration.hits({hits})"
        window = "" if settings.ions is None else f".window(ion={settings.ions!r})"
        return [*lines, f"hits = {hits}{window}"]

    def _python_maps(self, settings):
        if self._explorer.measured is None:
            lines = [f"simulated = hits.map(like=run.grid({settings.bins}), position_step=None)"]
            names = ["simulated"]
        else:
            arguments = (
                f"None, {self._explorer.code_of_measurement}"
                if self._explorer.run is None
                else f"run, {self._explorer.code_of_measurement}, registration"
            )
            lines = [
                "from apt_evap.explore.explorer import Explorer",
                f"measured = Explorer({arguments}).bins_like({settings.bins})",
            ]
            names = ["measured"]
            if self._explorer.run is not None:
                lines.append("simulated = hits.map(like=measured, position_step=None)")
                names = ["simulated", "measured"]
        flat = f".flattened({settings.flattening!r})" if settings.flattening else ""
        if len(names) > 1:
            lines.append(f"print(ae.similarity(simulated{flat}, measured{flat}, smoothing={settings.smoothing!r}))")
        pictures = ", ".join(f"{name}{flat}.smoothed({settings.smoothing!r})" for name in names)
        return [*lines, f"ae.plot.detector_maps([{pictures}])[0].figure.savefig('maps.png')"]
