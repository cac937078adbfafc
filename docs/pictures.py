"""
Pictures of the examples
========================

Truth, map and reconstruction of every example of ``apt-evap run`` with a feature, and the picture of the page
"Precipitate or grain boundary?".

The script runs what is not in the folder of the runs yet, draws ``howto/examples/NAME.png`` and
``howto/precipitate_or_boundary.png``, and prints the numbers of that page. The runs take a minute of processor time
each.
"""

import argparse
from pathlib import Path

import numpy as np

import apt_evap as ae
from apt_evap.cli.main import main
from apt_evap.simulation.config.simulation_file import read_config

HERE = Path(__file__).parent
EXAMPLES = HERE.parent / "examples"
SHOWN = {  # elements in colour, by example; the others are grey
    "core_shell": {"Al": "C0", "Cr": "C3"},
    "gamma_prime": {"Al": "C3"},
    "gp_zone": {"Cu": "C3"},
    "multilayer": {"Cu": "C3"},
    "multilayer_across": {"Cu": "C3"},
    "grain_boundary": {"Al": "C3"},
    "precipitate": {"Cu": "C3"},
}
EARLY = ("evaporation_field = 23.0", "evaporation_field = 15.0")  # V/nm
TITLES = {
    "precipitate": "late precipitate",
    "early": "early precipitate",
    "grain_boundary": "grain boundary",
}
HALF = 0.5  # nm, of a slice


def run_of(name, folder, text):
    """Tip and run of settings, in real units; what is in the folder is not run again."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.toml"
    path.write_text(text)
    if not path.with_suffix(".h5").exists():
        assert main(["run", str(path), "-o", str(path.with_suffix(".h5")), "--quiet", "--threads", "1"]) == 0
    return read_config(path).simulation().tip, ae.load(path.with_suffix(".h5"))


def elements_of(run):
    """Name of the element of each ion."""
    return np.array(run.elements)[run.species]


def draw_truth(tip, run, colours, ax):
    """Atoms of the specimen within a slice about y = 0, down to the deepest atom that has left."""
    inside = np.abs(tip.positions[:, 1]) < HALF
    deepest = tip.positions[run.site][:, 2].min()
    x, _, z = tip.positions[inside].T
    names = np.array([element.name for element in tip.elements])[tip.species[inside]]
    for name in (None, *colours):
        chosen = ~np.isin(names, list(colours)) if name is None else names == name
        size, colour, label = (3, "0.7", "other") if name is None else (5, colours[name], name)
        ax.scatter(x[chosen], z[chosen], size, colour, linewidths=0, label=label)
    ax.set(aspect="equal", ylim=(deepest - 0.5, tip.positions[:, 2].max() + 0.3), xlabel="x [nm]", ylabel="z [nm]")


def draw_reconstruction(run, colours, ax):
    """Reconstructed ions within a slice about y = 0, with the constants of the run."""
    reconstruction = ae.reconstruct(run.hits(ae.Unperturbed()), **ae.reconstruction.run_constants(run))
    inside = np.abs(reconstruction.positions[:, 1]) < HALF
    x, _, depth = reconstruction.positions[inside].T
    names = elements_of(run)[reconstruction.hits.ion[inside]]
    for name in (None, *colours):
        chosen = ~np.isin(names, list(colours)) if name is None else names == name
        size, colour = (3, "0.7") if name is None else (7, colours[name])
        ax.scatter(x[chosen], depth[chosen], size, colour, linewidths=0)
    ax.set(aspect="equal", xlabel="x [nm]", ylabel="depth [nm]")
    ax.invert_yaxis()


def draw_map(hits, smoothing, ax, reach=90):
    """A map [mm]."""
    shown = hits.map(bins=96, extent=(-reach, reach, -reach, reach)).smoothed(smoothing)
    ax.imshow(shown.values, cmap="inferno", extent=shown.extent, origin="lower", vmax=np.quantile(shown.values, 0.995))
    ax.set(xlabel="x [mm]", ylabel="y [mm]")


def draw_example(name, tip, run):
    """Truth, map of all ions, map of the coloured elements, and reconstruction, beside each other."""
    colours = SHOWN[name]
    figure = ae.plot.new_figure((13.0, 3.4))
    truth, whole, part, section = figure.subplots(1, 4, width_ratios=(1.25, 1, 1, 1.25))
    hits = run.hits(ae.Unperturbed())
    draw_truth(tip, run, colours, truth)
    truth.set_title("specimen, 1 nm thick slice")
    draw_map(hits, 2.5, whole)
    whole.set_title(f"map of all {len(run):,} ions")
    draw_map(hits[np.isin(elements_of(run), list(colours))], 4.0, part)
    part.set_title(f"map of {' and '.join(colours)}")
    draw_reconstruction(run, colours, section)
    section.set_title("reconstruction, the same slice")
    figure.legend(*truth.get_legend_handles_labels(), loc="outside lower center", ncols=3, markerscale=3, frameon=False)
    return figure


def draw_comparison(loaded):
    """A column for each run: the specimen, the map, the hits of the solute, and the reconstruction."""
    figure = ae.plot.new_figure((9.0, 8.4))
    axes = figure.subplots(4, 3, height_ratios=[1.0, 1.0, 1.0, 0.55])
    for (name, (tip, run)), (specimen, whole, part, section) in zip(loaded.items(), axes.T, strict=True):
        solute = run.elements[1]
        ae.plot.cut(tip, "phase", specimen, legend=False, title=TITLES[name])
        specimen.set(ylim=(0, tip.positions[:, 2].max() + 0.3), xlabel="", ylabel="z [nm]")
        hits = run.hits(ae.Unperturbed())
        draw_map(hits, 2.5, whole)
        whole.set_title("map of all ions", fontsize="medium")
        draw_map(hits[elements_of(run) == solute], 4.0, part)
        part.set_title(f"map of {solute}", fontsize="medium")
        draw_reconstruction(run, {solute: "C3"}, section)
        section.set_title(f"reconstruction, {solute} in red", fontsize="medium")
    return figure


def numbers(loaded):
    """Print how many ions hit the place of the feature and a place without it, and the fractions of the solute."""
    for name, (_, run) in loaded.items():
        of_solute = elements_of(run) == run.elements[1]
        third = np.arange(len(run)) * 3 // len(run)
        for perturbation in (ae.Unperturbed(), ae.RollUp(ae.TruncatedNormal(0.1, 0.1))):
            hits = run.hits(perturbation)
            if name == "grain_boundary":  # a strip of 16 mm, and both strips beside it
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
    runs = parser.parse_args().runs
    (HERE / "howto" / "examples").mkdir(exist_ok=True)
    texts = {name: (EXAMPLES / f"{name}.toml").read_text() for name in SHOWN}
    assert EARLY[0] in texts["precipitate"]
    loaded = {name: run_of(name, runs, text) for name, text in texts.items()}
    for name, (tip, run) in loaded.items():
        draw_example(name, tip, run).savefig(HERE / "howto" / "examples" / f"{name}.png", dpi=70)
    early = run_of("early", runs, texts["precipitate"].replace(*EARLY))
    compared = {"precipitate": loaded["precipitate"], "early": early, "grain_boundary": loaded["grain_boundary"]}
    numbers(compared)
    draw_comparison(compared).savefig(HERE / "howto" / "precipitate_or_boundary.png", dpi=90, bbox_inches="tight")
