"""The page of the explorer in a real browser: looked at, driven by keys and mouse, without any request off the machine.

Run by ``pytest -m browser`` with playwright and a Chromium: Debian's chromium-headless-shell, or that of ``playwright
install``. ``APT_EVAP_SCREENSHOTS=folder`` keeps the pictures.
"""

import os
import shutil
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import pytest
from matplotlib.image import imread
from rough import ROUGH

import apt_evap as ae

pytest.importorskip("bokeh")
playwright = pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.browser

CHROMIUM = shutil.which("chromium-headless-shell") or shutil.which("chromium")  # None: that of playwright
PATIENCE = 60_000  # ms: the machine may be busy

# the first image of the page, and what is written beside it
WATCH = """() => {
  const models = [...Bokeh.documents[0].all_models]
  const maps = models.filter(m => m.type == "Figure" && ["simulated", "measured"].includes(m.title.text))
  window.maps = maps
  window.source = maps[0].renderers.find(r => r.glyph.type == "Image").data_source
  window.written = () => models.filter(m => m.type == "Div").map(m => m.text).join(" ")
  window.area = n => {
    const view = Bokeh.index.find_one(maps[n])
    const box = view.frame.bbox, own = view.el.getBoundingClientRect()
    return [own.x + box.x0, own.y + box.y0, box.width, box.height]
  }
  window.mean = () => [...window.source.data.image[0]].filter(isFinite).reduce((a, b) => a + b * b)
  window.model = title => models.find(m => m.title == title || m.label == title || m.title?.text == title)
}"""


@contextmanager
def explorer_in(folder, *words):
    """Address of `apt-evap explore`, started as a user does."""
    code = "import sys; from apt_evap.cli.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "explore", *words, "--no-browser"]
    environment = os.environ | {"PYTHONPATH": str(Path(ae.__file__).parents[1]), "XDG_STATE_HOME": str(folder)}
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            yield process.stdout.readline().strip()
        finally:
            process.terminate()
    assert process.returncode == 0


@pytest.fixture(scope="session")
def served(small_tip, made_once, tmp_path_factory):
    """Address of a run beside ions."""
    folder = tmp_path_factory.mktemp("served")
    run = made_once(small_tip, 2000, seed=1, **ROUGH)
    run.save(folder / "run.h5")
    hits = replace(run, seed=2).hits(ae.RollUp(0.2))
    ae.write(folder / "ions.epos", ae.Hits(x=hits.x, y=hits.y).within_circle(60.0))
    with explorer_in(folder, "run.h5", "ions.epos", "--registration=0,1,0,0") as url:
        yield url


@contextmanager
def opened(url):
    """A page of a browser, with its requests and the errors of its console."""
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        context = browser.new_context(viewport={"width": 1400, "height": 1250})
        context.grant_permissions(["clipboard-read", "clipboard-write"])
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.requests, page.errors = [], []
        page.on("request", lambda request: page.requests.append(request.url))
        page.on("websocket", lambda socket: page.requests.append(socket.url))
        page.on("console", lambda message: message.type == "error" and page.errors.append(message.text))
        page.on("pageerror", lambda error: page.errors.append(str(error)))
        page.goto(url)
        page.wait_for_function("window.Bokeh && Bokeh.documents.length && Bokeh.documents[0].is_idle")
        yield page
        browser.close()


@pytest.fixture
def page(served):
    """The page of a run beside ions."""
    with opened(served) as page:
        page.wait_for_selector("canvas")
        page.evaluate(WATCH)
        yield page


def picture(page, name):
    """Save a screenshot, if a folder is given."""
    if folder := os.environ.get("APT_EVAP_SCREENSHOTS"):
        page.screenshot(path=Path(folder) / f"{name}.png")


def place(page, number, x, y):
    """Point of a map at fractions of its width and height."""
    left, top, width, height = page.evaluate(f"area({number})")
    return left + x * width, top + y * height


def drag(page, start, end):
    page.mouse.move(*start)
    page.mouse.down()
    for step in range(1, 6):
        page.mouse.move(*(a + (b - a) * step / 5 for a, b in zip(start, end, strict=True)))
    page.mouse.up()


