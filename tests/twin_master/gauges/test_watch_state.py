"""The state of the watch over gauges, and its arrays."""

import numba
import numpy as np
import pytest

from twin_master.gauges.hypothesis_weights import HypothesisWeights, MixedBelief
from twin_master.gauges.watch_state import WatchState

SENSORS, GAINS, DRAWS, STATES = 3, 4, 2, 5


@pytest.fixture
def state() -> WatchState:
    """A state of one twin before its first observation."""
    begins = np.log(np.full(1 + SENSORS * GAINS, 1.0 / (1 + SENSORS * GAINS)))
    weights = HypothesisWeights.initial(0.5, begins, 0, 2)
    model_belief = np.full((1, STATES * DRAWS), 1.0 / (STATES * DRAWS))
    state = WatchState.initial(model_belief, SENSORS, GAINS, weights)
    belief = np.full((1, STATES), 1.0 / STATES)
    state.mixed = MixedBelief(belief, belief, np.ones(1))
    return state


def test_loops_are_compiled_for_new_and_for_stored_states_alike(state):
    """Numba compiles a loop once for each kind of arrays; a strided array is another kind."""
    stored_arrays = state.as_arrays(np.array([1], dtype=np.uint64))
    restored = WatchState.from_arrays(stored_arrays, (SENSORS, GAINS, DRAWS, STATES))
    assert numba.typeof(restored.beliefs) == numba.typeof(state.beliefs)
    assert numba.typeof(restored.free_gain_statistics) == numba.typeof(state.free_gain_statistics)
