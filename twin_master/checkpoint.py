"""The checkpoint of a mission: what cannot be computed again.

That is what was observed, what was commanded, what really happened, and the state of the asset. The twin's
beliefs follow from the observations; they are computed again on resuming, and the decisions must come out as
they were taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reporting.errors import DamagedFileError
from reporting.files import read_npz, write_npz
from twin_master.errors import NotResumableError
from twin_master.plant import PlantRecord

Float = NDArray[np.float64]
Index = NDArray[np.int64]

CHECKPOINT_NAME = "checkpoint.npz"
_MONITOR = "monitor."


@dataclass(frozen=True)
class Checkpoint:
    """A mission after t turns.

    Attributes
    ----------
    config_hash : str
        SHA-256 of the configuration that the mission belongs to.
    observed : (t, G)
        What the sensors said, SI.
    control_index : (t + 1,)
        Controls flown, and the one decided for the next turn.
    plant : PlantRecord
        What really happened.
    asset_state : bytes
        State of the asset after the last turn.
    """

    config_hash: str
    observed: Float
    control_index: Index
    plant: PlantRecord
    asset_state: bytes

    @property
    def turns(self) -> int:
        """Number of turns flown."""
        return len(self.observed)


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint of a run folder in one step.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written; the checkpoint of the turn before is still there.
    """
    arrays = {
        "config_hash": np.array(checkpoint.config_hash),
        "observed": checkpoint.observed,
        "control_index": checkpoint.control_index,
        "state": checkpoint.plant.state,
        "observation": checkpoint.plant.observation,
        "asset_state": np.frombuffer(checkpoint.asset_state, dtype=np.uint8),
    }
    arrays |= {_MONITOR + name: values for name, values in checkpoint.plant.monitors.items()}
    write_npz(folder / CHECKPOINT_NAME, arrays)


def read_checkpoint(folder: Path, config_hash: str) -> Checkpoint | None:
    """Return the checkpoint of a run folder; None if no turn was finished.

    Raises
    ------
    NotResumableError
        The checkpoint is damaged, or belongs to another configuration.
    """
    path = folder / CHECKPOINT_NAME
    if not path.exists():
        return None
    try:
        arrays = read_npz(path)
        checkpoint = Checkpoint(
            config_hash=str(arrays["config_hash"]),
            observed=arrays["observed"],
            control_index=arrays["control_index"],
            plant=PlantRecord(
                state=arrays["state"],
                observation=arrays["observation"],
                monitors={
                    name.removeprefix(_MONITOR): values
                    for name, values in arrays.items()
                    if name.startswith(_MONITOR)
                },
            ),
            asset_state=arrays["asset_state"].tobytes(),
        )
    except (DamagedFileError, KeyError) as error:
        raise NotResumableError(
            f"the checkpoint {path} cannot be read ({error}): fly the mission again with --replace."
        ) from error
    if checkpoint.config_hash != config_hash:
        raise NotResumableError(
            f"the checkpoint {path} belongs to another configuration than the config.json beside it: "
            "fly the mission again with --replace."
        )
    return checkpoint
