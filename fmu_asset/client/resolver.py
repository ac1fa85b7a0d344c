"""The names of a binding, selection in the FMU: variables, units, ranges and mechanical ports."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from fmu_asset.archive.declared import FmuDescription, VariableInfo
from fmu_asset.errors import BindingError

from .binding import Binding
from .bound_variables import InputBinding, PortBinding, ScalarBinding, VectorBinding
from .layout import VariableElements, find_variable
from .slots import InputSlot
from .units import conversion


class PortQuantity(NamedTuple):
    """A quantity of a mechanical port, resolved against an FMU.

    Attributes
    ----------
    name : str
        Port and quantity, such as `tip.force`.
    vector : VectorBinding
        Its variables.
    is_read : bool
        Whether it is an output of the FMU: of force and motion one is, and the other is not.
    """

    name: str
    vector: VectorBinding
    is_read: bool

    @property
    def label(self) -> str:
        """Place in the binding, for messages."""
        return f"port.{self.name}"


class BindingResolver:
    """Finds the variables of an FMU that a binding names.

    Parameters
    ----------
    description : FmuDescription
        The FMU, with the array sizes of the binding.
    binding : Binding
        The binding of the FMU.
    """

    def __init__(self, description: FmuDescription, binding: Binding) -> None:
        self.description = description
        self.binding = binding

    def place_in_binding(self, label: str) -> str:
        """Return a text for messages: a place in the binding, its name and its file."""
        return f"{label} of the binding {self.binding.title}"

    def find(self, name: str, label: str, causality: str) -> VariableElements:
        """Return the variable, or element of an array, that the binding names at a place.

        Parameters
        ----------
        name : str
            Name in the FMU.
        label : str
            Place in the binding.
        causality : str
            Role of the variable, see `find_variable`.

        Raises
        ------
        BindingError
            If there is no such variable, or it is of another causality or type.
        """
        return find_variable(self.description, name, self.place_in_binding(label), causality)

    def variable_or_array(self, name: str) -> VariableInfo | None:
        """Return the variable of a name, or the array to whose element the name belongs."""
        array_name = name.rpartition("[")[0]
        return self.description.variable(name) or self.description.variable(array_name)

    def is_set_at_start(self, name: str) -> bool:
        """Return whether a variable can be set only before the initialisation."""
        variable = self.variable_or_array(name)
        if variable is None:
            return False
        is_tunable = (
            variable.variability == "tunable" and self.description.interface == "co-simulation"
        )
        return variable.startable or (variable.causality == "parameter" and not is_tunable)

    def slot(
        self,
        label: str,
        input_binding: InputBinding,
        variable: VariableInfo,
        positions: Sequence[int],
    ) -> InputSlot:
        """Return the slot of an input, which checks and converts values and has their positions.

        Parameters
        ----------
        label : str
            The place in the binding.
        input_binding : InputBinding
            The unit and the range of the input.
        variable : VariableInfo
            The FMU's variable.
        positions : sequence of int
            The positions of the input's values in the request block.

        Raises
        ------
        BindingError
            If the unit cannot be converted, or the range lies outside that of the FMU.
        """
        definitions = self.description.units_of(variable)
        place = self.place_in_binding(label)
        unit_conversion = conversion(input_binding.unit, variable, definitions, where=place)
        low, high = variable.bounds
        # A negative factor of the conversion exchanges the limits, so they are sorted.
        stated_low, stated_high = sorted(
            unit_conversion.to_fmu(limit) for limit in input_binding.limits
        )
        if stated_low > high or stated_high < low:
            raise BindingError(
                f"The range of {self.place_in_binding(label)} lies outside that of "
                f"{variable.name!r}, {low:g} to {high:g}{variable.in_unit}; correct minimum or "
                "maximum."
            )
        return InputSlot(
            label=label,
            positions=positions,
            low=max(low, stated_low),
            high=min(high, stated_high),
            conversion=unit_conversion,
            variable=variable,
        )

    def start_slot(self, label: str, input_binding: InputBinding) -> InputSlot:
        """Return the slot of a value that is set before the initialisation.

        The positions of its values count from the first element of the variable.

        Raises
        ------
        BindingError
            If the binding does not fit the FMU.
        """
        selection = self.find(input_binding.variable, label, "parameter")
        return self.slot(label, input_binding, selection.variable, selection.elements)

    def misfits(self) -> list[str]:
        """Return the messages about all entries of the binding that do not fit the FMU.

        Of a list of variables only the first misfit is stated. The quantities of a port are
        compared with each other only if each of them fits the FMU.
        """
        messages: dict[str, str] = {}
        for label, entry in self._labelled_entries():
            if label in messages:
                continue
            try:
                self._check_entry(label, entry)
            except BindingError as error:
                messages[label] = str(error)
        for name, port in self.binding.port.items():
            messages |= self._misfits_of_port(name, port)
        return [*messages.values()]

    def _misfits_of_port(self, name: str, port: PortBinding) -> dict[str, str]:
        """Return the messages about a port that does not fit the FMU, by their places."""
        messages: dict[str, str] = {}
        for quantity, vector in port.quantities.items():
            label = f"port.{name}.{quantity}"
            for variable, unit in zip(vector.variables, vector.units, strict=True):
                try:
                    self._check_port_variable(label, ScalarBinding(variable=variable, unit=unit))
                except BindingError as error:
                    messages.setdefault(label, str(error))
        if not messages:
            try:
                self._quantities_of_port(name, port)
            except BindingError as error:
                messages[f"port.{name}"] = str(error)
        return messages

    def _check_port_variable(self, label: str, entry: ScalarBinding) -> None:
        """Refuse a variable of a port that the FMU does not have, or has of another type or unit.

        Raises
        ------
        BindingError
            If it does not fit the FMU.
        """
        causality = "input" if self._is_input(entry.variable) else "output"
        variable = self.find(entry.variable, label, causality).variable
        definitions = self.description.units_of(variable)
        conversion(entry.unit, variable, definitions, where=self.place_in_binding(label))

    def _labelled_entries(self) -> Iterator[tuple[str, ScalarBinding]]:
        """Yield each variable that the binding names, with its place in the binding."""
        binding = self.binding
        for role in ("control", "health", "load", "parameter", "monitor"):
            table: Mapping[str, ScalarBinding] = getattr(binding, role)
            for name, entry in table.items():
                yield f"{role}.{name}", entry
        for name, vector in binding.observation.items():
            for variable, unit in zip(vector.variables, vector.units, strict=True):
                yield f"observation.{name}", ScalarBinding(variable=variable, unit=unit)

    def _check_entry(self, label: str, entry: ScalarBinding) -> None:
        """Refuse an entry of the binding that does not fit the FMU.

        Raises
        ------
        BindingError
            If the FMU has no such variable, or the variable has another causality, type, unit or
            range.
        """
        variable = self.description.variable(entry.variable)
        is_text = variable is not None and variable.is_text_parameter
        role = label.partition(".")[0]
        if not isinstance(entry, InputBinding):  # an observation or a monitor
            found = self.find(entry.variable, label, "output").variable
            definitions = self.description.units_of(found)
            conversion(entry.unit, found, definitions, where=self.place_in_binding(label))
        elif role == "parameter":
            if not is_text:
                self.start_slot(label, entry)
        elif role == "health" and self.is_set_at_start(entry.variable):
            self.start_slot(label, entry)
        else:
            selection = self.find(entry.variable, label, "input")
            self.slot(label, entry, selection.variable, selection.elements)

    # ------------------------------------------------------------------ ports

    def port_quantities(self) -> list[PortQuantity]:
        """Return the quantities of all ports of the binding.

        Raises
        ------
        BindingError
            If a port mixes inputs and outputs, or if force and motion are both inputs or both
            outputs.
        """
        quantities = []
        for port_name, port in self.binding.port.items():
            quantities += self._quantities_of_port(port_name, port)
        return quantities

    def _quantities_of_port(self, port_name: str, port: PortBinding) -> list[PortQuantity]:
        """Return the quantities of a port; for errors see `port_quantities`."""
        quantities = []
        force_count = len(port.force.variables)
        is_output_of_quantity: dict[str, bool] = {}
        for quantity, vector in port.quantities.items():
            name = f"{port_name}.{quantity}"
            is_output_of_quantity[quantity] = self._is_output_vector(
                f"port.{name}", vector, force_count
            )
            quantities.append(PortQuantity(name, vector, is_output_of_quantity[quantity]))
        force_is_output = is_output_of_quantity.pop("force")
        if force_is_output in is_output_of_quantity.values():
            side = "outputs" if force_is_output else "inputs"
            raise BindingError(
                f"In {self.place_in_binding(f'port.{port_name}')}, force and motion are both "
                f"{side} of the FMU; at a port one is given for the other."
            )
        return quantities

    def _is_output_vector(self, label: str, vector: VectorBinding, force_count: int) -> bool:
        """Return whether the variables of a port's quantity are outputs of the FMU.

        Parameters
        ----------
        label : str
            The place of the quantity in the binding.
        vector : VectorBinding
            The variables of the quantity.
        force_count : int
            The number of components of the force, which the quantity must have, too.
        """
        location = self.place_in_binding(label)
        count = len(vector.variables)
        if count != force_count:
            raise BindingError(
                f"{location} has {count} values, but the force has {force_count}; give the same "
                "number for both."
            )
        are_inputs = {self._is_input(variable) for variable in vector.variables}
        if len(are_inputs) > 1:
            raise BindingError(f"{location} mixes inputs and outputs of the FMU.")
        return not are_inputs.pop()

    def _is_input(self, name: str) -> bool:
        """Return whether a name is that of an input, or of an element of an array input."""
        variable = self.variable_or_array(name)
        return variable is not None and variable.causality == "input"
