"""Gauges that a structure might have: beside those that its file declares, for the choice of the best."""

import json
from pathlib import Path

from fe.runtime.errors import InvalidDesignError
from fe.structure.design import Gauge, Gauged, MeshDesign, load_structure, parse_structure
from fe.structure.location import gauge_rows, spread_rosettes
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import read_mesh
from reporting.toml_file import checked, read_toml
from twin_master.assets.asset_source import keep_files, read_files
from twin_master.assets.structure_source import MODEL_COPY, StructureBelief
from twin_master.errors import MissionInputError, said
from twin_master.scenario.schema import Scenario

__all__ = ["with_candidates"]


def with_candidates(scenario: Scenario, candidates: str, folder: Path) -> Scenario:
    """Return a scenario whose structure has more gauges, which are sensors.

    In their order they stand behind the gauges that the file had and before those of its rosettes.

    Parameters
    ----------
    scenario : Scenario
        Its paths absolute.
    candidates : str
        At most how many rosettes are spread over the surface, or a TOML file with tables `gauge` and
        `rosette` as a structure file has them.
    folder : Path
        Where the structure file with the gauges is put.

    Raises
    ------
    MissionInputError
        What is believed is no structure from a mesh, the sensors are no strain gauges that are all alike, no
        place is asked for, or the structure file has its gauges in a list.
    InvalidDesignError
        The candidates are wrong; the sentence names the place.
    """
    observation, belief = scenario.observation, scenario.belief
    alike = (observation.standard_deviation, observation.model_error, scenario.rewards.error_scale)
    if any(isinstance(one, tuple) for one in alike) or observation.role != "strain":
        raise MissionInputError("--candidates needs strain gauges of one standard deviation and error scale.")
    own = isinstance(belief, StructureBelief) and load_structure(belief.all_files()[MODEL_COPY])
    if not isinstance(belief, StructureBelief) or not isinstance(own, MeshDesign):
        raise MissionInputError("--candidates needs a structure from a mesh as what is believed.")
    if candidates.isdecimal() and not int(candidates):
        raise MissionInputError("--candidates needs at least one place.")
    keep_files(folder, read_files(belief.all_files()))
    file = folder / MODEL_COPY
    source = Path(belief.all_files()[MODEL_COPY]).parent / own.mesh  # this one stays
    mesh = read_mesh(source, own.unit, own.length_unit)
    gauges = _gauges(candidates, mesh)
    with file.open("a", encoding="utf-8") as text:
        for gauge in gauges:
            rows = (f"{key} = {json.dumps(value)}\n" for key, value in gauge.model_dump().items())
            text.write("".join(("\n[[gauge]]\n", *rows)))
    before, names = ([part.name for part in design.gauge] for design in (own, _joined(file, candidates)))
    try:
        gauge_rows(mesh, gauges)
    except InvalidDesignError as error:
        raise InvalidDesignError(f"--candidates {candidates}: {error}") from error
    known = dict(zip(before, observation.titles or before, strict=True))
    chosen, titles = scenario.rewards.health_sensors, tuple(known.get(name, name) for name in names)
    limited = range(1, len(before) + 1) if chosen == "all" else chosen
    health = tuple(names.index(before[number - 1]) + 1 for number in limited)
    return scenario.model_copy(
        update={
            "belief": belief.model_copy(update={"structure": str(file)}),
            "observation": observation.model_copy(update={"count": len(names), "titles": titles}),
            "rewards": scenario.rewards.model_copy(update={"health_sensors": health}),
            "learning": None,
            "notice": None,
        }
    )


def _joined(file: Path, candidates: str) -> MeshDesign:
    """Return the structure with the gauges; its file is a copy, so that what is wrong names the option."""
    try:
        content = read_toml(file, InvalidDesignError)
    except InvalidDesignError as error:  # it could be read before
        raise MissionInputError(said("assets.candidates")) from error
    design = parse_structure(content, f"--candidates {candidates}")
    assert isinstance(design, MeshDesign)
    return design


def _gauges(candidates: str, mesh: StructureMesh) -> tuple[Gauge, ...]:
    if candidates.isdecimal():
        spread = spread_rosettes(mesh, int(candidates))
        return tuple(gauge for one in spread for gauge in one.gauges())
    content = read_toml(candidates, InvalidDesignError)
    found = checked(Gauged, content, candidates, InvalidDesignError, what="a file of gauges").gauge
    if not found:
        raise InvalidDesignError(f"{candidates}: a table [[gauge]] or [[rosette]] is expected.")
    return found
