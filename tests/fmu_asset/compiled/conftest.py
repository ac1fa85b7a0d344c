"""A compiled wing of FMI 2 in this process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.fmu_asset.slaves.slave import Slave


@pytest.fixture
def slave(compiled_fmu: Path) -> Iterator[Slave]:
    with closing(Slave(compiled_fmu)) as made:
        yield made
