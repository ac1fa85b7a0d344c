"""Writers and makers of structures on meshes of boxes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fe.elements.kinds import meshio_with_wedges
from fe.structure.operators import Structure, load_and_assemble
from tests.fe.structure.bodies import BODIES, bend_box, sets_of_box
from tests.meshes import box
from tests.refusals import Inputs

INPUTS = Inputs(__file__)


@pytest.fixture(scope="session")
def write_structure(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A writer of a structure file and its mesh; it returns the structure file."""

    def write(points: NDArray[np.float64], kind: str, cells: Any, text: str, **sets: Any) -> Path:
        folder = tmp_path_factory.mktemp("structure")
        meshio = meshio_with_wedges()
        meshio.write(folder / "mesh.vtu", meshio.Mesh(points, [(kind, cells)], **sets))
        file = folder / "structure.toml"
        file.write_text(text, encoding="utf-8")
        return file

    return write


@pytest.fixture(scope="session")
def make_structure(write_structure: Callable[..., Path]) -> Callable[..., Structure]:
    """A maker of one of `BODIES`, with texts exchanged in its file, and of other cells."""

    def make(
        name: str,
        *changes: tuple[str, str],
        kind: str | None = None,
        divisions: tuple[int, int, int] | None = None,
        **options: bool,
    ) -> Structure:
        body = BODIES[name]
        kind = kind or body.kind
        points, cells = box(kind, divisions or body.divisions)
        masks = sets_of_box(points)
        file = write_structure(
            bend_box(name, kind, points),
            kind,
            cells,
            INPUTS.text(f"{name}.toml", *changes),
            point_data={set_name: masks[set_name].astype(np.int64) for set_name in body.sets},
        )
        return load_and_assemble(file, **options)

    return make
