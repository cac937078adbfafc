"""What a twin is made with, beside the measurement."""

from dataclasses import dataclass
from typing import Any

from apt_evap._common.codec import to_plain
from apt_evap._common.files import sha256_of
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_number
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.simulation.config.lens_text import read_lens
from apt_evap.simulation.config.material_text import write_material
from apt_evap.specimen.materials import Material, as_material


@dataclass(frozen=True)
class TwinOptions:
    """What a twin is made with, beside the measurement."""

    element: str | Material
    minutes: float
    lens: str | LocalElectrode | None
    field_factor: float | None
    distance: float | None
    efficiency: float
    scales: tuple[float, ...] | None
    poles: tuple[Any, ...]
    lines: tuple[Any, ...]
    ranges: AnyPath | None

    def __post_init__(self) -> None:
        check_number(self.minutes, "minutes", above=0, unit="min")
        check_number(self.efficiency, "efficiency", above=0, at_most=1)

    @property
    def electrode(self) -> LocalElectrode | None:
        """The lens."""
        return read_lens(self.lens) if isinstance(self.lens, str) else self.lens

    @property
    def lens_text(self) -> str:
        """The lens as the option of a command, "" without one."""
        if self.lens is None or isinstance(self.lens, str):
            return self.lens or ""
        changes = {name: value for name, value in to_plain(self.lens).items() if name != "name" and value is not None}
        return f"local-electrode:{','.join(f'{name}={value!r}' for name, value in changes.items())}"

    def to_plain(self) -> dict[str, Any]:
        """Plain values of what changes a result, by the options of the command."""
        values = {name: getattr(self, name) for name in ("minutes", "field_factor", "distance")}
        values |= {"element": write_material(as_material(self.element))}
        values |= {"efficiency": self.efficiency, "scales": self.scales, "lens": self.electrode}
        values |= {"pole": self.poles or None, "line": self.lines or None}
        record = {f"--{name.replace('_', '-')}": to_plain(value) for name, value in values.items()}
        return record | {"file of --ranges": None if self.ranges is None else sha256_of(self.ranges)}
