"""Colours of the page: dark for maps on a screen, light for print."""

from bokeh.themes import Theme

_COLORS = {
    "dark": {
        "paper": "#15181c",
        "panel": "#1e2329",
        "ink": "#e3e6ea",
        "link": "#8cc4ff",
        "faint": "#98a2ad",
        "edge": "#3a424c",
    },
    "light": {
        "paper": "#ffffff",
        "panel": "#f4f5f7",
        "ink": "#17191c",
        "link": "#1c5b9e",
        "faint": "#6b7480",
        "edge": "#c9ced4",
    },
}
STYLES = tuple(_COLORS)
"""Names of the styles."""
VEIL = {"dark": (21, 24, 28, 150), "light": (255, 255, 255, 150)}
"""Red, green, blue and opacity over the part of a map that is not compared."""

WIDGETS = """
:host, label, .bk-input-group, .bk-slider-title, .bk-slider-value { color: var(--ink); }
.bk-input, .bk-btn, .bk-btn-default { background-color: var(--panel); color: var(--ink); border-color: var(--edge); }
.bk-input option, .bk-menu { background-color: var(--panel); color: var(--ink); }
.bk-input::placeholder { color: var(--faint); }
.bk-btn-default:hover, .bk-btn-default:disabled { background-color: var(--edge); color: var(--ink); }
.bk-btn-default.bk-active, .bk-btn.bk-active { background-color: #2f6fb3; color: #ffffff; }
.bk-btn-primary, .bk-btn-primary:hover { background-color: #2f6fb3; color: #ffffff; font-weight: 600; }
.bk-btn { padding: 4px 8px; }
small { font-size: 12px; color: var(--faint); }
.noUi-target { background-color: var(--edge); }
.noUi-connect { background-color: #2f6fb3; }
:host(.number) .bk-input { height: 26px; padding: 2px 6px; }
:host(.group) .bk-btn { background: transparent; color: var(--ink); border-width: 0 0 1px 0; border-radius: 0;
  text-align: left; font-weight: 600; box-shadow: none; }
:host(.group) .bk-btn::before { content: "\\25b8  "; }
:host(.group) .bk-btn.bk-active { box-shadow: none; }
:host(.group) .bk-btn.bk-active::before { content: "\\25be  "; }
:host(.tabs) .bk-btn { background: transparent; color: var(--ink); border-width: 0 0 3px 0; border-radius: 0;
  border-color: var(--edge); padding: 6px 5px; box-shadow: none; }
:host(.tabs) .bk-btn-group { flex-wrap: wrap; }
:host(.tabs) .bk-btn.bk-active { background: transparent; color: var(--ink); border-color: #2f6fb3; font-weight: 600; }
pre { white-space: pre-wrap; overflow-wrap: anywhere; color: var(--ink); }
progress { appearance: none; height: 8px; border: 1px solid var(--edge); border-radius: 4px; overflow: hidden;
  background: var(--panel); vertical-align: middle; }
progress::-webkit-progress-bar { background: var(--panel); }
progress::-webkit-progress-value { background: #2f6fb3; }
progress::-moz-progress-bar { background: #2f6fb3; }
table { border-spacing: 8px 0; }
"""
"""CSS of all widgets; the colours follow those of the page."""


def page_styles(style: str) -> dict[str, str]:
    """CSS of the outermost widget; the colours are variables for those inside (dict)."""
    colors = {f"--{name}": color for name, color in _COLORS[style].items()}
    text = {"background-color": "var(--paper)", "color": "var(--ink)", "font-family": "system-ui, sans-serif"}
    return colors | text | {"min-height": "100vh", "padding": "0 8px", "box-sizing": "border-box"}


def theme(style: str) -> Theme:
    """Theme of the figures."""
    c = _COLORS[style]
    text = {"axis_label_text_color": c["ink"], "major_label_text_color": c["ink"]}
    sizes = {"axis_label_text_font_size": "13px", "major_label_text_font_size": "12px"}
    lines = dict.fromkeys(("major_tick_line_color", "minor_tick_line_color", "axis_line_color"), c["faint"])
    return Theme(
        json={
            "attrs": {
                "Plot": {
                    "background_fill_color": c["panel"],
                    # that of the page: half of the first pixel would keep the colour painted before another style
                    "border_fill_color": None,
                    "outline_line_color": c["edge"],
                },
                "Grid": {"grid_line_color": c["edge"]},
                "Axis": text | lines | sizes | {"axis_label_text_font_style": "normal"},
                "Title": {"text_color": c["ink"], "text_font_size": "14px"},
                "ColorBar": {
                    "background_fill_color": c["paper"],
                    "title_text_color": c["ink"],
                    "title_text_font_size": "12px",
                    "major_label_text_font_size": "12px",
                    "major_label_text_color": c["ink"],
                    "title_text_font_style": "normal",
                },
                "ScaleBar": {
                    "bar_line_color": c["ink"],
                    "label_text_color": c["ink"],
                    "label_text_font_size": "12px",
                },
                "Legend": {
                    "background_fill_color": c["panel"],
                    "label_text_color": c["ink"],
                    "label_text_font_size": "12px",
                    "border_line_color": c["edge"],
                },
            }
        }
    )
