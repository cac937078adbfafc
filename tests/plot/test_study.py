"""Report of a study: all numbers of the study, and nothing that is loaded from elsewhere."""

import base64
import hashlib
import io
import json
import os
import re
import shutil
import warnings
from dataclasses import replace

import numpy as np
import pytest
from fits import fit_energies
from html_reader import Reader
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Text
from rough import ROUGH

import apt_evap as ae
from apt_evap._common.recorded_warnings import recorded_warnings
from apt_evap.plot.report.html_page import read_report
from apt_evap.plot.report.study_report import doubts


@pytest.fixture(scope="session")
def page(study, tmp_path_factory):
    """A report with all its parts, and its text."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "ni.h5").write_bytes(b"ions")
    path = folder / "report.html"
    ae.plot.write_study(
        study, path, title="Ni & <Al>", files=[folder / "ni.h5"], command="apt-evap compare 'a b'", warnings=["1 < 2"]
    )
    return path


@pytest.fixture(scope="session")
def seen(page):
    return Reader(page.read_text())


def pictures(seen):
    """The pictures of a page as arrays, with their stated sizes."""
    for image in seen.all("img"):
        data = base64.b64decode(image["src"].removeprefix("data:image/png;base64,"), validate=True)
        yield imread(io.BytesIO(data)), (int(image["height"]), int(image["width"]))


@pytest.mark.slow
def test_nothing_is_loaded(seen):
    assert len(seen.addresses) >= 4
    assert all(each.startswith(("data:", "#")) for each in seen.addresses)
    (policy,) = (each["content"] for each in seen.all("meta") if each.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'; img-src data:;") and "http" not in policy


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.MapWarning")  # few ions
def test_options_of_the_perturbation_are_in_the_report(small_tip, tmp_path):
    settings = {**ROUGH, "response_settings": ae.ResponseSettings(bound=5.0)}
    run = ae.Simulation(small_tip, seed=1, **settings).run(400, progress=False)
    measured = run.hits(ae.RollUp(0.2)).within_circle(60.0).map(bins=24, extent=(-60, 60, -60, 60))
    study = fit_energies(
        run,
        measured,
        means=(0.1, 0.2, 0.3),
        relative_spreads=(1.0,),
        options={"probability": (0.3, 0.6, 1.0), "sharpness": (0.0, 0.3)},
        registration=ae.Registration(0.0, 1.0, (0.0, 0.0)),
        replicas=1,
        resamples=5,
        progress=False,
    )
    assert {"probability", "sharpness"} & set(study.optimum.at_edge)
    ae.plot.write_study(study, tmp_path / "report.html")
    text = Reader((tmp_path / "report.html").read_text()).text
    assert study.likeness.verdict == "doubtful" and "at the end of the grid in" not in text  # few ions
    study.__dict__["likeness"] = study.likeness._replace(verdict="alike")
    ae.plot.write_study(study, tmp_path / "report.html")
    text = Reader((tmp_path / "report.html").read_text()).text
    assert "at the end of the grid in" in text
    for name in ("probability", "sharpness"):
        assert study.refined.bounded(name) in text


def test_the_reader_sees_what_would_be_loaded():
    text = '<p style="background:url(a)"><img src="http://b"><link href="c"><style>@import d; e {f: url(g)}</style></p>'
    assert len(Reader(text).addresses) == 5


def test_the_study_is_inside(study, page):
    content = read_report(page)
    assert content["study"] == json.loads(json.dumps(study.to_dict()))
    origin = content["origin"]
    assert origin["command"] == "apt-evap compare 'a b'" and origin["warnings"] == ["1 < 2"]
    digest = hashlib.sha256(b"ions").hexdigest()
    assert origin["files"] == [{"name": "ni.h5", "bytes": 4, "sha256": digest}]
    assert origin["made_by"] == f"apt_evap {ae.__version__}"


def test_the_numbers_of_the_study_are_shown(study, seen):
    for text in (
        "Ni & <Al>", "Warning: 1 < 2", "apt-evap compare 'a b'", hashlib.sha256(b"ions").hexdigest(),
        str(study.optimum.score), str(study.gain), str(study.ceiling), study.refined.bounded("mean"),
        study.refined.bounded("rollup_fraction"), "roll-up fraction 0.5",
        "apex_radius", f"numpy {np.__version__}",
    ):  # fmt: skip
        assert text in seen.text, text
    cells = seen.all("td")
    assert sum("tabindex" in cell for cell in cells) == study.scores.size
    assert len(seen.all("td", "best")) == 1
    for value, error in zip(study.scores.ravel(), study.errors.ravel(), strict=True):
        assert f"SSIM {value:z.3f} ± {error:.3f}" in seen.text


def test_real_energies_are_shown_beside_those_of_the_simulation(study, seen):
    real = study.provenance["real_units"]
    assert study.refined.scaled("true_mean", real["real_per_study"]) in seen.text
    assert f"{real['operating_field']:.3g} V/nm and {real['flight_charge']}+" in seen.text


def test_the_two_maps_are_on_one_place(seen):
    (measured, size), (simulated, other_size), *_ = pictures(seen)
    assert size == other_size == measured.shape[:2] == simulated.shape[:2]
    axes = [np.flatnonzero((image[..., :3] < 0.1).all(axis=-1).mean(axis=0) > 0.5) for image in (measured, simulated)]
    assert len(axes[0]) >= 2 and np.array_equal(*axes)  # columns of the frame
    assert not np.array_equal(measured, simulated)


def test_pictures_are_drawn_and_their_size_is_stated(page, seen):
    found = list(pictures(seen))
    assert len(found) == 3  # with the maps folded about the pole
    assert len({image.tobytes() for image, _ in found}) == 3  # no picture twice
    for image, size in found:
        assert image.shape[:2] == size and image[..., :3].std() > 0.05
    stated = float(re.search(r"Pictures: (\S+) MB with 100 dpi", seen.text)[1])
    assert 0.5 < stated * 1e6 / page.stat().st_size < 1


def test_poles_and_lines_of_the_pictures_are_named(study, seen):
    assert study.orientation is not None
    assert "zone lines of ⟨110⟩; ▬ zone lines of ⟨100⟩; ○ poles, larger for" in seen.text


def test_scores_of_densities_are_not_called_corrected(study):
    """The noise of densities is not known."""
    bars = [ae.plot.score_matrix(one)[0].figure.axes[-1] for one in (study, replace(study, measured=densities(study)))]
    assert [bar.get_ylabel() for bar in bars] == ["noise-corrected SSIM", "SSIM"]


def test_the_predicted_roll_up_has_its_name_beside_the_maps(study):
    known = replace(study, baselines={**study.baselines, "rule of the metal": study.optimum.score})
    texts = [text.get_text() for text in ae.plot.side_by_side(known)[0].figure.findobj(Text)]
    assert "roll-up predicted for the metal: " in " ".join(texts).replace("\n", " "), texts


def densities(study):
    """The measured map without its numbers of ions."""
    return replace(study.measured, is_counts=False)


@pytest.mark.slow
def test_only_the_given_figures(study, tmp_path):
    ae.plot.write_study(study, tmp_path / "r.html", figures={"a < b": Figure((1, 1))})
    seen = Reader((tmp_path / "r.html").read_text())
    assert len(seen.all("img")) == 4 and "a < b" in seen.text
    ae.plot.write_study(study, tmp_path / "r.html", figures={})
    assert len(Reader((tmp_path / "r.html").read_text()).all("img")) == 3


def doubtful(study):
    return replace(study, registration=replace(study.registration, score=0.2, overlap=0.8, method="search"))


@pytest.mark.slow
def test_maps_that_are_not_alike_have_no_numbers(study, tmp_path):
    """Neither energies nor scores, also in what is folded; the page says why."""
    for unsure in (doubtful(study), replace(study)):
        if unsure.registration is study.registration:
            unsure.__dict__["likeness"] = study.likeness._replace(verdict="not alike")
        ae.plot.write_study(unsure, tmp_path / "r.html")
        seen = Reader((tmp_path / "r.html").read_text())
        assert unsure.likeness.reason in seen.text and not seen.all("td", "best")
        assert " eV" not in seen.text.partition("Settings of the comparison")[0]
        assert f"{study.optimum.score.value:.3f}" not in seen.text


def test_doubts(study):
    sure = study.to_dict() | {"gain_share": 1.0}
    sure["optimum"] |= {"at_edge": []}
    assert doubts(sure) == []
    for change, text in (
        (
            {"optimum": {"at_edge": ["mean", "relative_spread"]}},
            "end of the grid in the mean and standard deviation / mean",
        ),
        ({"refined": {"intervals": {}}}, "errors are not known"),
        ({"gain_share": 0.7}, "in only 70% of the resamples"),
        ({"settings": {"share_above_energy_limit": [[[0.0, 0.3]]]}}, "30% of the energies are above the limit"),
        ({"settings": {"measured_noise": "not known"}}, "noise of the measured densities is not known"),
    ):
        changed = sure | {key: sure[key] | part if isinstance(part, dict) else part for key, part in change.items()}
        (sentence,) = doubts(changed)
        assert text in sentence
        assert doubts(changed | {"likeness": {"verdict": "doubtful"}}) == []  # of numbers that are not given


@pytest.mark.slow
def test_without_resamples_and_correction(study, tmp_path):
    settings = replace(study.settings, resamples=0, allow_noise=False)
    bare = replace(
        study, settings=settings, resampled=study.resampled[:0], errors=np.full_like(study.errors, np.nan), ceiling=None
    )
    ae.plot.write_study(bare, tmp_path / "r.html", figures={})
    text = Reader((tmp_path / "r.html").read_text()).text
    assert "nan" not in re.findall(r"\w+", text.lower()) and "uncorrected" not in text and "best in" not in text


@pytest.mark.slow
def test_hostile_names_are_text(study, tmp_path):
    """A file name may be anything; it must neither end a script nor become an element."""
    name = "</script><img src=http:x onerror=alert(1)>&\udc80$title"
    ae.plot.write_study(study, tmp_path / "r.html", title=name, command=name, warnings=[name], figures={})
    seen = Reader((tmp_path / "r.html").read_text())
    assert len(seen.all("img")) == 3 and all(each.startswith(("data:", "#")) for each in seen.addresses)
    assert seen.text.count("</script><img src=http:x onerror=alert(1)>&\N{REPLACEMENT CHARACTER}$title") == 4
    assert read_report(tmp_path / "r.html")["origin"]["command"] == name


def test_what_is_refused(study, tmp_path):
    with pytest.raises(ValueError, match="study"):
        ae.plot.write_study(1, tmp_path / "r.html")
    with pytest.raises(ae.FileError, match=r"cannot read .*none\.h5"):
        ae.plot.write_study(study, tmp_path / "r.html", files=[tmp_path / "none.h5"])
    with pytest.raises(ae.FileError, match="cannot write"):
        ae.plot.write_study(study, tmp_path / "none" / "r.html", figures={})
    assert os.listdir(tmp_path) == []
    (tmp_path / "r.html").write_text("<html></html>")
    with pytest.raises(ae.FileError, match="is not a report"):
        read_report(tmp_path / "r.html")
    (tmp_path / "r.html").write_text('<script type="application/json" id="origin">{</script>')
    with pytest.raises(ae.FileError, match="is a damaged report"):
        read_report(tmp_path / "r.html")


def test_warnings_are_recorded_and_shown():
    with pytest.warns(ae.warnings.AptWarning) as shown, recorded_warnings() as messages:
        warnings.warn("a\nb", ae.warnings.AptWarning, stacklevel=1)
    assert [str(each) for each in messages] == ["a\nb"] and len(shown) == 1


@pytest.mark.browser
def test_in_a_browser_without_network(page):
    """Opened as a file, with every other request forbidden: maps switch by key, press and timer; details are shown."""
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = next(filter(None, map(shutil.which, ("chromium-headless-shell", "chromium"))), None)
    if chromium is None:
        pytest.skip("Chromium is not installed")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        tab = browser.new_context(offline=True).new_page()
        wrong, requests = [], []
        tab.on("console", lambda message: wrong.append(message.text))
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto(page.as_uri())
        frames = tab.locator(".blink figure")

        def visible():
            return [frames.nth(k).is_visible() for k in range(2)]

        assert visible() == [True, True]  # side by side
        first, second = (frames.nth(k).bounding_box() for k in range(2))
        assert first["y"] == second["y"] and first["x"] + first["width"] <= second["x"] + 1
        assert tab.evaluate("document.documentElement.scrollHeight") < 3000
        tab.keyboard.press("b")
        assert visible() == [True, False]
        before = frames.nth(0).bounding_box()
        tab.keyboard.press("b")
        assert visible() == [False, True] and frames.nth(1).bounding_box() == before
        frames.nth(1).click()
        assert visible() == [True, False]
        tab.locator("button.both").click()
        assert visible() == [True, True]
        tab.locator("button.switch").click()
        assert visible() == [True, False]
        tab.keyboard.press("a")
        frames.nth(0).wait_for(state="visible", timeout=5000)
        frames.nth(1).wait_for(state="visible", timeout=5000)
        tab.locator("button.auto").click()
        tab.locator("summary", has_text="Scores on the grid").click()
        details = tab.locator(".matrix td span").first
        assert not details.is_visible()
        tab.locator(".matrix td").first.hover()
        assert details.is_visible() and "eV" in details.inner_text()
        assert tab.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 100)")
        assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
        browser.close()
    assert wrong == []
    assert [each for each in requests if not each.startswith("data:")] == [page.as_uri()]


def test_a_study_is_a_folded_table_in_a_notebook(study):
    shown = study._repr_html_()
    assert shown.startswith("<details>") and str(study.optimum.score) in shown and study.lines()[0][:20] in shown


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.MapWarning")  # few ions
def test_the_report_of_the_default_objective(small_tip, made_once, tmp_path):
    """A map with a pole is compared after folding, and the report has the name and the numbers of this score."""
    run = made_once(small_tip, 2000, seed=1, **ROUGH)[:1800]
    measured = run.hits(ae.RollUp(0.2)).within_circle(60.0).map(bins=24, extent=(-60, 60, -60, 60))
    here = ae.Registration(0.0, 1.0, (0.0, 0.0))
    energies = {"means": (0.1, 0.2, 0.3), "relative_spreads": (0.5,)}
    study = fit_energies(run, measured, registration=here, replicas=1, resamples=3, progress=False, **energies)
    assert study.settings.objective == "folded"
    study.__dict__["likeness"] = study.likeness._replace(verdict="alike", reason="")
    ae.plot.write_study(study, tmp_path / "report.html")
    text = Reader((tmp_path / "report.html").read_text()).text
    assert f"concordance {study.plain['optimum']}" in text or f"concordance {study.optimum.score}" in text
    assert "SSIM" not in text