def test_the_page_is_driven(page, served):
    # keys move a slider, the map and what is written
    page.wait_for_function("/alike|doubtful/.test(written())")
    picture(page, "1_start")
    before, text = page.evaluate("mean()"), page.evaluate("written()")
    pixels = page.screenshot()
    page.locator(".noUi-handle").first.focus()
    for _ in range(10):
        page.keyboard.press("ArrowRight")
    page.wait_for_function("before => mean() != before && !written().includes('preview')", arg=before)
    page.wait_for_function("text => written() != text", arg=text)
    page.wait_for_function("model('mean energy [eV]').value > 0.2")
    page.wait_for_timeout(500)  # the browser draws
    assert page.screenshot() != pixels
    picture(page, "2_keys")

    # difference and blink
    page.get_by_text("difference", exact=True).click()
    page.wait_for_function("maps[1].title.text == 'simulated - measured'")
    page.wait_for_timeout(500)
    picture(page, "3_difference")
    page.get_by_text("blink", exact=True).click()
    page.wait_for_function("maps[0].title.text == 'measured'")
    picture(page, "4_blink")
    page.wait_for_function("maps[0].title.text == 'simulated'")
    page.keyboard.press("b")
    page.wait_for_function("maps[1].title.text == 'measured' && maps[0].title.text == 'simulated'")

    # a click shows atoms of the specimen
    page.mouse.click(*place(page, 0, 0.5, 0.4))
    page.wait_for_function("model('radius of a click [mm]') && [...Bokeh.documents[0].all_models].some("
                           "m => m.type == 'Title' && /atoms land within/.test(m.text))")  # fmt: skip
    picture(page, "5_click")

    # a line drawn by the mouse gives profiles
    page.get_by_text("line", exact=True).click()
    page.wait_for_function("maps[0].toolbar.active_drag.type == 'FreehandDrawTool'")
    drag(page, place(page, 0, 0.3, 0.3), place(page, 0, 0.7, 0.6))
    page.wait_for_function("[...Bokeh.documents[0].all_models].some(m => m.type == 'ColumnDataSource' &&"
                           " m.data.x?.length > 3 && m.data.y?.length > 3 && !m.data.image)")  # fmt: skip
    page.wait_for_timeout(500)
    picture(page, "6_profile")

    # a rectangle gives a command, a button copies it
    page.get_by_text("box", exact=True).click()
    page.wait_for_function("maps[0].toolbar.active_drag.type == 'BoxSelectTool'")
    page.wait_for_timeout(500)
    drag(page, place(page, 0, 0.3, 0.3), place(page, 0, 0.6, 0.6))
    page.wait_for_function("[...Bokeh.documents[0].all_models].some(m => /--box=/.test(m.text ?? ''))")
    page.get_by_text("code", exact=True).click()
    page.get_by_text("copy as command").click()
    page.wait_for_function("model('copied')")
    copied = page.evaluate("navigator.clipboard.readText()")
    assert copied.startswith("apt-evap map ions.epos --box=")
    picture(page, "7_rectangle")

    # two clicks index the map
    page.get_by_text("pole", exact=True).click()
    page.wait_for_function("maps[1].toolbar.active_drag.type == 'PointDrawTool'")
    page.get_by_text("crystal", exact=True).first.click()
    for each in ((0.4, 0.5), (0.6, 0.5)):
        page.mouse.click(*place(page, 1, *each))
        page.wait_for_timeout(600)  # not a double click
    page.wait_for_function("written().includes('mm/rad')")
    picture(page, "8_index")

    # no request off the machine, and no error
    assert page.errors == []
    start = served.split("/?")[0]
    assert len(page.requests) > 5
    assert all(each.replace("ws://", "http://").startswith(start) for each in page.requests), page.requests
    if folder := os.environ.get("APT_EVAP_SCREENSHOTS"):
        Path(folder, "requests.txt").write_text("\n".join(page.requests))


