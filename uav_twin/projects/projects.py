"""All kinds of projects by name."""

from pathlib import Path

from uav_twin.projects.fmu import fmu_project
from uav_twin.projects.mesh import mesh_project
from uav_twin.projects.project import Project
from uav_twin.projects.rig import rig_project
from uav_twin.projects.stream import stream_project

_PROJECTS = {
    "mesh": mesh_project,
    "fmu": fmu_project,
    "rig": rig_project,
    "stream": stream_project,
}


def make_project(kind: str, name: str, file: Path | None) -> Project:
    """Return a project of a kind, with the user's file in it if one is given."""
    return _PROJECTS[kind](name, file)
