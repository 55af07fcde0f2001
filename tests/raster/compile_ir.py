"""Compiles LLVM IR for processors, none of which has to be at hand.

A process of its own, because LLVM ends the process that it finds an error in. Standard input: JSON
of `ir` and `targets`, processor -> triple; output: processor -> assembly, null where this llvmlite
was built without the triple.
"""

import json
import re
import sys

import llvmlite.binding as llvm


def assembly(ir, cpu, triple):
    """The IR compiled for a processor; the passes are those of `numba.core.codegen.CPUCodegen`."""
    try:
        target = llvm.Target.from_triple(triple)
    except RuntimeError:
        return None
    machine = target.create_target_machine(cpu=cpu, opt=3)
    machine.set_asm_verbosity(True)  # spills are comments
    ir = re.sub(r'target triple = ".*"', f'target triple = "{triple}"', ir)
    module = llvm.parse_assembly(
        re.sub(r'target datalayout = ".*"', f'target datalayout = "{machine.target_data}"', ir)
    )
    for level in (0, 3):
        tuning = llvm.create_pipeline_tuning_options(speed_level=level)
        tuning.loop_vectorization = level > 0
        tuning.slp_vectorization = False
        builder = llvm.create_pass_builder(machine, tuning)
        passes = builder.getModulePassManager()
        if level == 0:
            passes.add_loop_rotate_pass()
            passes.add_instruction_combine_pass()
            passes.add_jump_threading_pass()
        passes.add_refprune_pass()
        passes.run(module, builder)
    return str(machine.emit_assembly(module))


if __name__ == "__main__":
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    asked = json.load(sys.stdin)
    json.dump(
        {cpu: assembly(asked["ir"], cpu, triple) for cpu, triple in asked["targets"].items()},
        sys.stdout,
    )
