"""To and from ASE and pandas, and extended XYZ as ASE reads it."""

import sys

import numpy as np
import pytest

import apt_evap as ae

EXACT = 1e-12  # [nm] positions go through Angstrom and back: two roundings of numbers up to 100

# a factor common to all charges is a threshold, which rounding errors of the places may pass at another event
PLAIN = ae.evaporation.ChargeSettings(potential_bound=1.0)


@pytest.fixture(scope="session")
def alloy():
    """A tip of two species, small enough for a text file."""
    return ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1), shank_length=2.0, solutes={"Al": 0.01}, seed=4)


def charges_read(atoms):
    """The column "charge" of a file; versions of ASE differ in where they put it."""
    return atoms.arrays["charge"] if "charge" in atoms.arrays else atoms.get_charges()


@pytest.fixture(scope="session")
def run(alloy):
    return ae.Simulation(alloy, seed=1, charge_settings=PLAIN).run(60, responses=False, progress=False)


class TestAse:
    @pytest.fixture(autouse=True)
    def ase(self):
        return pytest.importorskip("ase")

    def test_there_and_back(self, alloy):
        atoms = alloy.to_atoms()
        assert len(atoms) == len(alloy)
        assert atoms.get_chemical_symbols()[:50] == [alloy.elements[k].name for k in alloy.species[:50]]
        # nearest neighbours of nickel are 2.49 Angstrom apart
        assert atoms.get_distances(0, range(1, len(atoms))).min() == pytest.approx(3.52 / 2**0.5, rel=1e-9)
        tip = ae.Tip.from_atoms(atoms)
        np.testing.assert_allclose(tip.positions, alloy.positions, rtol=0, atol=EXACT)
        np.testing.assert_array_equal(tip.evaporable, alloy.evaporable)
        assert [tip.elements[k] for k in tip.species] == [alloy.elements[k] for k in alloy.species]

    def test_the_same_atoms_leave(self, alloy, run):
        tip = ae.Tip.from_atoms(alloy.to_atoms(), potential_point=alloy.potential_point)
        again = ae.Simulation(tip, seed=1, charge_settings=PLAIN).run(60, responses=False, progress=False)
        assert again.site.tolist() == run.site.tolist()

    def test_a_crystal_of_ase(self, ase):
        from ase.build import bulk

        block = bulk("Cu", cubic=True) * (12, 12, 12)
        ball = block[np.linalg.norm(block.positions - block.positions.mean(axis=0), axis=1) < 15]  # Angstrom
        tip = ae.Tip.from_atoms(ball)
        assert tip.elements == (ae.material("Cu"),)
        # atoms in the ball times the volume of one
        assert len(tip) * 0.361**3 / 4 == pytest.approx(4 / 3 * np.pi * 1.5**3, rel=0.1)
        assert tip.nearest_neighbour_distance == pytest.approx(0.361 / 2**0.5, rel=1e-9)
        assert sum(map(len, ae.evaporation.Emitter(tip).advance(5))) == 5

    def test_elements_begin_with_the_most_frequent(self, ase):
        atoms = ase.Atoms("AlNi2Al2", positions=np.arange(15.0).reshape(5, 3) * 2)
        assert [element.name for element in ae.Tip.from_atoms(atoms).elements] == ["Al", "Ni"]
        assert ae.Tip.from_atoms(atoms).species.tolist() == [0, 1, 1, 0, 0]

    def test_materials_of_ones_own(self, ase):
        strong = ae.material("Ni", evaporation_field=40.0)
        dots = ase.Atoms("XNi", positions=[[0, 0, 0], [0, 0, 2.5]])
        other = ae.Material("grain", "fcc", 0.35, 30.0, 1, 60.0)
        tip = ae.Tip.from_atoms(dots, materials={"Ni": strong, "X": other}, evaporable=[True, True])
        assert tip.evaporation_fields.tolist() == [30.0, 40.0]
        assert tip.evaporable.all()
        assert tip.to_atoms().get_chemical_symbols() == ["X", "Ni"]

    def test_refusals(self, ase):
        with pytest.raises(ValueError, match="atoms"):
            ae.Tip.from_atoms(5)
        with pytest.raises(ValueError, match="no material is named 'Xe'"):
            ae.Tip.from_atoms(ase.Atoms("Xe2", positions=[[0, 0, 0], [0, 0, 3]]))
        with pytest.raises(ValueError, match="at least 2 atoms"):
            ae.Tip.from_atoms(ase.Atoms())
        shell = ae.Tip("Ni", apex_radius=4.0, depth=1.5)
        with pytest.raises(ValueError, match="got a shell"):
            ae.Tip.from_atoms(shell.to_atoms())

    def test_the_surface(self, alloy):
        emitter = ae.evaporation.Emitter(alloy)
        atoms = emitter.to_atoms()
        np.testing.assert_allclose(atoms.positions / 10, emitter.positions, rtol=0, atol=EXACT)
        for name in ("charge", "field", "normal", "atom"):
            np.testing.assert_array_equal(atoms.arrays[name], getattr(emitter, name + "s"))
        specimen = alloy.to_atoms()
        assert (atoms.numbers == specimen.numbers[emitter.atoms]).all()

    def test_the_surface_through_a_file(self, alloy, tmp_path):
        from ase.io import read, write

        atoms = ae.evaporation.Emitter(alloy).to_atoms()
        write(tmp_path / "surface.xyz", atoms)
        again = read(tmp_path / "surface.xyz")
        # ASE writes eight decimals
        np.testing.assert_allclose(charges_read(again), atoms.arrays["charge"], rtol=0, atol=0.51e-8)
        np.testing.assert_allclose(again.arrays["field"], atoms.arrays["field"], rtol=0, atol=0.51e-8)

    def test_ions_in_an_xyz_that_ase_reads(self, run, tmp_path):
        from ase.io import read

        hits = run.hits(ae.Unperturbed())
        labels = np.array(run.elements)[run.species]
        ae.write(tmp_path / "ions.xyz", hits, species=labels)
        atoms = read(tmp_path / "ions.xyz")
        assert atoms.get_chemical_symbols() == labels.tolist()
        assert not atoms.pbc.any()
        # five decimals of an Angstrom
        np.testing.assert_allclose(atoms.positions, 10 * hits.positions, rtol=0, atol=0.51e-5)
        np.testing.assert_array_equal(charges_read(atoms), run.charges)
        np.testing.assert_array_equal(atoms.arrays["field"], run.fields)
        assert atoms.arrays["ion"].tolist() == list(range(60))  # the order of evaporation
        assert atoms.arrays["site"].tolist() == run.site.tolist()
        assert len(set(labels)) == 2


