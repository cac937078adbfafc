"""Simulations from TOML files: every table and key is checked, and a wrong one is named with what was expected."""

import inspect
import re
import tomllib
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from apt_evap._arrays import check_count, check_number, check_seed, did_you_mean, shown
from apt_evap._files import FileError, open_for_reading
from apt_evap.binning import MOST_BINS
from apt_evap.detector import Detector
from apt_evap.emitter import ChargeSettings, check_voltage
from apt_evap.energy import Fixed, Thermal, TruncatedNormal
from apt_evap.material import MATERIALS, Material, material
from apt_evap.perturbation import Perturbation, RollUp, Unperturbed, from_dict, to_dict
from apt_evap.response import ResponseSettings
from apt_evap.run_file import is_run
from apt_evap.simulation import FlightSettings, Simulation
from apt_evap.tip import Tip
from apt_evap.watch import WatchSettings

_LENGTH = re.compile(r"\s*(\S+?)\s*(a|nm)\s*")


@dataclass(frozen=True)
class Panel:
    """One map of a picture: the perturbation of its ions, and the title above it."""

    title: str
    perturbation: Perturbation


@dataclass(frozen=True)
class MapSettings:
    """Maps to draw side by side.

    Parameters
    ----------
    panels : tuple of Panel
        The maps.
    bins : int, optional
        Bins along the longer side.
    smoothing : float, optional
        Standard deviation of the Gaussian that smooths the maps [mm].
    """

    panels: tuple
    bins: int | None = None
    smoothing: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the settings in plain types, as the table [maps] of a TOML file has them."""
        panels = [{"title": panel.title, "perturbation": to_dict(panel.perturbation)} for panel in self.panels]
        return {"panels": panels, "bins": self.bins, "smoothing": self.smoothing}


@dataclass(frozen=True, repr=False)
class Config:
    """What a TOML file says about a simulation; made by `read_config`.

    Parameters
    ----------
    path : Path
        The file.
    tip : dict
        Arguments of `Tip`.
    n_ions : int
        Number of atoms to evaporate.
    responses : bool
        Whether responses are flown; if not, the perturbations of the maps are flown instead.
    voltage : float
        Applied voltage [V].
    seed : int
        Seed of the random numbers of the perturbations.
    detector : Detector
        The detector.
    charge_settings, flight_settings, response_settings : ChargeSettings, FlightSettings, ResponseSettings
        How finely everything is computed.
    watch_settings : WatchSettings
        How the run is watched.
    maps : MapSettings
        Maps to draw of the run.
    output : str or None
        Where the run goes.
    """

    path: Path
    tip: dict
    n_ions: int
    responses: bool
    voltage: float
    seed: int
    detector: Detector
    charge_settings: ChargeSettings
    flight_settings: FlightSettings
    response_settings: ResponseSettings
    watch_settings: WatchSettings
    maps: MapSettings
    output: str | None

    def __repr__(self) -> str:
        host, radius = self.tip["material"].name, self.tip["apex_radius"]
        panels = ", ".join(panel.title for panel in self.maps.panels)
        return (
            f"<Config {str(self.path)!r}: {self.n_ions:,} ions of {host}, apex radius {radius:.4g} nm; maps: {panels}>"
        )

    @property
    def emissions(self) -> tuple[Perturbation, ...]:
        """Perturbations to fly beside the responses: none, or without responses those of the maps."""
        return () if self.responses else tuple(dict.fromkeys(panel.perturbation for panel in self.maps.panels))

    def simulation(self, *, seed: int | None = None, n_threads: int | None = None) -> Simulation:
        """Build the specimen and the simulation.

        Parameters
        ----------
        seed : int, optional
            Instead of that of the file.
        n_threads : int, optional
            Threads; by default the processors this process may use.

        Returns
        -------
        Simulation

        Raises
        ------
        FileError
            If the specimen is impossible, or the flights do not fit it; the message names the file.
        """
        with _place(self.path, "tip"):
            tip = Tip(**self.tip)
        with _place(self.path):  # flights against tip or detector: no single table
            return Simulation(
                tip,
                voltage=self.voltage,
                seed=self.seed if seed is None else seed,
                detector=self.detector,
                charge_settings=self.charge_settings,
                flight_settings=self.flight_settings,
                response_settings=self.response_settings,
                watch_settings=self.watch_settings,
                n_threads=n_threads,
            )


def read_config(path: str | Path) -> Config:
    """Read a simulation from a TOML file.

    The tables are ``[tip]`` (the arguments of `Tip`; lengths in nm or, as text, in lattice constants: "20 a"),
    ``[simulation]`` (ions, voltage, seed, responses), ``[detector]``, ``[charges]``, ``[flights]``, ``[responses]``,
    ``[watch]`` (fields of `Detector`, `ChargeSettings`, `FlightSettings`, `ResponseSettings`, `WatchSettings`) and
    ``[maps]`` (bins, smoothing and panels, each with a title and a perturbation as in
    `apt_evap.perturbation.from_dict`). Only ``[tip]`` with a material and an apex_radius, and the ions of
    ``[simulation]``, have to be there.

    Parameters
    ----------
    path : str or path-like
        The file.

    Returns
    -------
    Config

    Raises
    ------
    FileError
        If the file cannot be read or is not TOML, or a table, key or value is wrong; the message names it.
    """
    with open_for_reading(path) as file:
        content = file.read()
    path = Path(path)
    try:
        document = tomllib.loads(content.decode())
    except UnicodeDecodeError as error:
        what = "a run: see apt-evap info" if is_run(path) else "not a TOML file: it is not text in UTF-8"
        raise FileError(f"{str(path)!r} is {what}") from error
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise FileError(f"{str(path)!r} is not a TOML file: {error}") from error
    with _place(path):
        tables = ("tip", "simulation", "detector", "charges", "flights", "responses", "watch", "maps")
        _check_keys(document, ("output", *tables), ("tip", "simulation"))
        for name in tables:
            _check_table(document.get(name, {}), f"[{name}]")
        output = document.get("output")
        if output is not None and not (isinstance(output, str) and output):
            raise ValueError(f"output must be a file name such as 'run.h5', got {shown(output)}")
    with _place(path, "tip"):
        tip = _tip(document["tip"])
    with _place(path, "simulation"):
        simulation = document["simulation"]
        _check_keys(simulation, ("ions", "voltage", "seed", "responses"), ("ions",))
        n_ions = check_count(simulation["ions"], "ions", at_least=1)
        voltage = check_voltage(simulation.get("voltage", 1000.0))
        seed = check_seed(simulation.get("seed", 0))
        responses = simulation.get("responses", True)
        if not isinstance(responses, bool):
            raise ValueError(f"responses must be true or false, got {shown(responses)}")
    made = []
    for name, kind, known in (
        ("detector", Detector, _field_names(Detector)),
        ("charges", ChargeSettings, _field_names(ChargeSettings)),
        ("flights", FlightSettings, _field_names(FlightSettings)),
        ("responses", ResponseSettings, ("energy_limit", "bound")),
        ("watch", WatchSettings, _field_names(WatchSettings)),
    ):
        with _place(path, name):
            _check_keys(document.get(name, {}), known)
            made.append(kind(**document.get(name, {})))
    with _place(path, "maps"):
        maps = read_maps(document.get("maps", {}))
    return Config(path, tip, n_ions, responses, voltage, seed, *made, maps, output)  # type: ignore[arg-type, call-arg]


def read_maps(table: Mapping[str, Any]) -> MapSettings:
    """Read what maps to draw from a table such as ``[maps]`` of a TOML file.

    Parameters
    ----------
    table : mapping
        bins, smoothing [mm] and panels, a list of tables with a perturbation and a title; nothing has to be there.
        Without panels they are one without perturbation and one of a roll-up with the energies that Shaikh et al.
        (arXiv 2509.13744) find for nickel, 0.155 eV and 0.155 eV.

    Returns
    -------
    MapSettings

    Raises
    ------
    ValueError
        Naming the key, its value and what was expected.
    """
    _check_keys(table, ("panels", "bins", "smoothing"))
    bins, smoothing = table.get("bins"), table.get("smoothing")
    if bins is not None:
        bins = check_count(bins, "bins", at_least=1, at_most=MOST_BINS)
    if smoothing is not None:
        smoothing = check_number(smoothing, "smoothing", at_least=0, unit="mm")
    if table.get("panels") is None:
        usual = (Unperturbed(), RollUp(TruncatedNormal(0.155, 0.155)))
        return MapSettings(tuple(Panel(title_of(each), each) for each in usual), bins, smoothing)
    if not isinstance(table["panels"], list) or not table["panels"]:
        raise ValueError(f"panels must be a list of tables such as [[maps.panels]], got {shown(table['panels'])}")
    panels = []
    for number, entry in enumerate(table["panels"], start=1):
        try:
            _check_table(entry, "it")
            _check_keys(entry, ("title", "perturbation"), ("perturbation",))
            perturbation = read_perturbation(entry["perturbation"])
            title = entry.get("title", title_of(perturbation))
            if not isinstance(title, str):
                raise ValueError(f"title must be text, got {shown(title)}")
        except ValueError as error:
            raise ValueError(f"panel {number}: {error}") from error
        panels.append(Panel(title, perturbation))
    return MapSettings(tuple(panels), bins, smoothing)


def read_perturbation(settings: str | Mapping[str, Any]) -> Perturbation:
    """Make a perturbation from a table with its name and parameters, or from text.

    Parameters
    ----------
    settings : str or mapping
        ``{"name": "RollUp", "energy": {"name": "TruncatedNormal", "mean": 0.3, "standard_deviation": 0.1}}``, where a
        number as energy is the same for every ion [eV]; as text the name alone, ``"RollUp:0.2"`` for the same energy,
        ``"RollUp:0.3,0.1"`` for a mean and a standard deviation [eV], ``"Combined:0.3,0.1,0.75"`` with the
        rollup_fraction last, or the table as TOML writes it.

    Returns
    -------
    perturbation

    Raises
    ------
    ValueError
        If a name is unknown, or a parameter is unknown, missing or out of its range.
    """
    if isinstance(settings, str):
        try:
            return read_perturbation(_perturbation_table(settings))
        except ValueError as error:
            raise ValueError(f"perturbation {settings!r}: {error}; an example is RollUp:0.155,0.155") from error
    _check_table(settings, "perturbation")
    for table in (settings, *settings.values()):
        if isinstance(table, Mapping) and not isinstance(table.get("name"), str):
            raise ValueError(f"a perturbation or distribution must have a name, got {shown(dict(table))}")
    perturbation = from_dict(settings)
    if not callable(getattr(perturbation, "launch", None)):
        raise ValueError(f"perturbation must be one, such as Unperturbed or RollUp, got {shown(dict(settings))}")
    return perturbation


def _perturbation_table(text):
    """Table of a perturbation that is given as text."""
    if text.lstrip().startswith("{"):
        return tomllib.loads(f"perturbation = {text}")["perturbation"]
    name, colon, numbers = text.partition(":")
    if not colon:
        return {"name": name}
    try:
        values = [float(number) for number in numbers.split(",")]
    except ValueError:
        raise ValueError(f"expected numbers with commas between them after the colon, got {numbers!r}") from None
    share = {"rollup_fraction": values.pop()} if name == "Combined" else {}
    if len(values) not in (1, 2):
        expected = "1 or 2 numbers (an energy, or mean and standard deviation)"
        raise ValueError(f"{name} takes {expected}{' and its share of roll-up' if share else ''}, got {numbers!r}")
    normal = dict(zip(("name", "mean", "standard_deviation"), ("TruncatedNormal", *values), strict=False))
    return {"name": name, "energy": values[0] if len(values) == 1 else normal, **share}


def title_of(perturbation: Any) -> str:
    """Title of a map of the ions of a perturbation (str), such as "roll-up, 0.155 ± 0.155 eV"."""
    name = type(perturbation).__name__
    words = {"Unperturbed": "unperturbed", "LateralVelocity": "lateral velocity", "RollUp": "roll-up"}
    title = words.get(name, name)
    if name == "Combined":
        title = f"{perturbation.rollup_fraction:.3g} roll-up + {1 - perturbation.rollup_fraction:.3g} lateral"
    energy = getattr(perturbation, "energy", None)
    if isinstance(energy, Fixed):
        return f"{title}, {energy.energy:g} eV"
    if isinstance(energy, Thermal):
        return f"{title}, {energy.temperature:g} K"
    if isinstance(energy, TruncatedNormal):
        return f"{title}, {energy.mean:g} ± {energy.standard_deviation:g} eV"
    return title


def _tip(table):
    """Arguments of `Tip` from the table [tip]."""
    known = tuple(inspect.signature(Tip).parameters)
    _check_keys(table, known, ("material", "apex_radius"))
    host = table["material"]
    if isinstance(host, Mapping):
        _check_keys(host, _field_names(Material), ("name",))
        changes = {key: value for key, value in host.items() if key != "name"}
        if host["name"] in list(MATERIALS):
            host = material(**host)
        else:
            _check_keys(host, _field_names(Material), ("structure", "a", "evaporation_field", "charge_state", "mass"))
            host = Material(host["name"], **changes)
    elif isinstance(host, str):
        host = material(host)
    else:
        raise ValueError(f"material must be a name such as 'Ni' or a table, got {shown(host)}")
    settings = dict(table, material=host)
    for name in ("apex_radius", "shank_length", "depth"):
        if name in settings:
            settings[name] = _length(settings[name], name, host.a)
    if isinstance(settings.get("origin"), list):
        settings["origin"] = [_length(value, "origin", host.a) for value in settings["origin"]]
    if "solutes" in settings:
        _check_table(settings["solutes"], "solutes")
    return settings


def _length(value, name, a):
    """Length [nm] of a number [nm] or a text such as "20 a"; `Tip` checks its range."""
    if not isinstance(value, str):
        return check_number(value, name, unit="nm")
    found = _LENGTH.fullmatch(value)
    try:
        return float(found[1]) * (a if found[2] == "a" else 1.0)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number [nm] or text such as '20 a' or '7 nm', got {shown(value)}") from None


def _field_names(kind):
    return tuple(item.name for item in fields(kind) if item.name != "sources")


def _check_table(value, name):
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a table, got {shown(value)}")


def _check_keys(table, known, needed=()):
    for key in table:
        if key not in known:
            raise ValueError(f"no key is named {shown(key)}{did_you_mean(key, known)}; known are {', '.join(known)}")
    for key in needed:
        if key not in table:
            raise ValueError(f"{key} is missing; needed are {', '.join(needed)}")


@contextmanager
def _place(path, table=None):
    """Say in front of an error in which file and table it is."""
    try:
        yield
    except ValueError as error:
        raise FileError(f"{str(path)!r}{f', [{table}]' if table else ''}: {error}") from error