@pytest.mark.parametrize("width", [1000, 1280, 1440, 1920])
def test_maps_fill_the_window(page, width):
    """Two maps side by side, with the tabs below or beside them in the window, and nothing beyond its edge."""
    page.set_viewport_size({"width": width, "height": width * 5 // 8})
    page.wait_for_timeout(1500)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    boxes = [page.evaluate(f"area({number})") for number in (0, 1)]
    assert boxes[0][1] == pytest.approx(boxes[1][1], abs=2)  # side by side
    assert boxes[0][2] == pytest.approx(boxes[1][2], abs=2) and boxes[0][2] > (280 if width >= 1280 else 220)
    assert width < 1920 or boxes[0][2] > 500
    tab = page.get_by_text("specimen", exact=True).first.bounding_box()
    assert tab["y"] + 2 * tab["height"] < width * 5 // 8  # seen without scrolling
    sizes = page.evaluate("""() => {
      const sizes = []
      const visit = root => root.querySelectorAll("*").forEach(e => {
        if (e.shadowRoot) visit(e.shadowRoot)
        const text = [...e.childNodes].some(n => n.nodeType == 3 && n.textContent.trim())
        if (text && !["STYLE", "SCRIPT"].includes(e.tagName) && e.getBoundingClientRect().width)
          sizes.push([parseFloat(getComputedStyle(e).fontSize), e.textContent.trim().slice(0, 30)])
      })
      visit(document)
      return sizes
    }""")
    assert len(sizes) > 10 and min(sizes)[0] >= 12, min(sizes)
    picture(page, f"window_{width}")


def test_nothing_of_the_dark_style_is_left_at_the_edges_of_a_figure(page):
    page.get_by_role("button", name="light", exact=True).click()
    page.get_by_role("button", name="dark", exact=True).wait_for()
    page.wait_for_timeout(1000)  # the browser draws
    x, y = page.evaluate("(({x, y}) => [x, y])(Bokeh.index.find_one(maps[0]).el.getBoundingClientRect())")
    pixels = imread(BytesIO(page.screenshot()))[..., :3]
    page.get_by_role("button", name="dark", exact=True).click()  # the session is that of the other tests, too
    page.get_by_role("button", name="light", exact=True).wait_for()
    corner = pixels[int(y) - 2 : int(y) + 10, int(x) - 2 : int(x) + 10]
    assert (corner > 0.99).all()


def test_saved_pictures_have_the_colour_of_the_page(page, tmp_path):
    with page.expect_download() as first:
        page.get_by_role("button", name="save pictures", exact=True).click()
    first.value.save_as(tmp_path / "map.png")
    pixels = imread(tmp_path / "map.png")
    assert (pixels[..., 3] == 1).all()
    np.testing.assert_allclose(255 * pixels[[0, -1], [0, -1], :3], [(21, 24, 28)] * 2, atol=1)  # dark


def test_only_the_address_opens_the_page(served):
    for url in (served.split("?")[0], served[:-4] + "AAAA"):
        with pytest.raises(HTTPError) as refused:
            urlopen(url)
        assert refused.value.code == 403


def test_from_the_start_page(tmp_path):
    """A dropped file is copied into the folder and opened, on any page; the example is a click away."""
    content = tmp_path / "elsewhere"
    content.mkdir()
    rng = np.random.default_rng(1)
    for name, n in (("dropped.epos", 500), ("second.epos", 400)):
        ae.write(content / name, ae.Hits(x=rng.normal(size=n), y=rng.normal(size=n)))
    drop = """([name, bytes]) => {
      const transfer = new DataTransfer()
      transfer.items.add(new File([new Uint8Array(bytes)], name))
      document.dispatchEvent(new DragEvent("drop", {dataTransfer: transfer, cancelable: true}))
    }"""
    shown = "[...Bokeh.documents[0].all_models].some(m => m.type == 'Div' && m.text.includes('%s'))"
    (tmp_path / "work").mkdir()
    with explorer_in(tmp_path / "work") as url, opened(url) as page:
        page.get_by_text("Drop a measured file").wait_for()
        picture(page, "start")
        for name, n in (("dropped.epos", 500), ("second.epos", 400)):
            page.evaluate(drop, [name, list((content / name).read_bytes())])
            page.wait_for_function(shown % f"<b>{name}</b> {n} ions")
        assert page.errors == []
    assert (tmp_path / "work" / "dropped.epos").read_bytes() == (content / "dropped.epos").read_bytes()
    with explorer_in(tmp_path / "work") as url, opened(url) as page:
        page.get_by_text("nickel [111]").click()
        page.wait_for_function(shown % "<b>example_ni111.npz</b>")
        page.wait_for_selector("canvas")
        picture(page, "example")
        assert page.errors == []
