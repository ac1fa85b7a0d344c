"""What one FMU and several coupled ones share as an asset: a binding, a time, a beginning and an end."""

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Literal, Self, Unpack

from reporting.progress import Progress

from .binding import Binding
from .exchange import Inputs, Values
from .reading import Observation
from .simulation import ObservationHistory


class SteppedAsset(ABC):
    """An asset that is stepped through a binding, and opened by `with` or `reset`."""

    def __init__(self, binding: Binding) -> None:
        self._binding = binding
        self._start_time, self._interval = binding.binding.start_time, binding.interval
        self._phase: Literal["new", "ready", "broken", "closed"] = "new"
        self._index = 0

    @property
    def binding(self) -> Binding:
        """The binding; of one FMU, with arrays that are observed or recorded as their elements."""
        return self._binding

    @property
    def time(self) -> float:
        """Time of the asset [s]: start + i * interval, never accumulated."""
        return self._start_time + self._index * self._interval

    @property
    def step_index(self) -> int:
        """Number of steps since the last reset."""
        return self._index

    @property
    @abstractmethod
    def recorded_units(self) -> dict[str, str]:
        """Units of `Observation.extra` by name."""

    @abstractmethod
    def reset(self, parameters: Values | None = None, **inputs: Unpack[Inputs]) -> None:
        """Go back to the start."""

    @abstractmethod
    def observe(self) -> Observation:
        """Return the observation of this moment without a step."""

    @abstractmethod
    def simulate(self, *, steps: int | None = None, progress: Progress | None = None) -> ObservationHistory:
        """Make many steps from where the asset is, its inputs held."""

    @abstractmethod
    def close(self) -> None:
        """End what runs; the asset can be opened again by `reset`."""

    def __enter__(self) -> Self:
        if self._phase != "ready":
            self.reset()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
