"""FMUs of model exchange among others in a system: solved by us, coupled as any."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component, Setting
from fmu_asset.errors import FmuUnsupportedError

from .conftest import system, watch


def test_two_decays_in_a_row_are_the_recursion_of_held_inputs(foreign_fmu: Any) -> None:
    """x' = u - k x of FMI 1.0, the second fed by the first: exact between the moments of exchange."""
    fmu, step, slow = foreign_fmu("decay1"), 0.25, 0.5
    second = Component("second", fmu, {"k": Setting(slow)}, interface="model-exchange")
    chain = system([Component("first", fmu), second], [("first.x", "second.u")])
    x = y = 1.0
    binding = watch("first.x", "second.x", step_size=step)
    binding = binding.model_copy(update={"binding": binding.binding.model_copy(update={"tolerance": 1e-10})})
    with CoupledAsset(chain, binding) as asset:
        for _ in range(8):
            seen = asset.step().values
            x *= np.exp(-step)
            y = y * np.exp(-slow * step) + x * (1.0 - np.exp(-slow * step)) / slow
            np.testing.assert_allclose(seen, [x, y], rtol=1e-8)


def test_an_interface_that_an_fmu_has_not_is_refused(foreign_fmu: Any) -> None:
    only = Component("ball", foreign_fmu("ball2"), interface="co-simulation")
    with pytest.raises(FmuUnsupportedError, match=r"offers model-exchange only, but .* for co-simulation"):
        CoupledAsset(system([only], []), watch("ball.h"))
