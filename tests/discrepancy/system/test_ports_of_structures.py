"""Ports that a structure file declares: places where a force that the model lacks may act."""

from pathlib import Path

import numpy as np
import pytest
from scipy import io, sparse

from discrepancy.campaign.records import Quantity, TrialKind
from discrepancy.errors import ModelError
from discrepancy.model_choice import choose_model
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.full.factorisation import Factorisation
from fe.reduction.model_cache import reduced_model
from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import PowerStiffness
from fe.structure.design import load_structure
from fe.structure.operators import load_and_assemble
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.structures import rig_text
from tests.discrepancy.rigs import asked, chosen, seen, simulated
from tests.refusals import refused

AT_POINT = '{ name = "lug", point = [50, 10, 5], direction = [0, 0, 2] }'
ON_SET = '{ name = "lug", set = "middle", direction = [0, 0, 1] }'
OUTPUTS = {"tip": Quantity.DISPLACEMENT, "g1": Quantity.STRAIN}


@pytest.fixture
def write_ported_beam(write_beam, tmp_path: Path):
    """A writer of the beam that is pushed at its tip, with ports; in a folder of its own if one is named."""

    def write(*ports: str, folder: str = "") -> Path:
        changes = {
            "set = [\n": 'set = [\n{ name = "middle", of = "nodes", box = [[50, 0, 0], [50, 20, 10]] },\n',
            'set = "end", force': "point = [100, 10, 5], force",
        }
        if ports:
            changes["parameter = [{"] = f"port = [{', '.join(ports)}]\nparameter = [{{"
        (tmp_path / folder).mkdir(exist_ok=True)
        return write_beam(tmp_path / folder, changes, cells=2)

    return write


@pytest.mark.parametrize("port", [AT_POINT, ON_SET])
def test_an_effect_is_found_at_a_port_where_no_load_stands(port: str, write_ported_beam) -> None:
    """Also where another port has the name of a wing's, which stands for all of a wing's ports alone."""
    model = choose_model(write_ported_beam(port)).model
    assert model.ports == ("tip", "lug")
    campaign = simulated(model, "static", 3, ("cubic_stiffness", {"stiffening": 0.02}, "lug"))
    effects = chosen("cubic_stiffness", "gauge_gain", "load_cell")
    verdict = investigate(campaign, model, effects, seed=3, thorough=False).verdict
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert [(effect.identifier, effect.place) for effect in verdict.effects] == [("cubic_stiffness", "lug")]


@pytest.mark.parametrize("port", [AT_POINT, ON_SET])
def test_a_spring_at_a_port_acts_as_on_the_full_structure(port: str, write_ported_beam) -> None:
    file = write_ported_beam(port)
    push, spring = 20.0, 3e6  # N, N/m: as stiff as the beam there
    structure = load_and_assemble(file)
    row = structure.port_output.toarray()[0]
    stiffness = structure.stiffness() + spring * sparse.csr_array(np.outer(row, row))
    displacement = Factorisation(stiffness).solve(structure.load("pushed", push))
    wanted = [structure.displacement_output @ displacement, structure.gauge_output[[0]] @ displacement]

    model = choose_model(file).model
    trial = asked(TrialKind.STATIC, np.arange(2.0), force=np.array([0.0, push]), run="A")
    law = PowerStiffness("lug", spring * 1e-3, 1.0, 0, 1e-3)
    found = seen(model, trial, OUTPUTS, law, parameters=model.prior_mean())
    np.testing.assert_allclose(found[1], np.ravel(wanted), rtol=1e-4)


@pytest.fixture
def beams(write_ported_beam) -> tuple[Path, Path]:
    """The structure files of the beam without and with a port, in folders of their own."""
    return write_ported_beam(folder="without"), write_ported_beam(AT_POINT, folder="with")


def test_a_port_changes_neither_the_structure_nor_its_fmu(beams: tuple[Path, Path], tmp_path: Path) -> None:
    without, ported = (reduced_model(file) for file in beams)
    fmu_without = build_fmu(without, tmp_path / "without.fmu").path
    fmu_ported = build_fmu(ported, tmp_path / "with.fmu").path
    assert without.design_hash == ported.design_hash
    assert fmu_without.read_bytes() == fmu_ported.read_bytes()


def test_a_verdict_rests_on_the_structure_and_on_its_ports(beams: tuple[Path, Path]) -> None:
    """An effect may be at the port."""
    without, ported = (choose_model(file) for file in beams)
    design_hash = reduced_model(beams[0]).design_hash
    assert without.design_hash == ported.design_hash == design_hash
    assert without.source_hash == design_hash != ported.source_hash


def test_a_port_is_neither_a_quantity_nor_a_place_of_a_load(beams: tuple[Path, Path]) -> None:
    without, ported = (choose_model(file).model for file in beams)
    assert "lug" not in ported.quantities
    assert ported.load_places == without.load_places


