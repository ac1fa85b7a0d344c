"""What to run: scenario files, bindings, models of assets and recordings, shipped as package data."""

from importlib import resources
from pathlib import Path

SCENARIO_FOLDER = Path(str(resources.files(__name__)))
BINDING_FOLDER = SCENARIO_FOLDER / "bindings"
ASSET_FOLDER = SCENARIO_FOLDER / "assets"
RECORDING_FOLDER = SCENARIO_FOLDER / "recordings"
STRUCTURE_FOLDER = SCENARIO_FOLDER / "structures"


def scenario_files() -> dict[str, Path]:
    """Return the shipped scenarios by name, in alphabetical order."""
    return {path.stem: path for path in sorted(SCENARIO_FOLDER.glob("*.toml"))}


def binding_files() -> dict[str, Path]:
    """Return the shipped bindings by name, in alphabetical order."""
    return {path.stem: path for path in sorted(BINDING_FOLDER.glob("*.toml"))}


def asset_scripts() -> dict[str, Path]:
    """Return the shipped model scripts by name, in alphabetical order."""
    return {path.stem: path for path in sorted(ASSET_FOLDER.glob("*.py")) if path.stem != "__init__"}


def recording_files() -> dict[str, Path]:
    """Return the shipped recordings of observations by name, in alphabetical order."""
    return {path.stem: path for path in sorted(RECORDING_FOLDER.glob("*.csv"))}


def structure_files() -> dict[str, Path]:
    """Return the shipped structures by name, in alphabetical order; their meshes lie beside them."""
    return {path.stem: path for path in sorted(STRUCTURE_FOLDER.glob("*.toml"))}
