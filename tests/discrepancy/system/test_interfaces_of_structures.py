"""An interface of two parts that yields is a cause that is tried, in each motion that it holds."""

import pytest

from discrepancy.files.verdict import PrimitiveInterval
from discrepancy.report.sizes import si_sizes
from discrepancy.system.structures import StructureModel
from fe.reduction.model_cache import changeable_model
from fe.runtime.patch import InterfaceCompliance, ModelPatch
from tests.discrepancy.rigs import chosen, setting_of, simulated

JOINT = """
[[interface]]
name = "joint"
parts = ["left", "right"]

[[material]]"""
HALVES = """set = [
    { name = "left", of = "cells", box = [[0, 0, 0], [50, 20, 10]] },
    { name = "right", of = "cells", box = [[50, 0, 0], [100, 20, 10]] },"""


@pytest.fixture(scope="module")
def jointed(write_beam, tmp_path_factory):
    """A beam of two halves that are joined at an interface."""
    changes = {"set = [": HALVES, "\n[[material]]": JOINT}
    file = write_beam(tmp_path_factory.mktemp("jointed"), changes, cells=2)
    return StructureModel(changeable_model(file))


def test_each_motion_of_an_interface_is_a_place_and_none_of_a_support(jointed) -> None:
    interface, support = chosen("interface_compliance", "support_compliance")
    setting = setting_of(simulated(jointed, "static", 3), jointed)
    axes = ("normal", "longer extent", "shorter extent")
    motions = ("shift along", "turn about")
    expected = [f"joint, {motion} its {axis}" for motion in motions for axis in axes]
    assert list(interface.places(setting)) == expected
    assert all(place.startswith("root, ") for place in support.places(setting))


def test_a_place_is_the_motion_of_its_primitive(jointed) -> None:
    (effect,) = chosen("interface_compliance")
    setting = setting_of(simulated(jointed, "static", 3), jointed)
    place = "joint, turn about its longer extent"
    (primitive,) = effect.patch(setting, {"compliance_share": 0.2}, place)
    assert isinstance(primitive, InterfaceCompliance)
    assert (primitive.interface, primitive.motion) == ("joint", "rs")
    # a fifth of the compliance that doubles that of the structure
    scale = setting.scales.support_compliances["joint", "rs"]
    assert primitive.compliance == pytest.approx(0.2 * scale)


def test_its_size_is_a_spring_in_words(jointed) -> None:
    compliance = PrimitiveInterval(0, "compliance", 1e-4, 8e-5, 1.25e-4, "m/N or rad/(N m)")
    patch = ModelPatch((InterfaceCompliance("joint", "rs", 1e-4),))
    text = si_sizes(patch, [compliance], jointed, simulated(jointed, "static", 3))
    turn = "the interface joint turns about its longer extent"
    assert text == f"{turn} against a spring of 10000 N m/rad (8000 to 12500)"
