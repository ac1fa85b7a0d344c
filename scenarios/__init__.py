"""Scenarios, bindings, models of assets and recordings, shipped as package data."""

from pathlib import Path

SCENARIO_FOLDER = Path(__file__).parent
BINDING_FOLDER = SCENARIO_FOLDER / "bindings"
ASSET_FOLDER = SCENARIO_FOLDER / "assets"
RECORDING_FOLDER = SCENARIO_FOLDER / "recordings"
STRUCTURE_FOLDER = SCENARIO_FOLDER / "structures"


def _files_by_name(folder: Path, pattern: str) -> dict[str, Path]:
    """Return the files of a folder by their names without suffix, in alphabetical order."""
    return {path.stem: path for path in sorted(folder.glob(pattern))}


def scenario_files() -> dict[str, Path]:
    """Return the shipped scenarios by name, in alphabetical order."""
    return _files_by_name(SCENARIO_FOLDER, "*.toml")


def binding_files() -> dict[str, Path]:
    """Return the shipped bindings by name, in alphabetical order."""
    return _files_by_name(BINDING_FOLDER, "*.toml")


def asset_scripts() -> dict[str, Path]:
    """Return the shipped model scripts by name, in alphabetical order."""
    scripts = _files_by_name(ASSET_FOLDER, "*.py")
    del scripts["__init__"]
    return scripts


def recording_files() -> dict[str, Path]:
    """Return the shipped recordings of observations by name, in alphabetical order."""
    return _files_by_name(RECORDING_FOLDER, "*.csv")


def structure_files() -> dict[str, Path]:
    """Return the shipped structures by name, in alphabetical order; meshes lie beside them."""
    return _files_by_name(STRUCTURE_FOLDER, "*.toml")
