"""Structures on small meshes made by hand."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fe.elements.kinds import meshio_with_wedges


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """A writer of a structure file and its mesh; returns the structure file."""

    def make(points: NDArray[np.float64], kind: str, cells: Any, text: str, **sets: Any) -> Path:
        meshio = meshio_with_wedges()
        meshio.write(tmp_path / "mesh.vtu", meshio.Mesh(points, [(kind, cells)], **sets))
        file = tmp_path / "structure.toml"
        file.write_text(text, encoding="utf-8")
        return file

    return make
