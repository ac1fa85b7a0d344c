"""Splitting a motion into its modes."""

from __future__ import annotations

import numpy as np
import pytest

from discrepancy.location.dependence import modal_motion


def test_two_damped_modes_are_split_up_to_the_ends() -> None:
    time = 0.005 * np.arange(800)
    waves = []
    for f, zeta, size in ((5.3, 0.02, 1.0), (28.0, 0.01, 0.4)):
        w = 2.0 * np.pi * f
        waves.append(size * np.exp((-zeta + 1j) * w * time))
    values = (waves[0] + waves[1]).real[:, np.newaxis] + 0.3
    found = modal_motion(values, 0.005, (5.2, 28.3))
    assert found is not None
    for mode, wave in enumerate(waves):
        size = np.abs(wave)
        for part, exact in zip(found, (wave.real, -wave.imag, size), strict=True):
            error = np.abs(part[mode, :, 0] - exact) / size[0]
            # Frequencies are 1 to 2 % off, and at the ends a window looks to one side only.
            assert error.max() < 0.08
            assert error[80:-80].max() < 0.03


@pytest.mark.parametrize("frequencies", [(), (5.0, 120.0), (5.0, 5.01), (0.01,)])
def test_what_cannot_be_split_is_none(frequencies: tuple[float, ...]) -> None:
    assert modal_motion(np.ones((100, 1)), 0.005, frequencies) is None
