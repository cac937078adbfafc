"""The specimen as spheres that turn when they are dragged, drawn in the browser without a library."""

from typing import Any

import numpy as np
from bokeh.events import Pan, PanStart
from bokeh.models import ColumnDataSource, CustomJS, LinearColorMapper, ScaleBar, WheelZoomTool
from bokeh.palettes import Viridis256

from apt_evap._common.types import Floats, Integers
from apt_evap.explore.specimen_surface import COLORED_BY, SurfaceAtoms
from apt_evap.explore.widgets import color_bar, show_extent, square

SIDES = {"above": (0.0, 90.0), "side": (0.0, 0.0), "oblique": (30.0, 40.0)}
"""Azimuth about z and elevation of a viewer [degrees]; x is to the right at the azimuth 0."""
PIXELS = 420
"""Width and height of the image: 700 kB, made in the browser."""

# Every sphere writes its pixels where it is the nearest so far; the place within a sphere gives the shade.
# Right, up and towards the viewer: (x cos a - y sin a, z cos e + y' sin e, z sin e - y' cos e), y' = x sin a + y cos a.
_DRAW = """
const [azimuth, elevation] = points.tags.map(degrees => degrees * Math.PI / 180)
const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)]
const project = (x, y, z) => {
  const away = x * sa + y * ca
  return [x * ca - y * sa, z * ce + away * se, z * se - away * ce]
}
const {x, y, z, color} = points.data
if (!x.length || !source.data.image.length) return
const image = source.data.image[0], n = Math.sqrt(image.length)
const half = source.data.dw[0] / 2, pixel = 2 * half / n
const depth = new Float32Array(n * n).fill(-Infinity)
image.fill(0)
for (let k = 0; k < x.length; k++) {
  const [right, up, near] = project(x[k], y[k], z[k])
  const u = (right + half) / pixel, v = (up + half) / pixel, radius = Math.max(points.data.radius[k] / pixel, 1)
  const fog = 0.7 + 0.3 * (near + half) / (2 * half), c = color[k]
  for (let j = Math.max(0, Math.ceil(v - radius)); j < Math.min(n, v + radius); j++) {
    for (let i = Math.max(0, Math.ceil(u - radius)); i < Math.min(n, u + radius); i++) {
      const rest = 1 - ((i - u) ** 2 + (j - v) ** 2) / radius ** 2
      if (rest < 0) continue
      const height = Math.sqrt(rest), here = near / pixel + radius * height, at = j * n + i
      if (here <= depth[at]) continue
      depth[at] = here
      const shade = fog * (0.4 + 0.6 * height)
      image[at] = 0xff000000 | (c >> 16 & 255) * shade << 16 | (c >> 8 & 255) * shade << 8 | (c & 255) * shade
    }
  }
}
source.change.emit()
const places = Array.from(marked.data.px, (_, k) => project(marked.data.px[k], marked.data.py[k], marked.data.pz[k]))
marked.data.x = places.map(place => place[0])
marked.data.y = places.map(place => place[1])
marked.change.emit()
"""
_RADIUS = 0.6  # of a sphere, in nearest neighbour distances: few atoms behind are seen through the gaps
_WIDEST = 360  # px, of the figure: its controls are beside it where there is place
_GRASP = "points.grasped = [cb_obj.sx, cb_obj.sy, ...points.tags]"
_TURN = """
const [x, y, azimuth, elevation] = points.grasped
points.tags = [azimuth + (cb_obj.sx - x) / 2, Math.max(-90, Math.min(90, elevation + (cb_obj.sy - y) / 2))]
"""


