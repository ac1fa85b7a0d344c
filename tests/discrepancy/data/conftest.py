"""A cantilever that flies, is pulled and is let go, for campaigns with faults."""

import pytest

from benchmarks.cantilever import Cantilever


@pytest.fixture(scope="session")
def cantilever():
    return Cantilever()
