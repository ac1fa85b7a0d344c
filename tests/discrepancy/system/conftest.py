import pytest

from fe.reduction.reduced_basis import reduce_structure
from fe.structure.operators import load_and_assemble


@pytest.fixture(scope="session")
def pushed_beam(write_beam, tmp_path_factory):
    """The structure file of a beam that is pushed at a point, which is a port, and its reduced model."""
    place = {'set = "end", force': "point = [100, 10, 5], force"}
    file = write_beam(tmp_path_factory.mktemp("pushed"), place, cells=2)
    return file, reduce_structure(load_and_assemble(file)).model
