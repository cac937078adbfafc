"""HTML pages in one file, with pictures, styles, script and data; nothing is loaded from elsewhere."""

import base64
import html
import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from string import Template
from typing import Any

from matplotlib.figure import Figure

from apt_evap._common.files import FileError, read_small_file, replace_file
from apt_evap._common.types import AnyPath
from apt_evap._common.version import __version__

DPI = 100
"""Resolution of the pictures [dots per inch]: a study with five maps takes about 1 MB."""
MAX_BYTES = 1 << 28  # bytes: larger files are not reports, and browsers would fail with them

_PAGE = Template("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<meta name="generator" content="apt_evap $version">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<link rel="icon" href="data:,">
<title>$title</title>
<style>
$style</style>
</head>
<body>
<h1>$title</h1>
$body
<footer>apt_evap $version. $size This file needs no network.</footer>
$data
<script>
$script</script>
</body>
</html>
""")

_STYLE = """\
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 1100px; margin: 2em auto;
  padding: 0 1em; }
h1 { font-size: 1.6em; line-height: 1.25; overflow-wrap: anywhere; }
h2 { font-size: 1.2em; margin: 1.8em 0 0.5em; border-bottom: 1px solid #ccc; }
.doubt { border-left: 5px solid #e0a000; background: #fff7e0; padding: 0.4em 0.8em; margin: 0.4em 0; }
.doubt.red { border-color: #c00; background: #fdeaea; }
.result { font-size: 1.15em; }
.note { color: #555; font-size: 0.9em; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 0.6em 0; }
th, td { padding: 0.25em 0.7em; text-align: left; vertical-align: top; border-bottom: 1px solid #e4e4e4; }
td { font-variant-numeric: tabular-nums; overflow-wrap: break-word; }
thead th { border-bottom: 2px solid #888; vertical-align: bottom; }
.red { color: #a00000; font-weight: 600; }
tr.best td, tr.best th { background: #e8f4e8; }
code, pre { font: 0.85em ui-monospace, monospace; overflow-wrap: anywhere; white-space: pre-wrap; }
pre { background: #f4f4f4; padding: 0.7em; }
.matrices { display: flex; flex-wrap: wrap; gap: 0.6em 2em; }
.matrix td { position: relative; text-align: right; border: 1px solid #fff; cursor: default; padding: 0.35em 0.7em; }
.matrix td.best { outline: 3px solid #e00; outline-offset: -3px; }
.scale { display: flex; align-items: center; gap: 0.6em; font-size: 0.9em; color: #555; }
.scale span { width: 12em; height: 1em; border: 1px solid #888; }
.matrix th { border: 0; text-align: right; font-weight: normal; }
.matrix td span { display: none; position: absolute; z-index: 1; left: 1em; top: 105%; width: max-content;
  max-width: 17em; padding: 0.4em 0.7em; background: #fff; color: #1a1a1a; text-align: left; border: 1px solid #555;
  box-shadow: 2px 2px 6px #0004; }
.matrix td:hover span, .matrix td:focus span { display: block; }
figure { margin: 0.6em 0; }
figcaption { color: #555; font-size: 0.9em; }
img { max-width: 100%; height: auto; display: block; }
.blink { display: flex; flex-wrap: wrap; gap: 0 1em; align-items: start; }
.blink figure { cursor: pointer; margin: 0; }
.blink.beside figure { flex: 1 1 20em; }
details { border-top: 1px solid #e4e4e4; padding: 0.3em 0; }
.blink figure[hidden] { display: none; }
.blink p { flex: 100%; margin: 0.3em 0; }
summary { cursor: pointer; font-weight: 600; }
footer { margin-top: 3em; color: #555; font-size: 0.9em; border-top: 1px solid #ccc; }
@media print { .blink figure[hidden] { display: block; } .blink button { display: none; } }
"""

# blocks of maps, at first side by side or on one place: a press switches one block, B switches all, A switches all at
# intervals, S puts them side by side again
_SCRIPT = """\
const blocks = [...document.querySelectorAll(".blink")];
const frames = block => [...block.querySelectorAll("figure")];
const show = (block, n) => frames(block).forEach((frame, k, all) => frame.hidden = k !== n % all.length);
const next = block => {
  const first = block.classList.contains("beside");
  block.classList.remove("beside");
  show(block, first ? 0 : 1 + frames(block).findIndex(frame => !frame.hidden));
};
const beside = () => blocks.filter(block => block.dataset.start === "beside").forEach(block => {
  block.classList.add("beside");
  frames(block).forEach(frame => frame.hidden = false);
});
let timer = 0;
const blink = () => { timer = timer ? void clearInterval(timer) : setInterval(() => blocks.forEach(next), 700); };
for (const block of blocks) {
  if (!block.classList.contains("beside")) show(block, 0);
  frames(block).forEach(frame => frame.onclick = () => next(block));
}
document.querySelectorAll(".blink .switch").forEach(button => button.onclick = () => blocks.forEach(next));
document.querySelectorAll(".blink .auto").forEach(button => button.onclick = blink);
document.querySelectorAll(".blink .both").forEach(button => button.onclick = () => { if (timer) blink(); beside(); });
document.onkeydown = event => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key === "b") blocks.forEach(next);
  if (event.key === "a") blink();
  if (event.key === "s") { if (timer) blink(); beside(); }
};
"""


class Page:
    """Contents of a report, added from top to bottom.

    Parameters
    ----------
    title : str
        Title of the page.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self._body: list[str] = []
        self._data: dict[str, str] = {}
        self._picture_bytes = 0

    def add(self, *parts: str) -> None:
        """Add HTML, as made by the functions of this module."""
        self._body += parts

    def picture(self, figure: Figure, caption: str = "", *, alt: str = "") -> str:
        """Return a figure with its caption as HTML, with the picture inside."""
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=DPI, metadata={"Software": f"apt_evap {__version__}"})
        return self.image(file.getvalue(), caption, alt=alt)

    def image(self, data: bytes, caption: str = "", *, alt: str = "") -> str:
        """Return a picture, the content of a PNG file, with its caption as HTML, str."""
        width, height = (int.from_bytes(data[start : start + 4], "big") for start in (16, 20))  # of the PNG header
        source = "data:image/png;base64," + base64.b64encode(data).decode()
        self._picture_bytes += len(source)
        caption_html = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
        return (
            f'<figure><img width="{width}" height="{height}" alt="{escape(alt or caption)}" src="{source}">'
            f"{caption_html}</figure>"
        )

    def data(self, name: str, content: Any) -> None:
        """Store data for programs, which `read_report` reads.

        Parameters
        ----------
        name : str
            Name of the data.
        content : dict or list
            Data in the types of JSON.
        """
        text = json.dumps(content, allow_nan=False, separators=(",", ":"))
        for sign in "<>&":  # no text may end the element
            text = text.replace(sign, f"\\u{ord(sign):04x}")
        self._data[name] = text

    def save(self, path: AnyPath) -> None:
        """Write the page; the file is replaced only when complete."""
        size = f"Pictures: {self._picture_bytes / 1e6:.2g} MB with {DPI} dpi." if self._picture_bytes else ""
        text = _PAGE.substitute(
            title=escape(self.title),
            version=escape(__version__),
            style=_STYLE,
            body="\n".join(self._body),
            size=size,
            data="\n".join(
                f'<script type="application/json" id="{escape(name)}">{text}</script>'
                for name, text in self._data.items()
            ),
            script=_SCRIPT,
        )
        with replace_file(path) as file:
            file.write(text.encode())


def read_report(path: AnyPath) -> dict[str, Any]:
    """Read the data of a report.

    Returns
    -------
    dict
        By name. Of a study: "study", as in study.json, and "origin", its command, files and warnings. Of a sweep:
        "points" and "origin".
    """
    text = read_small_file(path, MAX_BYTES, "a report").decode(errors="replace")
    blocks = re.findall(r'^<script type="application/json" id="([^"]+)">(.*)</script>$', text, re.MULTILINE)
    try:
        content = {html.unescape(name): json.loads(data) for name, data in blocks}
    except ValueError as error:
        raise FileError(f"{str(path)!r} is a damaged report: {error}") from error
    if "origin" not in content:
        raise FileError(f"{str(path)!r} is not a report of apt_evap")
    return content


# ---- parts of a page -------------------------------------------------------------------------------------------------


class Markup(str):
    """Text that is HTML already."""


def escape(value: object) -> str:
    """Text as HTML, str; a file name may contain bytes that are not text."""
    if isinstance(value, Markup):
        return value
    return html.escape(re.sub("[\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", str(value)))


def heading(text: str) -> str:
    """Heading of a section, str."""
    return f"<h2>{escape(text)}</h2>"


def paragraph(text: str, kind: str = "") -> str:
    """Paragraph, with a class of the style sheet such as "note" or "doubt red", str."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def table(rows: Iterable[Sequence[object]], head: Sequence[object] = (), best: int | None = None) -> str:
    """Table whose first column names the rows; `best` is the number of a row to emphasise."""
    lines = ['<div class="scroll"><table>']
    if head:
        lines.append(f"<thead><tr>{''.join(f'<th>{escape(name)}</th>' for name in head)}</tr></thead>")
    for number, (name, *values) in enumerate(rows):
        emphasis = ' class="best"' if number == best else ""
        cells = "".join(f"<td>{escape(value)}</td>" for value in values)
        lines.append(f"<tr{emphasis}><th>{escape(name)}</th>{cells}</tr>")
    return "\n".join([*lines, "</table></div>"])


def collapsed(title: str, content: str) -> str:
    """Content that a press on its title shows, str."""
    return f"<details><summary>{escape(title)}</summary>\n{content}\n</details>"


def color_scale(colors: Sequence[str], low: str, high: str, label: str) -> str:
    """Bar of the colours of a table with the values at its ends, str."""
    bar = f'<span style="background:linear-gradient(to right,{",".join(colors)})"></span>'
    return f'<p class="scale">{escape(label)} {escape(low)} {bar} {escape(high)}</p>'


def switched(pictures: Sequence[str], beside: bool = False) -> str:
    """Pictures, as HTML, on one place, switched by a press or a key; side by side without a script, or until then."""
    both = ' <button type="button" class="both">side by side (S)</button>' if beside else ""
    controls = (
        '<p><button type="button" class="switch">on one place (B)</button> '
        f'<button type="button" class="auto">blink (A)</button>{both}</p>'
    )
    head = '<div class="blink beside" data-start="beside">' if beside else '<div class="blink">'
    return "\n".join([head, *pictures, controls, "</div>"])


def flat(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one dict with dotted names; without the sources of the materials, and without empty ones."""
    rows = {}
    for key, value in content.items():
        if key == "sources" or value in (None, [], {}, ""):
            continue
        if isinstance(value, Mapping):
            rows |= flat(value, f"{prefix}{key}.")
        else:
            rows[f"{prefix}{key}"] = value
    return rows


def text_of(value: Any) -> str:
    """Text of a setting: a number, a text, or a list of them, str."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {text_of(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(text_of(item) for item in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}" if abs(value) >= 10_000 else str(value)
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
