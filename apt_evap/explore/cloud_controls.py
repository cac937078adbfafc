"""Region and isosurface of the ions of a reconstruction, and of the same ions at their true sites."""

from collections.abc import Callable

import numpy as np
from bokeh.layouts import row
from bokeh.models import Div, NumericInput, Select, TextInput

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_number
from apt_evap.measures.point_cloud import PointCloud
from apt_evap.specimen.regions import Cylinder, Layer, Region, Sphere

_REGIONS: dict[str, Callable[[tuple[float, float, float], float], Region]] = {
    "sphere": Sphere,
    "cylinder": Cylinder,
    "layer": lambda centre, size: Layer(centre[2] - size / 2, centre[2] + size / 2),
}
_ALL, _NONE = "all ions", "none"


class CloudControls:
    """Widgets that choose a region and an isosurface.

    Parameters
    ----------
    changed : callable
        Is called after each change.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self.kind = Select(title="region", options=[_ALL, *_REGIONS], value=_ALL, width=100)
        self.centre = TextInput(title="centre x, y, z [nm]", width=130, visible=False)
        self.size = NumericInput(title="radius [nm]", mode="float", low=1e-3, value=1.0, width=105, visible=False)
        self.element = Select(title="isosurface of", options=[_NONE], value=_NONE, width=100)
        self.fraction = NumericInput(title="at [at.%]", mode="float", low=0, high=100, value=10.0, width=80)
        self.text = Div(text="")
        self.row = row(
            self.kind, self.centre, self.size, self.element, self.fraction, visible=False, styles={"flex-wrap": "wrap"}
        )
        for widget in (self.kind, self.centre, self.size, self.element, self.fraction):
            widget.on_change("value", lambda attr, old, new: self._follow(changed))

    def _follow(self, changed):
        self.centre.visible = self.size.visible = self.kind.value != _ALL
        self.size.title = "thickness [nm]" if self.kind.value == "layer" else "radius [nm]"
        changed()

    def offer(self, cloud: PointCloud) -> None:
        """Offer the elements of ions, and a centre among them if none was typed."""
        self.row.visible = True
        options = [_NONE, *cloud.elements]
        self.element.update(options=options, value=self.element.value if self.element.value in options else _NONE)
        if not self.centre.value:
            self.centre.value = ", ".join(f"{x:.1f}" for x in np.median(cloud.positions, axis=0))

    @property
    def used(self) -> bool:
        """Whether there is a region or an isosurface."""
        return self.kind.value != _ALL or self.element.value != _NONE

    def region(self) -> Region | None:
        """The region, None for all ions.

        Raises
        ------
        ValueError
            If its numbers are none.
        """
        if self.kind.value == _ALL:
            return None
        try:
            x, y, z = (float(part) for part in self.centre.value.split(","))
        except ValueError:
            raise ValueError(
                f"centre must be three numbers with commas between them, got {self.centre.value!r}"
            ) from None
        return _REGIONS[self.kind.value]((x, y, z), check_number(self.size.value or 0.0, self.size.title, above=0))

    def surface(self, cloud: PointCloud) -> Floats:
        """Points on the isosurface, shape (n, 3): the corners and the centres of its triangles.

        Raises
        ------
        ValueError
            If the fraction is nowhere among the ions.
        """
        if self.element.value == _NONE:
            return np.zeros((0, 3))
        mesh = cloud.field(self.element.value).isosurface((self.fraction.value or 0.0) / 100)
        return np.concatenate([mesh.vertices, mesh.vertices[mesh.faces].mean(axis=1)])


def words(cloud: PointCloud) -> str:
    """Number of ions, and the fractions of their elements with errors."""
    if not len(cloud):
        return "no ions"
    parts = [f"{name} {100 * x:.1f} ± {100 * error:.1f} %" for name, (x, error) in cloud.fractions().items()]
    return f"{len(cloud):,} ions, " + ", ".join(parts)
