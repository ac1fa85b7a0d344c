"""A campaign with every kind of trial on a cantilever that can carry every primitive."""

import pytest

from benchmarks.cantilever import Cantilever, campaign
from discrepancy.catalogue.entry import Setting
from tests.discrepancy.rigs import setting_of


@pytest.fixture(scope="session")
def setting() -> Setting:
    given, model = campaign(), Cantilever()
    return setting_of(given, model)