class SpecimenView:
    """Figure of the atoms of a surface."""

    def __init__(self, title: str = "specimen: drag to turn it") -> None:
        wheel = WheelZoomTool()
        self.figure: Any = square(title, (-1, 1, -1, 1), [wheel])
        self.figure.toolbar.active_scroll = wheel
        self.figure.axis.visible = False
        self.figure.add_layout(
            ScaleBar(range=self.figure.x_range, unit="nm", location="bottom_left", background_fill_alpha=0,
                     border_line_alpha=0, padding=2)
        )  # fmt: skip
        self.figure.update(styles=self.figure.styles | {"max-width": f"{_WIDEST}px"})
        self.points = ColumnDataSource({name: [] for name in ("x", "y", "z", "color", "radius")})
        self.points.tags = list(SIDES["oblique"])
        self.marked = ColumnDataSource({name: [] for name in ("x", "y", "px", "py", "pz")})
        self.source = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        self.colors = LinearColorMapper(palette=Viridis256)
        self.figure.image_rgba("image", "x", "y", "dw", "dh", source=self.source, level="image")
        self.bar = color_bar(self.colors, COLORED_BY["order"])
        self.figure.add_layout(self.bar, "below")
        self.figure.scatter(
            "x", "y", source=self.marked, size=9, fill_alpha=0.0, line_color="red", line_width=2
        )  # fmt: skip
        self.centre = np.zeros(3)
        draw = CustomJS(args={"points": self.points, "source": self.source, "marked": self.marked}, code=_DRAW)
        for model, names in (
            (self.points, ("data", "tags")), (self.marked, ("data",)), (self.figure, ("inner_width",))
        ):  # fmt: skip
            for name in names:
                model.js_on_change(name, draw)
        for event, code in ((PanStart, _GRASP), (Pan, _TURN)):
            self.figure.js_on_event(event, CustomJS(args={"points": self.points}, code=code))

    def put(self, atoms: SurfaceAtoms, color: str) -> None:
        """Show the atoms of a surface, coloured by one of `COLORED_BY`."""
        first, last = (float(end) for end in np.percentile(atoms.values, [1, 99]))
        last = last if last > first else first + 1
        self.colors.update(low=first, high=last)
        self.bar.title = COLORED_BY[color]
        steps = np.clip((atoms.values - first) / (last - first), 0, 1) * 255
        self.put_spheres(atoms.positions, _PALETTE[steps.astype(int)], _RADIUS * atoms.diameter)

    def put_spheres(self, positions: Floats, colors: Integers, radius: float | Floats) -> None:
        """Show spheres at positions [nm], shape (n, 3), with colours as of `pixel_color` and radii [nm]."""
        low, high = positions.min(axis=0), positions.max(axis=0)
        self.centre = (low + high) / 2
        x, y, z = (positions - self.centre).astype(np.float32).T
        half = float((np.sqrt(x * x + y * y + z * z) + 2 * radius).max())
        self.source.data = {
            "image": [np.zeros((PIXELS, PIXELS), np.uint32)], "x": [-half], "y": [-half],
            "dw": [2 * half], "dh": [2 * half],
        }  # fmt: skip
        self.points.data = {
            "x": x, "y": y, "z": z, "color": colors, "radius": np.full(len(x), radius, dtype=np.float32),
        }  # fmt: skip
        show_extent(self.figure, (-half, half, -half, half))

    def mark(self, positions: Floats) -> None:
        """Mark atoms at positions [nm], shape (n, 3)."""
        x, y, z = (positions - self.centre).T
        self.marked.data = {"x": x, "y": y, "px": x, "py": y, "pz": z}

    def set_viewpoint(self, side: str) -> None:
        """Turn to one of `SIDES`."""
        self.points.tags = list(SIDES[side])

    def turn_with(self, other: "SpecimenView") -> None:
        """Turn both views together."""
        for one, two in ((self.points, other.points), (other.points, self.points)):
            code = "if (String(two.tags) != String(one.tags)) two.tags = [...one.tags]"
            one.js_on_change("tags", CustomJS(args={"one": one, "two": two}, code=code))


def pixel_color(color: str) -> int:
    """Colour such as "#ff0000" as a pixel: red is the lowest byte."""
    return int(color[5:7] + color[3:5] + color[1:3], 16)


_PALETTE = np.array([pixel_color(color) for color in Viridis256], np.int32)
