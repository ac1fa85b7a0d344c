"""Small cases of what is compiled; as a program it writes the size and digest of the bytes of each.

    python -m tests.machine_code_cases LIBRARY BEAM FOLDER

The arguments are a strain library, the file of a structure, and an empty folder.
"""

import hashlib
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import expm

from discrepancy.estimation.kernel import (
    filter_record,
    smooth_record,
    smoothed_variances,
    substep_matrices_with_laws,
)
from discrepancy.trials_in_motion.steps import respond_to_inputs
from fe.reduction.reduced_basis import reduce_structure
from fe.structure.operators import load_and_assemble
from tests.command_line import said
from tests.twin_master.runs import of_library, text_of, written
from twin_master.mission.flights import fly_side_by_side
from twin_master.mission.journal import JOURNAL_NAME


@dataclass(frozen=True)
class Inputs:
    """Files that the cases need: a strain library, a structure, and a folder for a mission and its watch."""

    library: Path
    beam: Path
    folder: Path

    @property
    def scenario(self) -> Path:
        """Growing damage in a few steps, with few draws."""
        changes = (("steps = 50", "steps = 6"), ("draws = 100", "draws = 5"))
        return written(self.folder, text_of("growing_damage"), *changes)


def fleet(inputs: Inputs) -> bytes:
    """Return beliefs, evidence and notices of five twins that fly side by side."""
    knowledge, source = of_library("growing_damage", inputs.library)
    asset = source.open()
    truths = [knowledge.truth(seed) for seed in range(5)]
    flights = fly_side_by_side(knowledge, truths, [asset] * 5)
    arrays = (flights.filtered, flights.log_evidence, flights.unexplained)
    return b"".join(array.tobytes() for array in arrays) + repr(flights.notices).encode()


def stored(folder: Path) -> bytes:
    """Return the store and the journal of a run or watch."""
    return (folder / "run.nc").read_bytes() + (folder / JOURNAL_NAME).read_bytes()


def mission(inputs: Inputs) -> bytes:
    """Return what the command stores of a mission."""
    folder = inputs.folder / "run"
    said("run", inputs.scenario, "--strain-library", inputs.library, "--out", folder, "--no-report")
    return stored(folder)


def watch(inputs: Inputs) -> bytes:
    """Return what the command stores of a watch, which hears the mission."""
    folder, flown = inputs.folder / "watch", inputs.folder / "run"
    said("watch", inputs.scenario, "--observations", flown, "--out", folder, "--no-report")
    return stored(folder)


def estimator(inputs: Inputs) -> bytes:
    """Return the smoothed motion of an oscillator, whose spring and damper are a law at its port."""
    substeps, samples = 4, 8
    steps = substeps * (samples - 1)
    generator = np.array([[0.0, 1.0], [-4.0, -0.1]])
    direction, tangent = np.array([[0.0], [-1.0]]), np.array([[1.5, 0.3]])
    length = np.array([0.05])
    _, begin, end = respond_to_inputs(generator, length)
    drift = np.zeros((steps, 2, 1))
    transition, noise = substep_matrices_with_laws(
        substeps,
        np.zeros(samples, dtype=np.int64),
        expm(generator * length)[None],
        1e-3 * np.eye(2)[None],
        begin @ direction,
        end @ direction,
        np.repeat(tangent[None], steps + 1, axis=0),
        np.zeros((steps + 1, 1, 1)),
        drift,
    )
    rows = np.tile([10.0, 0.0], (samples, 1, 1))
    readings = np.random.default_rng(5).standard_normal((samples, 1, 1))
    is_used = np.ones((samples, 1), dtype=bool)
    kinds = np.arange(-1, steps)
    start = np.zeros((2, 1))
    innovations, gains, variances, means, covariances = filter_record(
        substeps, kinds, transition, noise, rows, readings, is_used, np.eye(2), start, True
    )
    steps = (substeps, kinds, transition, rows, is_used)
    motion = smooth_record(
        *steps,
        np.ascontiguousarray(innovations[:, :, 0]),
        gains,
        variances,
        np.ascontiguousarray(means[:, :, 0]),
        covariances,
    )
    variance = smoothed_variances(*steps, gains, variances, covariances)
    return motion.tobytes() + variance.tobytes()


def reduction(inputs: Inputs) -> bytes:
    """Return the reduced model of a structure."""
    return reduce_structure(load_and_assemble(inputs.beam)).model.to_bytes()


CASES: dict[str, Callable[[Inputs], bytes]] = {
    case.__name__: case for case in (fleet, mission, watch, estimator, reduction)
}

if __name__ == "__main__":
    given = Inputs(*map(Path, sys.argv[1:]))
    contents = {name: case(given) for name, case in CASES.items()}
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    results = {name: [len(contents[name]), digest] for name, digest in digests.items()}
    sys.stdout.write(json.dumps(results))
