"""
Pictures of the page "Precipitate or grain boundary?"
=====================================================

Three tips: ``examples/particle.toml``, the same with a particle that leaves early, and
``examples/grain_boundary.toml``.
The script runs what is not in the folder of the runs yet, draws ``howto/precipitate_or_boundary.png``, and prints the
numbers of the page. The runs take a minute and a half of processor time.
"""

import argparse
from pathlib import Path

import numpy as np

import apt_evap as ae
from apt_evap.cli.main import main
from apt_evap.config.simulation_file import read_config

HERE = Path(__file__).parent
EXAMPLES = HERE.parent / "examples"
EARLY = ("evaporation_field = 23.0", "evaporation_field = 15.0")  # V/nm
TITLES = {
    "late": "precipitate that leaves late",
    "early": "precipitate that leaves early",
    "boundary": "grain boundary",
}


def runs(folder):
    """The three runs, in real units."""
    folder.mkdir(parents=True, exist_ok=True)
    late = (EXAMPLES / "particle.toml").read_text()
    assert EARLY[0] in late
    texts = {"late": late, "early": late.replace(*EARLY), "boundary": (EXAMPLES / "grain_boundary.toml").read_text()}
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text)
        if not (folder / f"{name}.h5").exists():
            assert main(["run", str(folder / f"{name}.toml"), "-o", str(folder / f"{name}.h5"), "--quiet"]) == 0
    return {
        name: (read_config(folder / f"{name}.toml").simulation().tip, ae.load(folder / f"{name}.h5")) for name in texts
    }


def draw(loaded):
    """A column for each run: the specimen, the map, the hits of the solute, and the reconstruction."""
    figure = ae.plot.new_figure((9.0, 8.4))
    axes = figure.subplots(4, 3, height_ratios=[1.0, 1.0, 1.0, 0.55])
    for (name, (tip, run)), (specimen, whole, part, section) in zip(loaded.items(), axes.T, strict=True):
        solute = run.elements[1]
        ae.plot.cut(tip, "phase", specimen, legend=False, title=TITLES[name])
        specimen.set(ylim=(0, tip.positions[:, 2].max() + 0.3), xlabel="", ylabel="z [nm]")
        hits = run.hits(ae.Unperturbed())
        of_solute = np.array(run.elements)[run.species] == solute
        for ax, shown, smoothing, title in (
            (whole, hits, 2.5, "map of all ions"),
            (part, hits[of_solute], 4.0, f"map of {solute}"),
        ):
            map = shown.map(bins=96, extent=(-90, 90, -90, 90)).smoothed(smoothing)
            ax.imshow(
                map.values, cmap="inferno", extent=map.extent, origin="lower", vmax=np.quantile(map.values, 0.995)
            )
            ax.set_title(title, fontsize="medium")
        reconstruction = ae.reconstruct(hits, **ae.reconstruction.run_constants(run))
        inside = np.abs(reconstruction.positions[:, 1]) < 0.5  # nm
        x, _, depth = reconstruction.positions[inside].T
        red = of_solute[reconstruction.hits.ion[inside]]
        for kind, colour, size in ((~red, "0.75", 3), (red, "C3", 7)):
            section.scatter(x[kind], depth[kind], size, colour)
        section.set(aspect="equal", xlabel="x [nm]", ylabel="depth [nm]")
        section.set_title(f"reconstruction, {solute} in red", fontsize="medium")
        section.invert_yaxis()
    return figure


def numbers(loaded):
    """Print how many ions hit the place of the feature and a place without it, and the fractions of the solute."""
    for name, (_, run) in loaded.items():
        of_solute = np.array(run.elements)[run.species] == run.elements[1]
        third = np.arange(len(run)) * 3 // len(run)
        for perturbation in (ae.Unperturbed(), ae.RollUp(ae.TruncatedNormal(0.1, 0.1))):
            hits = run.hits(perturbation)
            if name == "boundary":  # a strip of 16 mm, and both strips beside it
                strip = hits.detected & (np.abs(hits.y) < 60)
                here = strip & (np.abs(hits.x) < 8)
                other, share = strip & (np.abs(np.abs(hits.x) - 20) < 8), 2
            else:  # the spot, and the opposite one
                here, other = (hits.detected & (np.hypot(hits.x - x, hits.y) < 15) for x in (18, -18))
                share = 1
            solute = [f"{of_solute[here & (third == part)].mean():.1%}" for part in range(3)]
            print(
                name,
                type(perturbation).__name__,
                f"{here.sum()} / {other.sum()} x {share} = {share * here.sum() / other.sum():.2f}",
            )
            print(f"    solute by thirds {', '.join(solute)}; elsewhere {of_solute[other].mean():.1%}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of the runs")
    loaded = runs(parser.parse_args().runs)
    numbers(loaded)
    draw(loaded).savefig(HERE / "howto" / "precipitate_or_boundary.png", dpi=90, bbox_inches="tight")
