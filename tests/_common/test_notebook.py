"""What a notebook shows instead of one line of text."""

import io
from html.parser import HTMLParser

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.image import imread

import apt_evap as ae


class Cells(HTMLParser):
    """Texts of the cells of a table by their heads; tags must be closed in order."""

    def __init__(self, html):
        super().__init__()
        self.open, self.cells, self.head = [], {}, None
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1] == "th":
            self.head = data
        elif self.open[-1] == "td":
            self.cells[self.head] = data
        elif self.open[-1] == "code":
            self.line = data


def test_a_map_is_shown_as_its_picture():
    hits = ae.Hits(x=np.arange(100) % 10, y=np.arange(100) // 10)
    before = plt.get_fignums()
    image = imread(io.BytesIO(hits.map(bins=10, position_step=None)._repr_png_()))
    assert min(image.shape[:2]) > 200 and np.ptp(image[..., :3]) > 0.5
    assert plt.get_fignums() == before  # a notebook would draw an open figure a second time


def test_runs_ions_and_specimens_are_shown_as_tables(small_tip):
    run = ae.Simulation(small_tip, seed=1).run(20, responses=False, progress=False)
    hits = ae.Hits(x=[1.0, 2.0], y=[0.5, 3.0], source="<a & b>")
    for data, head, text in (
        (run, "fingerprint", run.fingerprint()),
        (small_tip, "atoms", f"{len(small_tip):,}"),
        (hits, "ions", "2"),
        (ae.material("Ni"), "a [nm]", "0.352"),
    ):
        shown = Cells(data._repr_html_())
        assert shown.cells[head] == text and shown.line == repr(data)
