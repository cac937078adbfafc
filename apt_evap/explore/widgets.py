"""Parts of the page: folding groups, sliders with a field for the number, and square figures that fill their place."""

from collections.abc import Callable, Sequence
from typing import Any

from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    ColorBar,
    CustomJS,
    InlineStyleSheet,
    RadioButtonGroup,
    Range1d,
    Slider,
    Spinner,
    Toggle,
)
from bokeh.plotting import figure

LEFT = 300
"""Width of the controls [px]."""
_NARROWEST = 290  # px, of a map: two of them stand side by side in a window of 1000 px
_ABOVE = 120  # px of the window above and below a map
_RATIO = 0.9  # width over height of a map, with its axes and colour bar
_LOWER = f"{_RATIO} * max(320px, 100vh - 400px)"  # of two maps above the tabs: their upper half is seen, too
_WIDEST = f"{_RATIO} * max(300px, 100vh - {_ABOVE}px)"
# one map has the tabs beside it; two maps only in a wide window
_WORK = f"""
:host {{ display: grid; grid-template-columns: minmax(0, 1fr); gap: 12px; align-items: start; }}
@media (min-width: 1150px) {{ :host(.one) {{ grid-template-columns: minmax(0, calc({_WIDEST})) minmax(360px, 1fr); }} }}
:host(.two) > div:first-of-type {{ max-width: calc(2 * {_LOWER}); }}
@media (min-width: 1500px) {{
  :host(.two) {{ grid-template-columns: minmax(0, calc(2 * {_WIDEST})) minmax(380px, 1fr); }}
  :host(.two) > div:first-of-type {{ max-width: none; }}
}}
"""

# the frame of a figure is seldom square: the longer direction shows more, so that both have the same scale
_KEEP_SQUARE = """
if (!(fig.inner_width > 0 && fig.inner_height > 0)) return
const ratio = fig.inner_height / fig.inner_width
for (const [range, stretch] of [[fig.x_range, Math.max(1, 1 / ratio)], [fig.y_range, Math.max(1, ratio)]]) {
  const [low, high] = range.tags
  const middle = (low + high) / 2, half = (high - low) / 2 * stretch
  range.setv({start: middle - half, end: middle + half, reset_start: middle - half, reset_end: middle + half})
}
"""
# tabs below the maps may begin near the end of the window
_TAB = """
places.forEach((place, k) => { place.visible = k == choice.active })
setTimeout(() => Bokeh.index.find_one(places[choice.active])?.el.scrollIntoView({block: "nearest"}), 200)
"""
_FIRST_ESTIMATE = 0.05  # of a search: the start of its process counts as if it were slow before
_COPY = """
navigator.clipboard.writeText(text.text)
button.label = "copied"
setTimeout(() => { button.label = label }, 1500)
"""
_SAVE = """
figures.forEach((fig, k) => {
  const view = Bokeh.index.find_one(fig)
  if (!view) return
  const layer = view.export("png", true), context = layer.canvas.getContext("2d")
  context.resetTransform()
  context.globalCompositeOperation = "destination-over"  // figures are transparent outside their axes
  context.fillStyle = getComputedStyle(view.el).getPropertyValue("--paper")
  context.fillRect(0, 0, layer.canvas.width, layer.canvas.height)
  layer.to_blob().then(blob => {
    const link = document.createElement("a")
    link.href = URL.createObjectURL(blob)
    link.download = `map_${k + 1}.png`
    link.click()
  })
})
"""


def square(title: str, extent: Sequence[float], tools: Sequence[Any], **options: Any) -> Any:
    """Figure without a toolbar for an image, with equal scales along both axes and the width of its place."""
    fig = figure(
        title=title,
        sizing_mode="scale_width",
        aspect_ratio=_RATIO,
        min_width=_NARROWEST,
        styles={"max-width": f"calc({_WIDEST})"},
        tools=list(tools),
        toolbar_location=None,
        **({"x_range": Range1d(), "y_range": Range1d()} | options),
    )
    fig.grid.visible = False
    show_extent(fig, extent)
    if "x_range" not in options:  # else the figure that it shares its ranges with sets them, for both
        keep = CustomJS(args={"fig": fig}, code=_KEEP_SQUARE)
        for name in ("inner_width", "inner_height"):
            fig.js_on_change(name, keep)
        fig.x_range.js_on_change("tags", keep)
    return fig


def show_extent(fig: Any, extent: Sequence[float]) -> None:
    """Show a square about an area; the page stretches it to the frame of the figure."""
    left, right, lower, upper = extent
    half = 0.52 * max(right - left, upper - lower)
    for axis, middle in ((fig.y_range, 0.5 * (lower + upper)), (fig.x_range, 0.5 * (left + right))):
        ends = [middle - half, middle + half]
        if axis.tags != ends:
            axis.update(start=ends[0], end=ends[1])
            axis.tags = ends


