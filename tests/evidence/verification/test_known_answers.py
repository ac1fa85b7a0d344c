import numpy as np
import pytest

from evidence.verification import calculix_examples as examples
from evidence.verification import known_answers as answers
from evidence.verification.__main__ import element_checks, ring_down_checks
from fe.wing.design import load_design
from fe.wing.operators import assemble
from tests.calculix_decks import needs_calculix


def test_every_known_answer_is_met():
    checks = list(element_checks())
    assert [check.name for check in checks if not check.passed] == []
    assert {check.group for check in checks} == {
        "patch test", "unsupported body", "cantilever", "MacNeal-Harder",
    }  # fmt: skip
    assert answers.rigid_body_values()[6] > 1e-6


def test_a_cantilever_converges_to_timoshenkos_beam():
    coarse, middle, fine = (abs(answers.cantilever_check(cells)) for cells in (5, 10, 20))
    assert fine < middle < coarse < 0.01
    assert 2.5 < np.log2(coarse / middle) < 4.5  # the tip of a quadratic element: third to fourth order


@pytest.mark.skipif(not examples.DECKS.is_dir(), reason="Debian's calculix-ccx-test is not installed")
@pytest.mark.parametrize("name", examples.NAMES)
def test_decks_of_calculix_give_its_published_results(name, tmp_path):
    assert examples.published_difference(name, tmp_path) < 1e-6


@pytest.mark.long
@needs_calculix
def test_a_ring_down_agrees(tmp_path):
    coarse = assemble(load_design().changed(mesh={"refinement": 0.25}))
    direct, same_rule = ring_down_checks(coarse, tmp_path, 0.125)
    assert direct.passed
    assert same_rule.value < 3e-4  # what is left is not the time integration