class TestPandas:
    @pytest.fixture(autouse=True)
    def pandas(self):
        return pytest.importorskip("pandas")

    def test_columns(self, run):
        hits = run.hits(ae.Unperturbed())
        frame = hits.to_dataframe()
        assert len(frame) == 60
        for name in ("x", "y", "time_of_flight", "site", "ion", "outcome"):
            np.testing.assert_array_equal(frame[name], getattr(hits, name))
            assert frame[name].dtype == getattr(hits, name).dtype
        np.testing.assert_array_equal(frame[["position_x", "position_y", "position_z"]], hits.positions)
        np.testing.assert_array_equal(frame["field"], run.fields)
        assert frame.attrs == {"source": hits.source, "units": {"charge": "e", "field": "V/nm"}}
        assert set(frame) == {*hits.columns, *hits.extra, "position_x", "position_y", "position_z"} - {"positions"}

    def test_species_of_measured_ions(self):
        ranges = ae.spectra.Ranges(names=("Al", "Cu"), low=[26, 62], high=[28, 64])
        frame = ae.Hits(mass_to_charge=[27.0, 63.0, 27.0, 40.0]).to_dataframe(ranges)
        assert frame["species"].tolist() == ["Al", "Cu", "Al", ""]
        with pytest.raises(ValueError, match="ranges"):
            ae.Hits(x=[1.0]).to_dataframe("a.rrng")

    def test_further_columns_and_a_change_of_the_frame(self):
        hits = ae.Hits(x=[1.0, 2.0], extra={"pair": [[1, 2], [3, 4]], "name": ["a", "b"]})
        frame = hits.to_dataframe()
        assert frame["pair_1"].tolist() == [2, 4] and frame["name"].tolist() == ["a", "b"]
        frame.loc[0, "x"] = 5.0
        assert hits.x[0] == 1.0


@pytest.mark.parametrize(("package", "call"), [("ase", "tip.to_atoms()"), ("pandas", "hits.to_dataframe()")])
def test_a_package_that_is_not_installed(package, call, monkeypatch, small_tip):
    for name in [package, *(name for name in sys.modules if name.startswith(package + "."))]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=rf"needs {package}, which is not installed: pip install {package}"):
        eval(call, {"tip": small_tip, "hits": ae.Hits(x=[1.0])})
