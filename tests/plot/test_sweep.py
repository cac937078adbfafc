"""Report of a sweep: one row for each point, the best one first."""

import json
import re

import numpy as np
import pytest
from html_reader import Reader

import apt_evap as ae
from apt_evap.fit.study import bounded_text
from apt_evap.plot.report.html_page import read_report
from apt_evap.plot.report.sweep_report import SweepRow


def rows(study):
    content = json.loads(json.dumps(study.to_dict()))  # as read from study.json
    better = json.loads(json.dumps(content))
    better["optimum"]["score"] = {"value": 1.97654, "error": None}
    better["refined"]["intervals"] = {}
    better["registration"]["doubtful"] = True
    better["no_energy"], better["energy"] = "the errors are not known", ""
    unrelated = json.loads(json.dumps(content))
    unrelated["optimum"]["score"] = {"value": 2.55555, "error": None}
    unrelated["likeness"]["verdict"], unrelated["no_energy"] = "not alike", "the maps are not alike"
    unrelated["energy"], content["no_energy"] = "", ""
    refined, factor = study.refined, study.provenance["real_units"]["real_per_study"]
    content["energy"] = bounded_text(refined.true_mean, refined.intervals["true_mean"], None, factor)
    maps = {"measured": study.measured, "best": study.maps["optimum"]}
    return [
        SweepRow("3f9c", {"tip.axis": [1, 1, 1], "tip.apex_radius": "20 a"}, {"ions": 15000}, content),
        SweepRow("77aa", {"tip.axis": [0, 0, 1]}, message="exit code 2: <no> memory"),
        SweepRow("9e9e", {"tip.apex_radius": "60 a"}, {}, unrelated, maps),
        SweepRow("0b1d", {"tip.apex_radius": "40 a"}, {"ions": 500, "R [nm]": np.float64(7.04)}, better, maps),
    ]


def test_points_in_the_order_of_their_similarity(study, tmp_path):
    made = rows(study)
    ae.plot.write_sweep(made, tmp_path / "s.html", title="Axes", command="apt-evap sweep collect study")
    seen = Reader((tmp_path / "s.html").read_text())
    text = seen.text
    order = ["0b1d", "3f9c", "9e9e", "77aa"]
    places = [text.index(name) for name in order]
    assert places == sorted(places)  # the score of an unrelated map counts for nothing
    refined, factor = study.refined, study.provenance["real_units"]["real_per_study"]
    real = bounded_text(refined.true_mean, refined.intervals["true_mean"], None, factor)
    for each in (
        "4 points, 1 of them incomplete.", "Axes", "tip.axis", "1, 1, 1", "15,000", "R [nm]", "7.04", "1.977", real,
        str(study.optimum.score), "exit code 2: <no> memory", "20 a", "apex_radius 40 a",
        "apt-evap sweep collect study",
    ):  # fmt: skip
        assert each in text, each
    assert "2.556" not in text
    assert len(seen.all("tr", "best")) == 1 and len(seen.all("span", "red")) == 2
    headings = re.findall("<h2>(.*?)</h2>", (tmp_path / "s.html").read_text())
    assert not any(name in heading for name in order for heading in headings)  # of settings
    # measured and simulated map of two points, and the similarity against the radius
    assert len(seen.all("img")) == 5 and all(each.startswith(("data:", "#")) for each in seen.addresses)
    content = read_report(tmp_path / "s.html")
    assert [row["name"] for row in content["points"]] == order
    assert content["points"][1]["study"] == json.loads(json.dumps(made[0].study))


def test_the_score_has_the_name_of_its_objective(study, tmp_path):
    points = rows(study)
    for objective, name, other in (("similarity", "SSIM", "concordance"), ("folded", "concordance", "SSIM")):
        for row in points:
            if row.study:
                row.study["settings"]["objective"] = objective
        ae.plot.write_sweep(points, tmp_path / "s.html", pictures=0)
        table = Reader((tmp_path / "s.html").read_text()).text
        assert name in table and other not in table


def test_points_without_a_study(tmp_path):
    points = [SweepRow(name, {"seed": seed}) for seed, name in enumerate("ab")]
    ae.plot.write_sweep(points, tmp_path / "s.html")
    seen = Reader((tmp_path / "s.html").read_text())
    assert "2 points, all complete." in seen.text and "SSIM" not in seen.text and "Message" not in seen.text
    assert seen.all("tr", "best") == []
    assert seen.text.index("seed Point 0 a 1 b") > 0
    points = [SweepRow(name, {"radius": 5.0, "seed": seed}, {"ions": 100}) for seed, name in enumerate("ab")]
    ae.plot.write_sweep(points, tmp_path / "t.html")
    seen = Reader((tmp_path / "t.html").read_text())  # what is alike for all is said once
    assert "seed Point 0 a 1 b" in seen.text and "radius 5; ions 100" in seen.text


def test_a_sweep_without_points_is_refused(tmp_path):
    with pytest.raises(ValueError, match="rows"):
        ae.plot.write_sweep([], tmp_path / "s.html")


def test_only_as_many_pictures_as_asked_for(study, tmp_path):
    ae.plot.write_sweep(rows(study), tmp_path / "s.html", pictures=0)
    assert Reader((tmp_path / "s.html").read_text()).all("img") == []


@pytest.mark.slow
def test_maps_without_a_comparison_are_shown_for_every_emission(study, tmp_path, monkeypatch):
    points = [
        SweepRow(name, {"seed": seed}, panels={"unperturbed": study.measured, "rolled": study.measured})
        for seed, name in enumerate("ab")
    ]
    ae.plot.write_sweep([*points, SweepRow("c", {"seed": 3}, message="failed")], tmp_path / "s.html")
    seen = Reader((tmp_path / "s.html").read_text())
    assert [each["alt"] for each in seen.all("img")] == ["unperturbed", "rolled"]
    monkeypatch.setattr("apt_evap.plot.report.sweep_report._MOST_MAPS", 1)
    ae.plot.write_sweep(points * 2, tmp_path / "s.html")
    assert "3 more points are in the file of the maps." in Reader((tmp_path / "s.html").read_text()).text
