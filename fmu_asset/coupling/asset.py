"""Several FMUs stepped as one asset, through a binding."""

import math
from collections.abc import Mapping
from typing import Literal

from fmu_asset.client.binding import Binding
from fmu_asset.client.blocks import Blocks
from fmu_asset.client.session import FmiAsset
from fmu_asset.client.values import Values
from fmu_asset.errors import (
    BindingError,
    CouplingError,
)
from reporting.words import comma_list

from .fmus import CoupledFmus, errors_of_component
from .schedule import Schedule, loop_sentence
from .structure import SystemStructure
from .system import SystemDescription, stepped_components, system_description, wiring_hash
from .wiring import Wiring

Algorithm = Literal["gauss_seidel", "jacobi"]
ALGORITHMS: tuple[Algorithm, ...] = ("gauss_seidel", "jacobi")


class CoupledAsset(FmiAsset):
    """Several FMUs that are stepped as one asset, through a binding.

    The step size of the binding is that of the system: outputs are exchanged once a step. With
    ``"gauss_seidel"`` each component takes the newest outputs of those that were stepped before it,
    in the order of `schedule`; with ``"jacobi"`` all take the outputs at the beginning of the step.
    With more than one iteration, components that form a cycle repeat the step until the exchanged
    values have converged.

    After a failed step the components are no longer at the same time: reset the asset or restore a
    state of it. If an FMU ends its simulation, `simulate` ends with the step before.

    Parameters
    ----------
    binding : Binding
        The binding; its variables are connectors of the system, or `component.variable`.
    algorithm : {"gauss_seidel", "jacobi"}
        How values pass between components within a step.
    iterations : int
        Largest number of times that a step of a cycle is made.
    tolerance : float
        A cycle has converged when no exchanged value changes by more than this times the larger of
        one and its magnitude.
    isolated : bool
        Whether each FMU runs in a worker process of its own.
    step_timeout : float, optional
        Wall-clock limit of one step of one FMU [s], instead of the binding's.
    parameters : mapping of str to float, optional
        Parameters by the binding's names and in its units.

    Raises
    ------
    CouplingError
        If the components do not fit each other, or if the system has an algebraic loop and the
        algorithm is Gauss-Seidel without iterations.
    BindingError
        If the binding does not fit.
    FmuFileError, FmuUnsupportedError
        If an FMU cannot be used.
    """

    def __init__(
        self,
        structure: SystemStructure | Wiring,
        binding: Binding,
        *,
        algorithm: Algorithm = "gauss_seidel",
        iterations: int = 1,
        tolerance: float = 1e-9,
        isolated: bool = True,
        step_timeout: float | None = None,
        parameters: Values | None = None,
    ) -> None:
        _check_algorithm(algorithm, iterations, tolerance)
        wiring = structure if isinstance(structure, Wiring) else Wiring(structure)
        self._wiring = wiring
        if binding.binding.decimation != 1:
            raise BindingError(
                f"The binding {binding.name} of several FMUs has a decimation, which only a "
                "binding of one FMU can have; leave it out."
            )
        jacobi = algorithm == "jacobi"
        loops = wiring.schedule.loops
        if loops and iterations == 1 and not jacobi:  # Jacobi delays every connection
            raise CouplingError(loop_sentence(loops))
        # the system as one FMU
        sha256 = wiring_hash(wiring, binding, algorithm, iterations, tolerance)
        system = system_description(wiring, sha256)
        blocks = _system_blocks(system, binding)
        # its components
        interpolates = binding.binding.interpolation == "linear"
        components = stepped_components(wiring, blocks, linear=interpolates)
        system_settings = blocks.settings(parameters or {})
        parameters_of = system.settings_of_components(system_settings)
        assets = {}
        for name, component in components.items():
            with errors_of_component(name):
                assets[name] = FmiAsset(
                    wiring.declared[name],
                    component.binding,
                    isolated=isolated,
                    step_timeout=step_timeout,
                    parameters={**component.settings, **parameters_of.get(name, {})},
                )
        if iterations > 1:
            _check_states_can_be_saved(assets, wiring.schedule)
        fmus = CoupledFmus(
            blocks,
            wiring.schedule,
            components,
            assets,
            jacobi=jacobi,
            iterations=iterations,
            tolerance=tolerance,
        )
        self._compose(blocks, fmus, parameters or {})

    @property
    def schedule(self) -> Schedule:
        """Order of the components."""
        return self._wiring.schedule


def _check_states_can_be_saved(assets: Mapping[str, FmiAsset], order: Schedule) -> None:
    """Raise an error if a component of a cycle cannot save its state, as iterations require."""
    for group in order.cycles:
        for name in group:
            if assets[name].state_method != "serialised":
                raise CouplingError(
                    f"The component {name!r} cannot save and restore its state, which iterations "
                    "need; allow one iteration only, or delay a connection."
                )


def _system_blocks(system: SystemDescription, binding: Binding) -> Blocks:
    """Resolve a binding against a system as one FMU.

    A `BindingError` is raised if it does not fit, or has health that acts at the start only.
    """
    # Inputs are interpolated at the components, not at the system.
    blocks = Blocks(system, binding.with_header(interpolation="zero-order"))
    if blocks.health_at_start:
        names = ", ".join(blocks.health_at_start)
        raise BindingError(
            f"The binding {binding.name} has the health {names}, which the system "
            f"{system.model_name} takes at its start only; in a system a health must be an input "
            "or, in co-simulation, a tunable parameter."
        )
    return blocks


def _check_algorithm(algorithm: str, iterations: int, tolerance: float) -> None:
    """Raise an error for an unknown algorithm, or impossible iterations or tolerance."""
    if algorithm not in ALGORITHMS:
        raise CouplingError(
            f"The algorithm must be one of {comma_list(ALGORITHMS)}, but {algorithm!r} was given."
        )
    if iterations < 1 or not (tolerance > 0.0 and math.isfinite(tolerance)):
        raise CouplingError(
            f"Iterations must be at least 1 and the tolerance positive, but {iterations!r} and "
            f"{tolerance!r} were given."
        )
