"""Sources of `fe`: compiled loops are kept by them, and those of the runtime import little."""

import ast
import importlib.util
import sys
from pathlib import Path

import numba
import pytest

import fe
import fe.runtime
from fe.compilation import compiled


def test_without_a_folder_for_the_cache_it_still_compiles(monkeypatch):
    assert compiled(lambda value: 2.0 * value)(3.0) == 6.0
    njit, asked = numba.njit, []

    def no_folder(**options):
        asked.append(options)
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(numba, "njit", no_folder)
    assert compiled(lambda value: 2.0 * value)(3.0) == 6.0
    assert [options.get("cache", False) for options in asked] == [True, False]


INNER = (
    "from fe.compilation import compiled\nSTEP = {step}\n@compiled\ndef inner(x):\n    return x + {added}\n"
)
OUTER = (
    "from fe.compilation import compiled\nfrom inner import STEP, inner\n"
    "@compiled\ndef outer(x):\n    return STEP * inner(x)\n"
)


@pytest.mark.parametrize("change", [{"added": 5.0}, {"step": 7.0}])
def test_loops_are_kept_by_content_and_a_changed_source_never_meets_old_ones(tmp_path, monkeypatch, change):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kept"))

    def outer(**numbers: float) -> tuple[float, int]:
        """Write both modules; return what the outer gives for 1, and how often it compiled."""
        (tmp_path / "inner.py").write_text(INNER.format_map({"step": 1.0, "added": 1.0} | numbers))
        (tmp_path / "outer.py").write_text(OUTER)
        for name in ("inner", "outer"):
            specification = importlib.util.spec_from_file_location(name, tmp_path / f"{name}.py")
            assert specification is not None
            assert specification.loader is not None
            module = importlib.util.module_from_spec(specification)
            monkeypatch.setitem(sys.modules, name, module)
            specification.loader.exec_module(module)
        return module.outer(1.0), sum(module.outer.stats.cache_misses.values())

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    assert outer() == (2.0, 1)
    assert outer() == (2.0, 0)
    changed = change.get("step", 1.0) * (1.0 + change.get("added", 1.0))
    assert outer(**change) == (changed, 1)
    assert outer() == (2.0, 0)


# ---------------------------------------------------------------- the runtime

PACKAGE = Path(fe.runtime.__file__).parent


def test_runtime_files_import_only_numpy_the_standard_library_and_each_other():
    files = sorted(PACKAGE.rglob("*.py"))
    assert len(files) > 15
    for name in files:
        for node in ast.walk(ast.parse(name.read_text(encoding="utf-8"))):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                assert node.level <= len(name.relative_to(PACKAGE).parts), name
                modules = [str(node.module)] if node.level == 0 else []
            assert {module.split(".")[0] for module in modules} <= {"numpy", *sys.stdlib_module_names}, name
