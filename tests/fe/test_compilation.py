"""Which source files the machine code that is kept on disk depends on."""

from fe import compilation
from twin_master.learning import exchanged_densities, fault_evidence, fault_kernels


def test_machine_code_depends_on_files_that_callees_use():
    """`fault_evidence` names no function of `exchanged_densities`, but what it calls does."""
    callees = compilation._compiled_callees(fault_evidence.correct_beliefs.py_func)
    modules = {callee.__module__ for callee in callees}
    assert exchanged_densities.__name__ not in {
        getattr(value, "__module__", "") for value in vars(fault_evidence).values()
    }
    assert {exchanged_densities.__name__, fault_kernels.__name__} <= modules
