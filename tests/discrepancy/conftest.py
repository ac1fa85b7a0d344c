"""The beam of `write_beam` as a model of campaigns: a structure with the damage regions z1 and z2."""

from collections.abc import Callable
from pathlib import Path

import pytest

from discrepancy.model_choice import choose_model
from discrepancy.system.interface import Model


@pytest.fixture(scope="session")
def beam_file(write_beam: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The structure file of the beam."""
    return write_beam(tmp_path_factory.mktemp("beam_with_regions"))


@pytest.fixture(scope="session")
def beam_model(beam_file: Path) -> Model:
    """The beam as a model of campaigns."""
    return choose_model(beam_file).model
