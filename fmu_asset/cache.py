"""Wing FMUs by their content: built once, found again by hash, never stale."""

from __future__ import annotations

import os
from pathlib import Path

from fe.cache import cache_folder
from fe.reduced import ReducedModel
from fe.state import DigitalState

from .build import FmuInfo, build_fmu, content_info


def wing_fmu(
    model: ReducedModel, state: DigitalState | None = None, *, folder: str | os.PathLike[str] | None = None
) -> FmuInfo:
    """Return the FMU of a model and state, from the cache if it is there and sound.

    Parameters
    ----------
    model : ReducedModel
        The wing.
    state : DigitalState, optional
        Start values; see `build_fmu`.
    folder : path-like, optional
        Folder of the cache; `uav-twin/fmu` in `$XDG_CACHE_HOME` or `~/.cache` if absent.

    Returns
    -------
    FmuInfo
        The FMU; its file name is its model identifier.
    """
    place = Path(folder) if folder is not None else cache_folder() / "fmu"
    content, info = content_info(model, state, place)
    # Comparing the bytes costs less than trusting the name: a kill or a full disk may have been here.
    if info.path.is_file() and info.path.read_bytes() == content:
        return info
    return build_fmu(model, info.path, state=state, replace=True)