def color_bar(mapper: Any, title: str, **options: Any) -> ColorBar:
    """Colour bar with a label, below a figure."""
    return ColorBar(color_mapper=mapper, height=8, title=title, orientation="horizontal", padding=4, **options)


def slider_with_number(slider: Slider) -> Any:
    """Slider with a field in which its number can be typed."""
    field = Spinner(
        value=slider.value,
        low=slider.start,
        step=slider.step,
        format="0[.]000",
        width=80,
        margin=(17, 5, 0, 0),
        css_classes=["number"],
        name=slider.title,
    )
    slider.js_link("value", field, "value")
    field.js_on_change(
        "value_throttled",
        CustomJS(
            args={"slider": slider},
            code="const value = cb_obj.value_throttled\n"
            "if (value == null) return\n"
            "slider.setv({end: Math.max(slider.end, value), value})\n"
            "slider.value_throttled = value",
        ),
    )
    slider.width = LEFT - 100
    both = row(slider, field)
    slider.on_change("visible", lambda attr, old, new: both.update(visible=new))
    both.visible = slider.visible
    return both


def request_maps_of(slider: Any, request: Callable[[bool], None]) -> None:
    """Request maps when a slider moves or rests: `request` is called with whether a preview is enough."""
    slider.on_change("value", lambda attr, old, new: request(True))
    slider.on_change("value_throttled", lambda attr, old, new: request(False))


def group(title: str, children: Sequence[Any], reset: Callable[[], None] | None = None, active: bool = True) -> Any:
    """Group of widgets under a title that folds it, with a button that resets them."""
    inside = column(*children, sizing_mode="stretch_width", visible=active)
    head = Toggle(label=title, active=active, sizing_mode="stretch_width", height=28, css_classes=["group"])
    head.js_link("active", inside, "visible")
    top: list[Any] = [head]
    if reset is not None:
        button = Button(label="reset", width=56, height=28)
        button.on_click(reset)
        top.append(button)
    return column(row(*top, sizing_mode="stretch_width"), inside, sizing_mode="stretch_width")


def maps_and_tabs(maps: Sequence[Any], tabs: Any) -> Any:
    """Maps side by side as large as the window allows, with tabs beside or below them."""
    columns = {"display": "grid", "grid-template-columns": f"repeat({len(maps)}, minmax(0, 1fr))", "gap": "6px"}
    pair = column(*maps, sizing_mode="stretch_width", styles=columns)
    name = "one" if len(maps) == 1 else "two"
    return column(
        pair, tabs, sizing_mode="stretch_width", css_classes=[name], stylesheets=[InlineStyleSheet(css=_WORK)]
    )


class Tabs:
    """Widgets of which one is shown, below a row of titles.

    Bokeh's own tabs do not draw the figures in them where their place has the width of a grid.
    """

    def __init__(self, contents: dict[str, Sequence[Any]]) -> None:
        self.titles = list(contents)
        self.choice = RadioButtonGroup(labels=self.titles, active=0, css_classes=["tabs"])
        self._places = [
            column(*parts, sizing_mode="stretch_width", visible=number == 0)
            for number, parts in enumerate(contents.values())
        ]
        self.choice.js_on_change("active", CustomJS(args={"places": self._places, "choice": self.choice}, code=_TAB))
        self.column = column(self.choice, *self._places, sizing_mode="stretch_width")

    def show(self, title: str) -> None:
        """Show the widgets of a title."""
        self.choice.active = self.titles.index(title)
        for number, place in enumerate(self._places):
            place.visible = number == self.choice.active


def progress_text(part: float, seconds: float, doing: str) -> str:
    """HTML of a bar that fills, with what goes on and the time left by its own rate after some seconds."""
    left = "" if part < _FIRST_ESTIMATE or seconds <= 0 else f", about {duration(seconds / part * (1 - part))} left"
    return f'<progress value="{part:.3g}" max="1" style="width: 120px"></progress> <small>{doing}{left}</small>'


def duration(seconds: float) -> str:
    """Seconds, or minutes, as words."""
    return f"{seconds / 60:.0f} min" if seconds > 100 else f"{seconds:.0f} s"


def copy_button(label: str, text: Any) -> Button:
    """Button that copies a text and says so."""
    button = Button(label=label, width=150)
    button.js_on_click(CustomJS(args={"text": text, "button": button, "label": label}, code=_COPY))
    return button


def save_button(figures: Sequence[Any]) -> Button:
    """Button that saves the pictures of figures."""
    button = Button(label="save pictures", width=110)
    button.js_on_click(CustomJS(args={"figures": list(figures)}, code=_SAVE))
    return button
