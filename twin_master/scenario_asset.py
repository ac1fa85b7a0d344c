"""The tables of a scenario that say what is flown: `[asset]`, its components and connections."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from twin_master.scenario_section import (
    Count,
    Flag,
    Name,
    Number,
    Positive,
    Section,
    short,
)


class ComponentSection(Section):
    """One FMU of a coupled asset: a file, a companion by its name, or packed from a wing design."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_\-]*$")]
    fmu: str | None = None
    design: str | None = None
    substeps: Count = 1
    """Steps that it makes in one step of the system."""
    parameters: dict[str, Flag | Number | str] = Field(default_factory=dict)
    """By the FMU's names and in its units; `gain[{1..4}]` stands for four of them."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.fmu is None) == (self.design is None):
            raise ValueError(f"the component `{self.name}` needs one of `fmu` and `design`")
        return self


class ConnectionSection(Section):
    """What flows from one FMU of a coupled asset to another, or to and from the asset itself."""

    source: Annotated[str, Field(min_length=1)]
    target: Annotated[str, Field(min_length=1)]
    factor: Number = 1.0
    offset: Number = 0.0
    delayed: Flag = False


class AssetSection(Section):
    """What is flown: an FMU (packed from a wing design, or a file), several of them, or a strain library."""

    kind: Literal["fmu", "coupled", "strain_library"] = "fmu"
    design: str | None = None
    file: str | None = None
    script: str | None = None
    """A pythonfmu script that is packed as the FMU: a shipped one, or a file."""
    binding: str | None = None
    isolated: Flag = True
    step_timeout: Positive | None = None
    parameters: dict[str, Number] = Field(default_factory=dict)
    load: dict[str, Number] = Field(default_factory=dict)
    observation_model: Literal["design", "asset", "library"] | None = None
    """Where the twin's predicted observations come from: the model of the design (the default where there is
    one), the asset itself, or the observation library `library`."""
    library: str | None = None
    """An observation library, as `uav-twin library sample` writes it."""
    seeds: tuple[Name, ...] = ()
    """Parameters of the binding that are given a number drawn from the seed of the run."""
    patch: str | None = None
    """A patch file: missing effects that the FMU packed of the design carries, switched on from the start
    unless `parameters` says otherwise. The twin does not know of them."""
    model_patch: str | None = None
    """A patch file: effects that the twin's model of the design carries."""
    component: tuple[ComponentSection, ...] = ()
    connection: tuple[ConnectionSection, ...] = ()
    algorithm: Literal["gauss_seidel", "jacobi"] = "gauss_seidel"
    iterations: Count = 1
    tolerance: Positive = 1e-9

    @property
    def model_of_the_design(self) -> bool:
        """Whether the twin believes the model of the design."""
        return self.design is not None and self.observation_model in (None, "design")

    @property
    def another_model(self) -> bool:
        """Whether what is flown is known to be another model than the one that the twin believes."""
        return (
            (self.kind == "strain_library" and self.model_of_the_design)
            or self.patch is not None
            or self.model_patch is not None
        )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.kind != "coupled" and (self.component or self.connection):
            raise ValueError("`component` and `connection` belong to the kind `coupled`")
        if self.kind == "coupled" and (not self.binding or bool(self.file) == bool(self.component)):
            raise ValueError("a coupled asset needs `binding` and either `file`, an SSP file, or `component`")
        if self.kind == "coupled" and self.file and self.connection:
            raise ValueError("the connections of an SSP file stand in it: leave out `connection`")
        names = [component.name for component in self.component]
        if len(set(names)) != len(names):
            raise ValueError(f"each component needs a name of its own, and the names are {short(names)}")
        for name in self.seeds:
            if name in self.parameters:
                raise ValueError(f"`{name}` is both in `parameters` and in `seeds`: keep one of them")
        if self.kind == "fmu" and (not self.binding or not (self.design or self.file or self.script)):
            raise ValueError("an FMU asset needs `binding` and one of `design`, `file` and `script`")
        if self.script and self.kind != "fmu":
            raise ValueError("`script` is packed as one FMU, and belongs to the kind `fmu`")
        if self.script and (self.file or self.design):
            raise ValueError(
                f"`script` is packed as the FMU that is flown, and `{'file' if self.file else 'design'}` "
                "names another: keep one of them"
            )
        if (self.observation_model == "library") != (self.library is not None):
            raise ValueError(
                '`observation_model = "library"` and `library`, the file of an observation library, go '
                f"together, and only {'the second' if self.library else 'the first'} was given"
            )
        if self.observation_model == "design" and self.design is None:
            raise ValueError(
                '`observation_model = "design"` needs `design`, the wing whose model the twin believes'
            )
        if self.patch and (self.kind != "fmu" or self.file or self.script or not self.design):
            raise ValueError(
                "`patch` goes into the FMU that is packed of `design`, and here another asset is flown: "
                "leave out `patch`, or `file` and `script`"
            )
        if self.model_patch and not self.model_of_the_design:
            raise ValueError(
                "`model_patch` goes into the model of `design`, and the twin believes another one: give "
                "`design` and leave out `observation_model`, or leave out `model_patch`"
            )
        if self.kind == "strain_library":
            self._check_library()
        return self

    def _check_library(self) -> None:
        for key in ("binding", "parameters", "load", "script", "library"):
            if getattr(self, key):
                raise ValueError(
                    f"`{key}` belongs to an FMU, and the asset is a strain library, which is what it is: "
                    f"leave `{key}` out"
                )
        if self.design is not None and self.observation_model == "asset":
            raise ValueError(
                "a strain library that is both asset and model leaves nothing to do for `design`: leave it "
                'out, or set `observation_model = "design"`'
            )
