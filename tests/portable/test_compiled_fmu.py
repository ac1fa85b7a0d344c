"""A compiled FMU on the system that runs the tests, made there by zig, with the reduced model as oracle."""

import platform

import numpy as np
import pytest
from fmpy import simulate_fmu

from tests.portable.test_portable import NATIVE, ran
from uav_twin import reduced_model

pytestmark = [pytest.mark.portable, pytest.mark.slow]
FOLDER_OF_SYSTEM = {"Linux": "linux64", "Windows": "win64", "Darwin": "darwin64"}


def test_a_compiled_fmu_that_zig_makes_flies_on_this_system(tmp_path):
    pytest.importorskip("ziglang")
    folder = FOLDER_OF_SYSTEM[platform.system()]
    options = ("--kind", "compiled", "--platforms", folder, "--out", "wing.fmu")
    ran(tmp_path, "fmu", "build", *options, module=NATIVE)
    gauges = [f"strain[{number}]" for number in range(1, 25)]

    flight = simulate_fmu(
        tmp_path / "wing.fmu",
        stop_time=1.0,
        output_interval=1.0,
        output=gauges,
        start_values={"load_factor": 3.0, "health.z1": 0.2},
    )

    expected = reduced_model().static_response({"load_factor": 3.0, "z1": 0.2}).strain
    np.testing.assert_allclose([flight[-1][name] for name in gauges], expected, rtol=1e-9)
