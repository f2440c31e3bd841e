"""Translation of functions to PTX, NVIDIA's assembly language, in which each thread of a GPU is one environment.

The functions are those of `emit.graph_function` for the target `ptx`, whose vectors have one lane. Words in the GPU's
memory are [word, lane], so that neighbouring threads read and write neighbouring words.

The bits are those of kernels of processors: each instruction of PTX is rounded to nearest (`.rn`), treats denormal
numbers as zeros (`.ftz`), and is neither reassociated nor fused, because no instruction has a flag that allows it.
Passes of LLVM only put functions in place of their calls, and registers in place of memory on the stack.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import llvmlite.binding as llvm

from workers.simd.backend.function_builder import FunctionBuilder, Values
from workers.simd.backend.machine_code import code_generator
from workers.simd.backend.target import Target

KERNEL = """\
define ptx_kernel void @{name}({parameters}) #0 {{
entry:
  %thread = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()
  %block = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
  %threads = call i32 @llvm.nvvm.read.ptx.sreg.ntid.x()
  %first = mul i32 %block, %threads
  %number = add i32 %first, %thread
  %lane = zext i32 %number to i64
  %some = icmp slt i64 %lane, %lanes
  br i1 %some, label %inside, label %after
inside:
  call void @{name}_of_lane({parameters}, i64 %lane)
  br label %after
after:
  ret void
}}
"""
"""A kernel; threads beyond the last lane do nothing."""
READ = ("tid", "ctaid", "ntid")
"""Special registers that a kernel reads."""


class Pointer(NamedTuple):
    """A parameter of a kernel, the address of words."""

    name: str
    by_lane: bool = True
    """Whether the words are [word, lane], or else [word] for all lanes."""
    words_of_step: int = 0
    """Words of each lane that one step reads; the next step reads those after them."""


class Call(NamedTuple):
    """A call of a function in each step."""

    function: FunctionBuilder
    pointers: tuple[str, ...]
    """Names of the kernel's pointers that are its arguments."""


def lane_function(name: str, pointers: Sequence[Pointer], calls: Sequence[Call], target: Target) -> FunctionBuilder:
    """Function `void name_of_lane(ptr ..., i64 lanes, i64 steps, i64 lane)` that runs steps of one lane.

    Each step makes the calls in their order.
    """
    parameters = [f"ptr {'noalias ' * (len(pointers) > 0)}%{pointer.name}" for pointer in pointers]
    builder = FunctionBuilder(f"{name}_of_lane", [*parameters, "i64 %lanes", "i64 %steps", "i64 %lane"], target)
    first = {pointer.name: builder.at(f"%{pointer.name}", "%lane", "i32") for pointer in pointers if pointer.by_lane}

    def step(number: str, _: Values) -> Values:
        places = {pointer.name: first.get(pointer.name, f"%{pointer.name}") for pointer in pointers}
        for pointer in pointers:
            if pointer.words_of_step:
                words = builder.value(f"mul i64 {number}, {pointer.words_of_step}")
                places[pointer.name] = builder.at(
                    places[pointer.name], builder.value(f"mul i64 {words}, %lanes"), "i32"
                )
        for call in calls:
            builder.do(
                f"call void @{call.function.name}("
                f"{', '.join(f'ptr {places[pointer_name]}' for pointer_name in call.pointers)}, i64 %lanes)"
            )
        return []

    builder.loop("%steps", step)
    return builder


def ptx(functions: Sequence[FunctionBuilder]) -> str:
    """PTX of one kernel for each of the `lane_function` among functions, with its name and parameters but the lane."""
    target = functions[0].target
    kernels = []
    for function in functions:
        name = function.name.removesuffix("_of_lane")
        if name != function.name:
            kernels.append(
                KERNEL.format(name=name, parameters=", ".join(function.parameters[:-1]).replace(" noalias", ""))
            )
    called = sorted({text for function in functions for text in function.declarations.values()})
    text = "\n".join(
        [
            *(function.text("alwaysinline") for function in functions),
            *kernels,
            *(f"declare i32 @llvm.nvvm.read.ptx.sreg.{name}.x()" for name in READ),
            *called,
            f"attributes #0 = {{ {target.processor.attributes} }}",
        ]
    )
    machine = code_generator(target)
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = target.triple, str(machine.target_data)
    module.verify()
    passes = llvm.create_new_module_pass_manager()
    passes.add_always_inliner_pass()
    passes.add_sroa_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=0)))
    return machine.emit_assembly(module)
