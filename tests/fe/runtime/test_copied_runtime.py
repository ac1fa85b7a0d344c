"""The runtime as a folder that is copied into an FMU: what it imports, and the same numbers elsewhere."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

import fe.runtime
from fe.runtime.reduced import ReducedModel

PACKAGE = Path(fe.runtime.__file__).parent


def test_runtime_files_import_only_numpy_the_standard_library_and_each_other() -> None:
    files = sorted(PACKAGE.rglob("*.py"))
    assert len(files) > 15
    for name in files:
        for node in ast.walk(ast.parse(name.read_text(encoding="utf-8"))):
            modules = []
            if isinstance(node, ast.Import):
                modules = [alias.name.split(".")[0] for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                modules = [str(node.module).split(".")[0]]
            elif isinstance(node, ast.ImportFrom):
                assert node.level <= len(name.relative_to(PACKAGE).parts), name
            assert set(modules) <= {"numpy", *sys.stdlib_module_names}, name


def test_copied_runtime_evaluates_the_same_without_this_package(model: ReducedModel, tmp_path: Path) -> None:
    folder = tmp_path / "copy_of_the_runtime"
    shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "wing.npz").write_bytes(model.to_bytes())
    code = (
        "import sys; sys.path.insert(0, '.')\n"
        "from copy_of_the_runtime import transient, reduced\n"
        "model = reduced.ReducedModel.load('wing.npz')\n"
        "response = model.static_response({'z1': 0.1, 'z2': 0.2, 'load_factor': 3.0})\n"
        "assert not {'scipy', 'pymor', 'skfem', 'fe'} & set(sys.modules)\n"
        "print(*(x.hex() for x in response.strain.tolist()))\n"
    )
    result = subprocess.run(
        [sys.executable, "-I", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    strain = [float.fromhex(word) for word in result.stdout.split()]
    here = model.static_response({"z1": 0.1, "z2": 0.2, "load_factor": 3.0})
    np.testing.assert_allclose(strain, here.strain, rtol=1e-12)
