"""A binding resolved against an FMU: all that an asset exchanges with it."""

from collections.abc import Mapping, Sequence

import numpy.typing as npt

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.errors import BindingError
from fmu_asset.instances.plan import SOLVER_TOLERANCE, InitialValue, InitialValues, Plan
from reporting.arrays import Float

from .binding import Binding
from .initial_values import InitialValueTable
from .layout import with_structural_parameters
from .reply import ReplyBlock
from .request import RequestBlock, step_count, unknown_input
from .resolver import BindingResolver
from .slots import InputSlot


class Exchange:
    """The values that an asset exchanges with its FMU.

    Parameters
    ----------
    description : FmuDescription
        The variables and abilities that the FMU declares.
    binding : Binding
        The binding of the FMU.

    Attributes
    ----------
    description : FmuDescription
        The FMU, with the array sizes of the binding.
    binding : Binding
        The binding, with arrays that are observed or recorded as their elements.
    request : RequestBlock
        Inputs of a step.
    parameters : InitialValueTable
        Values that are set before the initialisation.
    outputs : OutputTable
        Outputs that are read from the reply block.
    recorded_units : dict of str to str
        Units of the outputs that are read in addition to the observations, by name.
    output_names : list of str
        Names of all values of the reply block.
    sent, read : tuple of VariableInfo
        Variables in the request and in the reply block, in order.
    health_slots : dict of str to InputSlot
        Health that is set before the initialisation only.
    plan : Plan
        Plan of the instance; its folder is still empty.

    Raises
    ------
    BindingError
        If a variable is missing, of the wrong causality or type, or in another unit, or the FMU is
        of another version.
    """

    def __init__(self, description: FmuDescription, binding: Binding) -> None:
        _check_version(description, binding)
        description, configuration = with_structural_parameters(description, binding)

        def elements(name: str) -> Sequence[str]:
            variable = description.variable(name)
            return (name,) if variable is None else variable.elements

        self.description = description
        self.binding = binding.with_arrays(elements)
        resolver = BindingResolver(description, self.binding)
        try:
            self._resolve(resolver, configuration)
        except BindingError:
            messages = resolver.misfits()
            if len(messages) < 2:
                raise
            title = f"{len(messages)} entries of the binding {binding.title} do not fit the FMU."
            # The title names the binding and its file, so that each message need not.
            short = [text.replace(f" of the binding {binding.title}", "") for text in messages]
            raise BindingError(" ".join([title, *short])) from None

    def _resolve(self, resolver: BindingResolver, configuration: list[InitialValue]) -> None:
        """Lay out what is exchanged with the FMU.

        Parameters
        ----------
        resolver : BindingResolver
            The binding and the FMU.
        configuration : list of InitialValue
            The structural parameters, which are set first.

        Raises
        ------
        BindingError
            If an entry of the binding does not fit the FMU.
        """
        ports = resolver.port_quantities()
        reply = ReplyBlock(resolver, ports)
        self.outputs = reply.table
        self.recorded_units = reply.extra_units
        self.output_names = reply.layout.names()
        self.read = reply.layout.variables
        self.request = RequestBlock(resolver, ports)
        self.sent = self.request.layout.variables
        self.parameters = InitialValueTable(resolver)
        self.health_slots = self.parameters.health_slots
        self.plan = self._plan(reply, configuration)

    def _plan(self, reply: ReplyBlock, configuration: list[InitialValue]) -> Plan:
        """Return the plan of the instance, without its folder.

        If the binding states no tolerance, our solver uses the declared one, but none above its
        default.
        """
        description = self.description
        header = self.binding.binding
        declared_tolerance = min(description.tolerance or 1.0, SOLVER_TOLERANCE)
        return Plan(
            folder="",
            fmu=description.identity,
            instance_name=self.binding.name,
            inputs=self.request.layout.groups,
            outputs=reply.layout.groups,
            substeps=header.decimation,
            tolerance=header.tolerance or description.tolerance,
            solver_tolerance=header.tolerance or declared_tolerance,
            stop_time=header.stop_time,
            configuration=configuration,
        )

    def settings(
        self,
        parameters: Mapping[str, npt.ArrayLike],
        health: Mapping[str, npt.ArrayLike] | None = None,
    ) -> InitialValues:
        """Return the values that are set before the initialisation.

        Parameters
        ----------
        parameters : mapping of str to float or sequence of float
            Parameters by the binding's names and in its units, see `InitialValueTable`.
        health : mapping of str to float, optional
            Health that is set at a start only.

        Raises
        ------
        BindingError
            If a name is unknown.
        FmuInputError
            If a value is not finite or outside its range.
        """
        return self.parameters.initial_values(parameters, health)

    def slot(self, role: str, name: str) -> InputSlot:
        """Return the slot of an input, which checks and converts its values.

        Parameters
        ----------
        role, name : str
            The role and the name in the binding.

        Raises
        ------
        BindingError
            If the binding has no such input.
        """
        slot = self.request.slot(role, name)
        if slot is None and role == "health":
            slot = self.health_slots.get(name)
        if slot is None:
            raise unknown_input(self.binding.name, role, name, self.request.names(role))
        return slot

    @staticmethod
    def step_count(histories: Sequence[tuple[InputSlot, Float]], steps: int | None) -> int:
        """Return the number of steps on which histories and the caller agree; see `step_count`."""
        return step_count(histories, steps)


def _check_version(description: FmuDescription, binding: Binding) -> None:
    """Refuse an FMU whose version of FMI is not the one that the binding states."""
    version = binding.binding.fmi_version
    if version is not None and version[0] != description.fmi_version[0]:
        raise BindingError(
            f"The binding {binding.title} is for FMI {version}, but {description.label} is of FMI "
            f"{description.fmi_version}; correct `fmi_version`, or leave it out."
        )
