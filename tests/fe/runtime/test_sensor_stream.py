"""Sensors sample by sample against whole records, and the chain of filters against its definition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from discrepancy.models.high_pass import filtered_record, high_pass
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import (
    DecayingLine,
    HighPass,
    Line,
    ModelPatch,
    SensorDrift,
    SensorGain,
    SensorRotation,
    ThermalStrain,
)
from fe.runtime.sensors import FilterMemory, SensorRecord, apply_sensors, high_pass_step

CHANNELS = (("strain[1]", "strain"), ("strain[2]", "strain"), ("tip_displacement", "displacement"))
PATCH = ModelPatch(
    (
        SensorGain("strain[1]", 0.07),
        HighPass("strain[1]", 0.4, 2.0),
        SensorDrift("*", 2e-5, 10.0, 0.5, "strain"),
        HighPass("*", 0.9, 1.0, "strain"),
        ThermalStrain("*", 1.2e-5),
        Line("tip_displacement", 50.0, 1e-4, -2e-4),
        DecayingLine("*", 7.0, 0.02, 1e-3, 2e-3, "strain"),
        SensorRotation("strain[2]", 0.2),
    )
)


@pytest.mark.parametrize("kind", ["ringdown", "flight"])
def test_samples_are_the_rows_of_the_whole_record(kind: str) -> None:
    generator = np.random.default_rng(3)
    count, interval, start = 60, 0.01, 4.0
    values, across, shear = (1e-4 * generator.normal(size=(count, 3)) for _ in range(3))
    temperature = generator.normal(size=count)
    dynamic = kind == "ringdown"
    since = interval * np.arange(count)
    record = SensorRecord(
        CHANNELS, kind, since if dynamic else start + since, start, temperature, release=0.05
    )
    expected, _ = apply_sensors(PATCH, record, values, None, across, shear, filtered=filtered_record)
    memory = None
    shown = []
    for row in range(count):
        one = replace(record, time=record.time[row : row + 1], temperature=temperature[row : row + 1])
        filters = FilterMemory(memory, interval)
        parts = (part[row : row + 1] for part in (across, shear))
        (read,), _ = apply_sensors(PATCH, one, values[row : row + 1], None, *parts, filtered=filters.filtered)
        memory = filters.after
        shown.append(read)
        assert len(memory) == (7 if dynamic else 0)  # signal and stages: 3 of one gauge, then 2 of each gauge
    np.testing.assert_allclose(shown, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


@settings(max_examples=40, deadline=None)
@given(
    order=st.integers(1, 4), ratio=st.floats(1e-9, 50.0), pieces=st.integers(1, 7), step=st.floats(-3.0, 3.0)
)
def test_a_change_in_pieces_is_the_change_at_once(order: int, ratio: float, pieces: int, step: float) -> None:
    states = np.linspace(1.0, -0.5, order)
    at_once = high_pass_step(states, step, ratio)
    parts = states
    for _ in range(pieces):
        parts = high_pass_step(parts, step / pieces, ratio / pieces)
    np.testing.assert_allclose(parts, at_once, rtol=0.0, atol=1e-11)


def test_filter_is_that_of_whole_records() -> None:
    signal = np.random.default_rng(5).normal(size=200).cumsum()
    for order in (1, 2, 3, 4):
        states, shown = np.zeros(order), [0.0]
        for increment in np.diff(signal):
            states = high_pass_step(states, increment, 0.13)
            shown.append(states[-1])
        expected = high_pass(signal, 0.13, 1.0, float(order), signal[0])
        np.testing.assert_allclose(shown, expected, atol=1e-11)


@pytest.mark.parametrize("item", [HighPass("*", 0.0), HighPass("*", 1.0, 1.5), HighPass("*", 1.0, 5.0)])
def test_filters_that_cannot_be_remembered_are_refused(item: HighPass) -> None:
    record = SensorRecord(CHANNELS, "ringdown", np.zeros(1), 0.0, np.zeros(1))
    with pytest.raises(InvalidPatchError, match="sample by sample"):
        FilterMemory(None, 0.1).filtered(item, record, np.zeros((1, 2)), np.zeros((1, 2)))
