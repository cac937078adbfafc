"""The .xrng format of AP Suite: ranges of mass over charge state as XML.

A range has its bounds [Da], and the first of its ions a charge state, a volume [nm^3] and the atomic number of each
atom. Names of elements of the XML are compared in lower case.
"""

import re
from dataclasses import dataclass, field
from xml.parsers import expat

import numpy as np

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap.io._texts import SYMBOLS, OddLines, check_bounds, count, formula, number, read_text
from apt_evap.spectra.mass_ranges import Ranges

_DEEPEST = 50
_GROUPS = ("ranges", "item", "ions", "atoms")


@dataclass
class _Node:
    """An element of the XML with the line where it begins."""

    name: str
    line: int
    text: str = ""
    text_line: int = 0
    nodes: "list[_Node]" = field(default_factory=list)

    def child(self, name: str) -> "_Node | None":
        """First element of this name in it; None if there is none."""
        return next((node for node in self.nodes if node.name == name), None)


def read_xrng(path: AnyPath) -> Ranges:
    """Read the mass ranges of an .xrng file; a range with several ions has the formula of the first one.

    Warns
    -----
    DataWarning
        Of ranges that cannot be read, which are left out.
    """
    text = read_text(path, "the XML of an .xrng file")
    odd = OddLines(path)
    root = _tree(_mended(text), odd)
    ranges = next((node for node in _all_nodes(root) if node.name == "ranges"), None)
    if ranges is None:
        raise FileError(f"{str(path)!r} has no element <ranges>, as in an .xrng file")
    rows = []
    for item in ranges.nodes:
        if item.name != "item":
            odd.add(item.line, f"expected <item>, got <{item.name:.40}>")
            continue
        with odd.leave_out(item.line):
            rows.append(_range(item, odd))
    odd.report(len(rows), "has no range in <ranges>")
    names, low, high, volume, composition = zip(*rows, strict=True)
    return Ranges(names, np.array(low), np.array(high), np.array(volume), composition=composition, source=str(path))


def _mended(text):
    """The text without an item that is opened at the end of the ranges and never closed, as some files have it."""
    return re.sub(r"<item>(\s*</ranges>)", r"\1", text)


def _tree(text, odd):
    """Root of the XML; definitions of entities are refused, because they may expand without limit."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise FileError(f"{odd.where(1)}: expected XML without <!DOCTYPE> and <!ENTITY>")
    stack = [_Node("", 1)]
    parser = expat.ParserCreate()

    def begin(name, _):
        if len(stack) > _DEEPEST:
            raise FileError(f"{odd.where(parser.CurrentLineNumber)}: expected at most {_DEEPEST} nested elements")
        node = _Node(name.rpartition(":")[2].lower(), parser.CurrentLineNumber)
        stack[-1].nodes.append(node)
        stack.append(node)

    def add(data):
        stack[-1].text += data
        if not stack[-1].text_line and data.strip():
            stack[-1].text_line = parser.CurrentLineNumber

    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda _: stack.pop()
    parser.CharacterDataHandler = add
    # of a str: the encoding that its first line names is that of the file
    data = re.sub(r"^\s*<\?xml[^>]*\?>", lambda match: re.sub(r"[^\n]", "", match[0]), text).encode()
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        opened = stack[-1]
        tag = data[: max(data.rfind(b"<", 0, max(parser.ErrorByteIndex, 0)), 0)].count(b"\n") + 1
        reason = f"{expat.ErrorString(error.code)} after the tag of line {tag}"
        reason += f", <{opened.name:.40}> of line {opened.line} is open" if opened.name else ""
        others = [line for line, _ in _texts_between(stack[0])]
        reason += f", line {others[0]} is not a tag" if others else ""
        raise FileError(f"{odd.where(error.lineno)}: expected XML, {reason}") from error
    for line, between in _texts_between(stack[0]):
        odd.add(line, f"expected a tag, got {between!r:.60}")
    return stack[0]


def _texts_between(root):
    """Line and text of each text that is not in an element of its own."""
    return [
        (node.text_line, node.text.strip())
        for node in _all_nodes(root)
        if (node.nodes or node.name in _GROUPS) and node.text.strip()
    ]


def _all_nodes(node):
    """The nodes in a node, of all levels."""
    for inner in node.nodes:
        yield inner
        yield from _all_nodes(inner)


def _range(item, odd):
    """Name, bounds, volume and atoms of a range."""
    bounds = []
    for name in ("masstochargebegin", "masstochargeend"):
        node = item.child(name)
        if node is None:
            raise FileError(f"{odd.where(item.line)}: expected <{name}>")
        bounds.append(_value(node, number, "a bound [Da]", odd))
        if bounds[-1] < 0:
            raise FileError(f"{odd.where(node.line)}: expected a bound >= 0 [Da], got {bounds[-1]:g}")
    low, high = check_bounds(*bounds, odd.where(item.line))
    ions = item.child("ions")
    of_range = [node for node in ions.nodes if node.name == "item"] if ions else []
    if not of_range or (atoms := of_range[0].child("atoms")) is None:
        raise FileError(f"{odd.where(item.line)}: expected <ions> with <atoms>")
    if len(of_range) > 1:
        odd.add(of_range[1].line, f"the range has {len(of_range)} ions", "the first one is read")
    volume = of_range[0].child("volume")
    composition: dict[str, int] = {}
    for atom in atoms.nodes:
        node = atom.child("atomicnumber")
        if node is None:
            raise FileError(f"{odd.where(atom.line)}: expected <atomicnumber>")
        z = _value(node, count, "an atomic number", odd)
        if not 1 <= z <= len(SYMBOLS):
            raise FileError(f"{odd.where(node.line)}: expected an atomic number from 1 to {len(SYMBOLS)}, got {z}")
        composition[SYMBOLS[z - 1]] = composition.get(SYMBOLS[z - 1], 0) + 1
    if not composition:
        raise FileError(f"{odd.where(atoms.line)}: expected at least one atom")
    nm3 = _value(volume, number, "a volume [nm^3]", odd) if volume is not None and volume.text.strip() else 0.0
    return formula(composition), low, high, nm3 or np.nan, composition


def _value(node, reader, what, odd):
    """Number in an element of the XML, by `number` or `count`."""
    return reader(node.text.strip(), what, odd.where(node.line))
