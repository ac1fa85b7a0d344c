"""Distributing couplings, and means over held and tied nodes, against what CalculiX prints."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from fe.runtime.errors import MeshError
from fe.solver_deck.conversion import DeckOptions, convert_deck
from fe.structure.affine import static_responses
from fe.structure.operators import assemble_structure
from fe.verification.calculix_run import read_tables, run_calculix
from tests.calculix_decks import needs_calculix

REFERENCE = 900
COUPLING = [
    "*SURFACE, NAME=END",
    "4,S4",
    f"*COUPLING, REF NODE={REFERENCE}, SURFACE=END, CONSTRAINT NAME=C",
]
ELEMENT_COUPLING = [
    "*ELEMENT, TYPE=DCOUP3D, ELSET=MIDDLE",
    f"901,{REFERENCE}",
    "*DISTRIBUTING COUPLING, ELSET=MIDDLE",
    "TIP,1.",
]


def bar(*loads: str, coupling: list[str], split: bool = False) -> str:
    """Return the deck of four cubes of 1 mm along x, whose last face is wider than the others.

    The set MIX has held and free nodes. SEAM also has tied ones if the bar is split into two bodies
    that a *TIE joins.
    """
    corners = list(itertools.product((0.0, 1.0), (0.0, 1.0)))
    layers = [float(x) for x in range(5)]
    if split:
        layers.insert(3, 2.0)
    nodes = []
    for layer, x in enumerate(layers):
        for corner, (y, z) in enumerate(corners):
            width = 3.0 if (layer == len(layers) - 1 and z) else 1.0
            nodes.append(f"{4 * layer + corner + 1},{x},{width * y},{z}")
    elements = []
    starts = [layer for layer in range(len(layers) - 1) if not (split and layer == 2)]
    for number, layer in enumerate(starts, start=1):
        first, second = 4 * layer, 4 * layer + 4
        numbers = [
            first + 1,
            second + 1,
            second + 3,
            first + 3,
            first + 2,
            second + 2,
            second + 4,
            first + 4,
        ]
        elements.append(",".join(map(str, (number, *numbers))))
    tip = 4 * len(layers)
    lines = ["*NODE, NSET=ALL", *nodes, "*NODE", f"{REFERENCE},6.,0.4,0.7"]
    lines += ["*ELEMENT, TYPE=C3D8, ELSET=BAR", *elements]
    lines += [
        "*NSET, NSET=ROOT",
        "1,2,3,4",
        "*NSET, NSET=TIP",
        f"{tip - 3},{tip - 2},{tip - 1},{tip}",
    ]
    lines += ["*NSET, NSET=MIX", f"1,{tip},{tip}", "*NSET, NSET=SEAM", f"2,13,16,{tip}"]
    lines += ["*NSET, NSET=BOTH", f"{REFERENCE},{tip}"]
    lines += ["*MATERIAL, NAME=STEEL", "*ELASTIC", "2.1e5,0.3", "*DENSITY", "7.8e-9"]
    lines += ["*SOLID SECTION, ELSET=BAR, MATERIAL=STEEL", *coupling]
    if split:
        lines += [
            "*SURFACE, NAME=LEFT",
            "2,S4",
            "*SURFACE, NAME=RIGHT",
            "3,S6",
            "*TIE, NAME=SEAM",
            "RIGHT,LEFT",
        ]
    lines += ["*BOUNDARY", "ROOT,1,3", "*STEP", "*STATIC", "*CLOAD", *loads]
    lines += ["*NODE PRINT, NSET=ALL", "U", "*END STEP"]
    return "\n".join(lines) + "\n"


def outputs_and_printed(
    folder: Path, text: str, *outputs: str
) -> tuple[list[float], dict[int, np.ndarray]]:
    """Return the outputs [mm] under all loads of a deck, and what CalculiX prints for each node."""
    out = folder / "out"
    out.mkdir()
    deck = folder / "deck.inp"
    deck.write_text(text)
    convert_deck(deck, out, "structure", DeckOptions(outputs=outputs))
    structure = assemble_structure(out / "structure.toml")
    responses = static_responses(structure)
    total = sum(response.displacement for response in responses.values())
    (table,) = read_tables(run_calculix(text, folder / "ccx", "whole"))["ALL"]
    printed = {int(row[0]): row[1:] for row in table}
    return (1e3 * structure.displacement_output @ total).tolist(), printed


@needs_calculix
@pytest.mark.parametrize(
    ("coupling", "loads"),
    [
        ([*COUPLING, "*DISTRIBUTING", "1,3"], [f"{REFERENCE},3,400."]),
        (
            [*COUPLING, "*DISTRIBUTING", "1,3"],
            [f"{REFERENCE},1,50.", f"{REFERENCE},2,-30.", "20,3,7."],
        ),
        ([*COUPLING, "*DISTRIBUTING", "1,6"], [f"{REFERENCE},2,90.", f"{REFERENCE},5,60."]),
        (ELEMENT_COUPLING, [f"{REFERENCE},3,400."]),
    ],
)
def test_loads_on_a_distributing_coupling_are_shared_as_calculix_does(tmp_path, coupling, loads):
    deck = bar(*loads, coupling=coupling)
    outputs, printed = outputs_and_printed(tmp_path, deck, "17", "20")
    expected = [*printed[17], *printed[20]]
    np.testing.assert_allclose(outputs, expected, atol=2e-6 * np.abs(expected).max())


@needs_calculix
def test_a_coupling_on_tied_nodes_is_shared(tmp_path):
    coupling = [line.replace("4,S4", "3,S6") for line in COUPLING]
    deck = bar(f"{REFERENCE},3,400.", coupling=[*coupling, "*DISTRIBUTING", "1,3"], split=True)
    outputs, printed = outputs_and_printed(tmp_path, deck, "24:z")
    assert outputs == pytest.approx([printed[24][2]], rel=1e-5)


@needs_calculix
@pytest.mark.parametrize(
    ("name", "nodes", "split"), [("MIX", (1, 20), False), ("SEAM", (2, 13, 16, 24), True)]
)
def test_held_and_tied_nodes_belong_to_the_mean(tmp_path, name, nodes, split):
    deck = bar("TIP,3,10.", coupling=[], split=split)
    outputs, printed = outputs_and_printed(tmp_path, deck, name)
    expected = np.mean([printed[node] for node in nodes], axis=0)
    np.testing.assert_allclose(outputs, expected, atol=2e-6 * np.abs(expected).max())


@needs_calculix
def test_nodes_that_are_held_along_one_axis_have_outputs_along_the_others(tmp_path):
    deck = bar("TIP,3,10.", coupling=[]).replace("ROOT,1,3\n", "ROOT,1,3\nTIP,2\n")
    outputs, printed = outputs_and_printed(tmp_path, deck, "TIP")
    expected = np.mean([printed[node] for node in (17, 18, 19, 20)], axis=0)
    np.testing.assert_allclose(outputs, expected[[0, 2]], atol=2e-6 * np.abs(expected).max())


@needs_calculix
@pytest.mark.parametrize(
    ("output", "reason"),
    [
        ("ROOT", "all its nodes are held"),
        ("ROOT:x", "all its nodes are held"),
        ("BOTH", f"how node {REFERENCE} moves does not follow from the matrices"),
    ],
)
def test_a_mean_that_is_not_known_is_refused(tmp_path, output, reason):
    deck = bar("TIP,3,10.", coupling=[])
    with pytest.raises(MeshError, match=reason):
        outputs_and_printed(tmp_path, deck, output)
