"""Translation of functions to PTX, NVIDIA's assembly language, in which each thread of a GPU is one environment.

The functions are those of `emit.graph_function` for the target `ptx`, whose vectors have one lane. Words in the GPU's
memory are [word, lane], so that neighbouring threads read and write neighbouring words.

The bits are those of kernels of processors: each instruction of PTX is rounded to nearest (`.rn`), treats denormal
numbers as zeros (`.ftz`), and is neither reassociated nor fused, because no instruction has a flag that allows it.
Passes of LLVM only put functions in place of their calls, and registers in place of memory on the stack.

**Quotients and roots** are computed without branches, with the bits of those that are rounded correctly.
PTX rounds a quotient by six operations and a branch to some sixty more for arguments near the ends of the range of
floats and for a dividend of 0. In a task's loop such branches cost more than the quotients: they divide the code into
short pieces, and a dividend of 0 is common. `QuickWriter` writes the operations alone, and notes whether any argument
or result was outside of the range for which they are right. If one was, which does not happen in an episode of an ant,
the whole function is computed again by a function of PTX's own quotients, whose name ends in `_exact`.

    1 / b    estimated, then corrected by what remains of 1
    a / b    a times that, then corrected by what remains of a. Of a dividend of -0 the correction loses the sign.
    root a   a times an estimate of 1 / root a, then corrected by what remains of a

These are the operations of PTX's own code. They are right if the dividend is 0 or at least LEAST, the divisor at most
MOST, what the root is taken of at least LEAST, and the result finite.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

import llvmlite.binding as llvm

from workers.simd.backend.emit import Writer
from workers.simd.backend.function_builder import FunctionBuilder, Names
from workers.simd.backend.native import code_generator
from workers.simd.backend.target import Target
from workers.simd.graph.schedule import Region

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


class StepCall(NamedTuple):
    function: FunctionBuilder
    pointers: tuple[str, ...]
    """Names of the kernel's pointers that are its arguments."""


def lane_function(name: str, pointers: Sequence[Pointer], calls: Sequence[StepCall], target: Target) -> FunctionBuilder:
    """Function `void name_of_lane(ptr ..., i64 lanes, i64 steps, i64 lane)` that runs steps of one lane.

    Each step makes the calls in their order.
    """
    parameters = [f"ptr {'noalias ' * (len(pointers) > 0)}%{pointer.name}" for pointer in pointers]
    builder = FunctionBuilder(f"{name}_of_lane", [*parameters, "i64 %lanes", "i64 %steps", "i64 %lane"], target)
    first = {pointer.name: builder.at(f"%{pointer.name}", "%lane", "i32") for pointer in pointers if pointer.by_lane}

    def step(number: str, _: Names) -> Names:
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


LEAST, MOST = 2.0**-60, 2.0**60
EXACT = "_exact"
ESTIMATES = {
    "nvptx64": ("llvm.nvvm.rcp.approx.ftz.f", "llvm.nvvm.rsqrt.approx.ftz.f"),
}
"""By architecture, the intrinsics that estimate 1 / x and 1 / root x to a unit in the last place. Where there are none,
as on the processors on which tests run such code, both are divisions."""


class Noted(NamedTuple):
    """Values of a straight piece of code that say whether its quotients and roots are right."""

    poison: str
    """NaN if a result is not finite, or else 0."""
    divisor: str
    """Greatest absolute value of a divisor."""
    radicand: str
    """Least number that a root was taken of."""
    dividend: str
    """Least of twice the bits of a dividend, less 1; so a dividend of 0 counts as the greatest."""


