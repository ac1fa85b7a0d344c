"""Commands of benchmarks and evidence: each answers `--help`; each study names the page of its figures."""

import ast
import inspect
import re
from importlib import import_module
from pathlib import Path

import pytest

import benchmarks.studies

ROOT = Path(__file__).parents[2]


def modules_with_options() -> list[str]:
    """Return the names of the modules that read a command line by argparse."""
    files = [*sorted((ROOT / "benchmarks").rglob("*.py")), *sorted((ROOT / "evidence").rglob("*.py"))]
    return [
        ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for file in files
        if "ArgumentParser(" in file.read_text(encoding="utf-8")
    ]


@pytest.mark.parametrize("name", modules_with_options())
def test_a_command_answers_help(name, monkeypatch, capsys):
    main = import_module(name).main
    monkeypatch.setattr("sys.argv", [name, "--help"])
    arguments = [["--help"]] if inspect.signature(main).parameters else []
    with pytest.raises(SystemExit) as ended:
        main(*arguments)
    assert ended.value.code == 0
    assert "usage:" in capsys.readouterr().out


def studies() -> list[Path]:
    """Return the files of the studies that are commands."""
    folder = Path(benchmarks.studies.__file__).parent
    return [file for file in sorted(folder.rglob("*.py")) if "__main__" in file.read_text(encoding="utf-8")]


def command_name(file: Path) -> str:
    """Return the name of a study: that of its file, or of its folder."""
    return file.parent.name if file.stem == "__main__" else file.stem


@pytest.mark.parametrize("file", studies(), ids=command_name)
def test_a_study_names_the_page_of_its_figures_and_the_page_names_its_command(file):
    docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8")))
    assert docstring is not None
    pages = re.findall(r"docs/[\w/]+\.md", docstring)
    assert pages
    for page in pages:
        assert f"python -m benchmarks.studies.{command_name(file)}" in (ROOT / page).read_text(
            encoding="utf-8"
        )
