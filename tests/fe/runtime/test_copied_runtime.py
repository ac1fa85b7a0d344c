"""The runtime as a folder that is copied into an FMU: what its files import. Packing runs the copy."""

import ast
import sys
from pathlib import Path

import fe.runtime

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
