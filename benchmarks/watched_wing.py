"""Record the shipped mission: a gauge comes loose, then skin softens outside the regions.

`python -m benchmarks.watched_wing` makes `scenarios/recordings/watched_wing.csv` again, bit for bit
from its seed. The wing is the full finite element model with a third region and an e of its own;
the controls are those of the twin of the scenario `watched_wing`, which sees nothing but the
gauges.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from fe.reduction.model_cache import reduced_model
from fe.structure.affine import static_response
from fe.wing.design import load_design
from fe.wing.operators import assemble, wing_values
from reporting.files import atomic_write_text
from scenarios import RECORDING_FOLDER
from twin_master.assets.asset_source import AssetReading, StatelessAsset
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.mission.flights import fly
from twin_master.mission.preparation import prepare_knowledge
from twin_master.scenario.reading import load_scenario

Float = NDArray[np.float64]

NAME = "watched_wing"
SEED = 25
STEPS = 60
YOUNG_MODULUS_FACTOR = 0.97
NOISE = 150e-6
THIRD_REGION = {"span_start": 0.5, "span_end": 0.9, "chord_start": 0.03, "chord_end": 0.6}
"""Upper skin between the two regions of the twin's model [m, fraction of the chord]."""
LOOSE_GAUGE = 4
LOOSE_FROM = 10
LOOSER = 0.1
LOOSEST = 0.3
"""Gauge, first step, and the gain that it loses in each step until it has lost so much."""
SOFT_FROM = 25
SOFTER = 0.025
SOFTEST = 0.3
"""First step, loss of stiffness of the third region per step, and its largest loss."""
DAMAGE = {"z1": {20: 0.2}, "z2": {5: 0.2}}
"""Losses of the two regions of the model, from a step on."""


class _Wing:
    """The true wing: full finite elements, three regions, a gauge that comes loose."""

    def __init__(self) -> None:
        design = load_design()
        defects = [*(defect.model_dump() for defect in design.defects), THIRD_REGION]
        self._operators = assemble(design.changed(defects=defects))
        self._step = 0
        self._strain = cache(self._solved)

    def _solved(self, health: tuple[float, ...]) -> Float:
        values = wing_values(self._operators, YOUNG_MODULUS_FACTOR, health, load_factor=1.0)
        return static_response(self._operators, values).strain

    def observe(self, control: object, health: object) -> AssetReading:
        """Return the strains of the next step."""
        step = self._step
        self._step += 1
        soft = round(min(SOFTER * max(step - SOFT_FROM + 1, 0), SOFTEST), 6)
        strain = control["load_factor"] * self._strain((health["z1"], health["z2"], soft))  # type: ignore[index]
        loose = min(LOOSER * max(step - LOOSE_FROM + 1, 0), LOOSEST)
        gain = np.where(np.arange(strain.size) == LOOSE_GAUGE - 1, 1.0 - loose, 1.0)
        return AssetReading(strain * gain, {})


def recorded() -> str:
    """Return the recording as CSV."""
    loaded = load_scenario(NAME).scenario
    gains = [
        {"state": name, "first_step": step, "gain": gain}
        for name, steps in DAMAGE.items()
        for step, gain in steps.items()
    ]
    table = loaded.to_dict()
    table["mission"] |= {"steps": STEPS, "seed": SEED}
    table["truth"] = {"kind": "scripted", "gains": gains, "noise": {"standard_deviation": NOISE}}
    scenario = type(loaded).model_validate(table)
    knowledge = prepare_knowledge(
        scenario, ReducedModelSource(scenario, reduced_model(load_design())), SEED
    )
    flight = fly(
        scenario,
        knowledge.twin(),
        knowledge.plant(knowledge.truth(SEED), StatelessAsset(_Wing().observe)),
    )
    lines = ["step,control," + ",".join(f"strain_{g}_microstrain" for g in range(1, 25))]
    for step, (row, control) in enumerate(zip(flight.observed, flight.control_index, strict=True)):
        cells = ",".join(f"{1e6 * value:.1f}" for value in row)
        lines.append(f"{step},{scenario.control_names[control]},{cells}")
    return "\n".join(lines) + "\n"


def main() -> int:
    print(atomic_write_text(RECORDING_FOLDER / f"{NAME}.csv", recorded()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