def test_the_file_beside_an_fmu_says_which_port_the_fmu_has_not(beams: tuple[Path, Path]) -> None:
    told = "# Not in the FMU, which has no force there: port lug of the structure file."
    assert [told in rig_text(load_structure(file), "beam.fmu") for file in beams] == [False, True]


@pytest.mark.parametrize(
    ("port", "sentence"),
    [
        (
            AT_POINT.replace("50, 10, 5", "100, 10, 5"),
            "The port 'lug' of the structure beam moves exactly as its port 'tip' does",
        ),
        (
            ON_SET.replace("middle", "centre"),
            r"port\[1\]: .* no set of nodes or faces named 'centre'; there are .*middle",
        ),
        (
            ON_SET.replace("middle", "root"),
            r"port\[1\] \(lug\): the supports hold all that a force there would move",
        ),
        (
            AT_POINT.replace("lug", "tip"),
            r"displacement\[1\] and port\[1\] are both named 'tip'",
        ),
        (
            AT_POINT.replace("point", 'set = "middle", point'),
            r"port\[1\]: either set, or point is expected",
        ),
    ],
)
def test_a_port_that_can_be_none_is_refused(port, sentence, write_ported_beam) -> None:
    file = write_ported_beam(port)
    with refused(ModelError, sentence):
        choose_model(file)


def test_the_full_model_refuses_an_unknown_set_of_a_port(write_ported_beam) -> None:
    """Whatever command reads the file, also one that needs no port."""
    file = write_ported_beam(ON_SET.replace("middle", "centre"))
    with refused(FiniteElementError, r"port\[1\]: .* no set of nodes or faces named 'centre'"):
        load_and_assemble(file)


# ---------------------------------------------------------------- from matrices

MASSES = 30
SPRING = 2e5  # N/m, of each of the springs between the masses


def write_chain(folder: Path, unit: str, port: str) -> Path:
    """Write a chain of springs and masses that is held at one end and pulled at the other."""
    size = {"m": 1.0, "mm": 1e-3}[unit]
    stiffness = 2.0 * np.eye(MASSES) - np.eye(MASSES, k=1) - np.eye(MASSES, k=-1)
    stiffness[-1, -1] = 1.0
    first_spring = np.zeros((MASSES, MASSES))
    first_spring[0, 0] = 1.0
    matrices = {"k": SPRING * stiffness, "first": SPRING * first_spring, "m": 0.5 * np.eye(MASSES)}
    for name, matrix in matrices.items():
        io.mmwrite(folder / f"{name}.mtx", sparse.coo_array(size * matrix))
    rows = "\n".join(f"{node}.1" for node in range(1, MASSES + 1))
    (folder / "rows.dof").write_text(rows, encoding="utf-8")
    file = folder / "chain.toml"
    file.write_text(
        f"""
        name = "chain"
        length_unit = "{unit}"
        stiffness_matrix = "k.mtx"
        mass_matrix = "m.mtx"
        unknowns = "rows.dof"
        control = [{{ name = "pull", unit = "N" }}]
        damage = [{{ name = "z1" }}]
        part = [{{ matrix = "first.mtx", damage = "z1" }}]
        load = [{{ name = "pull", control = "pull", node = {MASSES}, force = [1, 0, 0] }}]
        displacement = [{{ name = "end", node = {MASSES}, direction = [1, 0, 0] }}]
        port = [{port}]
        """,
        encoding="utf-8",
    )
    return file


@pytest.mark.parametrize("unit", ["m", "mm"])
def test_a_spring_at_a_port_from_matrices_is_in_newtons_per_metre(unit: str, tmp_path: Path) -> None:
    """At the middle, a port of the file, or at the end, one of the load; in any unit of the matrices."""
    middle = f'{{ name = "middle", node = {MASSES // 2}, direction = [1, 0, 0] }}'
    model = choose_model(write_chain(tmp_path, unit, middle)).model
    assert model.ports == ("end", "middle")
    half, force = SPRING / (MASSES / 2), 8.0  # N/m of half of the chain, N
    trial = asked(TrialKind.STATIC, np.arange(2.0), force=np.array([0.0, force]), run="A")
    outputs = {"end": Quantity.DISPLACEMENT}
    for port, spring, wanted in (
        ("middle", half, force / (2.0 * half) + force / half),
        ("end", 0.5 * half, force / half),
    ):
        law = PowerStiffness(port, spring * 1e-3, 1.0, 0, 1e-3)
        found = seen(model, trial, outputs, law, parameters=model.prior_mean())
        assert found[1, 0] == pytest.approx(wanted, rel=1e-6)


def test_a_port_from_matrices_at_no_node_is_refused(tmp_path: Path) -> None:
    port = '{ name = "middle", node = 99, direction = [1, 0, 0] }'
    with refused(ModelError, r"port\[1\] \(middle\): node 99 has no component 1 in the matrices"):
        choose_model(write_chain(tmp_path, "mm", port))
