"""A test bench in closed form, in the place of a virtual wing."""

from calibration import virtual_wing
from tests.calibration.decays import free_decay

BEAM_STIFFNESS = 680.0
"""Force over displacement at the tip [N/m]."""


class Beam:
    """A beam with a linear load test and two modes."""

    def tip_displacement(self, load):
        return load / BEAM_STIFFNESS

    def ring_down(self, initial_tip_displacement, duration, rate):
        time = virtual_wing.sampling_times(duration, rate)
        signal = free_decay(time, 5.65, 0.028, 0.8) + free_decay(time, 29.0, 0.05, 0.5)
        return time, 0.4 * initial_tip_displacement * signal