class QuickWriter(Writer):
    """Writer of a graph's instructions, one lane at a time, with quick quotients and roots."""

    part = 20_000  # the ants of Brax's springs stay one block, as they were measured
    noted: Noted
    flag: int
    """Slot of the word that says whether the function must be computed again."""

    def compute_all(self) -> None:
        """Write all instructions, in order."""
        self.flag, self.slot_count = self.slot_count, self.slot_count + 1
        self.builder.store(self.words["I"], "zeroinitializer", self.memory, self.flag)
        self.noted = self.nothing()
        super().compute_all()
        self.flush()

    def trip(self, region: Region) -> list[tuple[str, str]]:
        """Write the body of a loop; returns (LLVM type, name) of what each carry becomes."""
        before, self.noted = self.noted, self.nothing()
        ends = super().trip(region)
        self.flush()
        self.noted = before
        return ends

    def finish(self, write: Callable[[], object]) -> None:
        """Write what follows the computation: its results, or the call of the exact function."""
        builder = self.builder
        flag = builder.value(f"extractelement <1 x i32> {builder.load(self.words['I'], self.memory, self.flag)}, i64 0")
        given = ", ".join(parameter.replace(" noalias", "") for parameter in builder.parameters)
        builder.when(builder.value(f"icmp eq i32 {flag}, 0"), write)
        builder.when(
            builder.value(f"icmp ne i32 {flag}, 0"), lambda: builder.do(f"call void @{builder.name}{EXACT}({given})")
        )

    def operation(self, name: str, values: Sequence[str]) -> str:
        """Write an operation on named values and return the name of its value."""
        if name == "div":
            return self.quotient(*values)
        return self.root(*values) if name == "sqrt" else super().operation(name, values)

    def quotient(self, a: str, b: str) -> str:
        minus_b, one = self.operation("neg", [b]), self.number(1.0)
        estimate = self.estimate("div", one, b)
        reciprocal = self.operation("fma", [estimate, self.operation("fma", [minus_b, estimate, one]), estimate])
        first = self.operation("mul", [a, reciprocal])
        second = self.operation("fma", [self.operation("fma", [minus_b, first, a]), reciprocal, first])
        bits = self.operation("bits", [a])
        dividend = self.operation("isub", [self.operation("iadd", [bits, bits]), "splat (i32 1)"])
        integers = self.words["I"]
        self.noted = self.noted._replace(
            poison=self.operation("fma", [second, self.number(0.0), self.noted.poison]),
            divisor=self.extreme("maxnum", self.noted.divisor, self.operation("abs", [b])),
            dividend=self.builder.call(
                integers, "llvm.umin.v1i32", (integers, self.noted.dividend), (integers, dividend)
            ),
        )
        size = self.operation("iand", [self.operation("bits", [second]), f"splat (i32 {2**31 - 1})"])
        sign = self.operation("iand", [self.operation("bits", [first]), f"splat (i32 {-(2**31)})"])
        return self.operation("unbits", [self.operation("ior", [size, sign])])

    def root(self, a: str) -> str:
        estimate = self.estimate("sqrt", self.number(1.0), a)
        first = self.operation("mul", [a, estimate])
        half = self.operation("mul", [estimate, self.number(0.5)])
        rest = self.operation("fma", [self.operation("neg", [first]), first, a])
        second = self.operation("fma", [rest, half, first])
        self.noted = self.noted._replace(
            poison=self.operation("fma", [second, self.number(0.0), self.noted.poison]),
            radicand=self.extreme("minnum", self.noted.radicand, a),
        )
        return second

    def estimate(self, name: str, one: str, x: str) -> str:
        """Estimate of 1 / x (div) or 1 / root x (sqrt)."""
        builder, floats = self.builder, self.words["F"]
        intrinsics = ESTIMATES.get(builder.target.processor.triple.partition("-")[0])
        if not intrinsics:
            return super().operation("div", [one, x if name == "div" else super().operation("sqrt", [x])])
        element = builder.value(f"extractelement {floats} {x}, i64 0")
        estimate = builder.call("float", intrinsics[name == "sqrt"], ("float", element))
        return builder.value(f"insertelement {floats} poison, float {estimate}, i64 0")

    def extreme(self, which: str, a: str, b: str) -> str:
        """The greater or the smaller of two floats; NaN is neither."""
        floats = self.words["F"]
        return self.builder.call(floats, f"llvm.{which}.v1f32", (floats, a), (floats, b))

    def number(self, value: float) -> str:
        return self.constant("f", struct.unpack("<i", struct.pack("<f", value))[0])

    def nothing(self) -> Noted:
        """Notes of code without quotients and roots."""
        return Noted(self.number(0.0), self.number(0.0), self.number(float("inf")), "splat (i32 -1)")

    def flush(self) -> None:
        """Set the flag if anything that was noted is outside of the range."""
        noted, start = self.noted, self.nothing()
        least = 2 * struct.unpack("<i", struct.pack("<f", LEAST))[0] - 1
        tests = [
            f"fcmp uno {self.words['F']} {noted.poison}, {noted.poison}" * (noted.poison != start.poison),
            f"fcmp ogt {self.words['F']} {noted.divisor}, {self.number(MOST)}" * (noted.divisor != start.divisor),
            f"fcmp olt {self.words['F']} {noted.radicand}, {self.number(LEAST)}" * (noted.radicand != start.radicand),
            f"icmp ult {self.words['I']} {noted.dividend}, splat (i32 {least})" * (noted.dividend != start.dividend),
        ]
        for test in filter(None, tests):
            word = self.builder.value(f"zext {self.words['B']} {self.builder.value(test)} to {self.words['I']}")
            before = self.builder.load(self.words["I"], self.memory, self.flag)
            self.builder.store(self.words["I"], self.operation("ior", [before, word]), self.memory, self.flag)
