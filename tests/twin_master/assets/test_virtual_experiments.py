"""The wing FMU on the test bench against the reduced model on the same bench."""

import numpy as np
import pytest

from calibration.virtual_wing import VirtualWing, measure_load_test, measure_ring_down
from fe.runtime.state import DigitalState
from fmu_asset.errors import FmuError
from fmu_asset.packing.structure_fmu import build_fmu
from twin_master.assets.virtual_experiments import FmuTestBench

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wing")]

TRUTH = DigitalState(
    young_modulus_factor=0.991,
    servo_mass=0.181,
    pitot_mass=0.108,
    damping_alpha=0.9,
    damping_beta=6e-4,
    stiffness_loss=(0.1, 0.0),
)


def test_the_fmu_is_measured_as_the_model_is(wing, tmp_path):
    fmu = build_fmu(wing, tmp_path / "wing.fmu").path
    model = VirtualWing(wing, TRUTH)
    with FmuTestBench(fmu, TRUTH) as bench:
        ours, theirs = measure_load_test(model, 7), measure_load_test(bench, 7)
        np.testing.assert_allclose(theirs.displacement, ours.displacement, rtol=1e-12)
        settings = {"trials": 2, "duration": 0.5, "sampling_rate": 500.0, "noise": 0.0}
        pairs = zip(
            measure_ring_down(model, 7, **settings), measure_ring_down(bench, 7, **settings), strict=True
        )
        for expected, seen in pairs:
            np.testing.assert_array_equal(seen.time, expected.time)
            scale = np.abs(expected.signal).max()
            np.testing.assert_allclose(seen.signal, expected.signal, atol=1e-10 * scale)
    heavy = DigitalState(servo_mass=2.0)
    with pytest.raises(FmuError, match="servo_mass"), FmuTestBench(fmu, heavy) as bench:
        bench.tip_displacement(1.0)
