"""Builder of the LLVM IR of functions on vectors, used by the emitter of graphs and by code written by hand.

    void kernel(...)        the function called from outside; it rounds to nearest and treats denormal numbers as zeros,
                            unless its module says otherwise
    void anything(...)      functions that kernels call

Floating-point instructions carry no fast-math flags. Nothing is reassociated, and only `fma` is fused, so the bits of a
lane do not depend on the width of the vectors.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence

from workers.simd.backend.target import Target

SCALAR_TYPES = {"f": "float", "i": "i32", "b": "i1"}
"""LLVM type of one value for each dtype of a graph."""

KERNEL = """\
define void @kernel({parameters}) #0 {{
entry:
{set_mode}
  call void @inside({arguments})
{restore_mode}
  ret void
}}

{declarations}

attributes #0 = {{ {attributes} }}
"""

VALUE = re.compile(r"%v\d+")
"""The name of a value that an instruction has made."""
Names = list[str]
"""Names of values in LLVM IR."""


class FunctionBuilder:
    """Builder of the text of one LLVM function, line by line. Its methods return the names of values."""

    def __init__(self, name: str, parameters: Sequence[str], target: Target) -> None:
        """Begin the function `void @name(parameters)` on the vectors of a target; a parameter is "type %name"."""
        self.name, self.parameters, self.target, self.width = name, list(parameters), target, target.width
        self.llvm_types = {dtype: f"<{self.width} x {scalar}>" for dtype, scalar in SCALAR_TYPES.items()}
        """LLVM type of a vector for each dtype of a graph."""
        self.lines: list[str] = []
        self.memory: list[str] = []
        """Lines that reserve memory on the stack; they come first in the function."""
        self.declarations: dict[str, str] = {}
        """Declarations of the intrinsics that are called, by name."""
        self._label = "entry"
        self._names = 0

    def do(self, instruction: str) -> None:
        self.lines.append(f"  {instruction}")

    def value(self, instruction: str) -> str:
        """Add an instruction and return the name of its value."""
        self._names += 1
        self.lines.append(f"  %v{self._names} = {instruction}")
        return f"%v{self._names}"

    def call(self, llvm_type: str, intrinsic: str, *arguments: tuple[str, str]) -> str:
        """Call an intrinsic that returns `llvm_type`, with (type, value) arguments, and declare it."""
        if intrinsic not in self.declarations:
            types = ", ".join(type_ for type_, _ in arguments)
            self.declarations[intrinsic] = f"declare {llvm_type} @{intrinsic}({types})"
        return self.value(f"call {llvm_type} @{intrinsic}({', '.join(map(' '.join, arguments))})")

    def at(self, pointer: str, index: str | int, llvm_type: str) -> str:
        return self.value(f"getelementptr {llvm_type}, ptr {pointer}, i64 {index}")

    def load(self, llvm_type: str, pointer: str, index: str | int = 0) -> str:
        """Load element `index` of an array of a type; vectors of 32-bit words are aligned."""
        place = self.at(pointer, index, llvm_type)
        return self.value(f"load {llvm_type}, ptr {place}, align {self._alignment(llvm_type)}")

    def store(self, llvm_type: str, value: str, pointer: str, index: str | int = 0) -> None:
        place = self.at(pointer, index, llvm_type)
        self.do(f"store {llvm_type} {value}, ptr {place}, align {self._alignment(llvm_type)}")

    def _alignment(self, llvm_type: str) -> int:
        if llvm_type == self.llvm_types["f"] or llvm_type == self.llvm_types["i"]:
            return 4 * self.width
        return 1 if llvm_type.endswith("x i8>") else 4

    def index(self, *terms: tuple[str | int, int]) -> str:
        """Sum of products (i64 value, factor)."""
        total = "0"
        for value, factor in terms:
            part = str(value) if factor == 1 else self.value(f"mul i64 {value}, {factor}")
            total = part if total == "0" else self.value(f"add i64 {total}, {part}")
        return total

    def splat(self, scalar: str, dtype: str = "f") -> str:
        vector = self.llvm_types[dtype]
        first = self.value(f"insertelement {vector} poison, {SCALAR_TYPES[dtype]} {scalar}, i64 0")
        return self.value(f"shufflevector {vector} {first}, {vector} poison, <{self.width} x i32> zeroinitializer")

    def fma(self, a: str, b: str, c: str) -> str:
        """Value of a * b + c of float vectors, rounded once."""
        llvm_type = self.llvm_types["f"]
        return self.call(llvm_type, f"llvm.fma.v{self.width}f32", (llvm_type, a), (llvm_type, b), (llvm_type, c))

    def label(self, name: str) -> None:
        """Begin a basic block; the previous one must have ended with a branch."""
        self.lines.append(f"{name}:")
        self._label = name

    def loop(
        self,
        trips: str | int | None,
        body: Callable[[str, Names], Iterable[str]],
        carries: Sequence[tuple[str, str]] = (),
        until: Callable[[], str] | None = None,
    ) -> Names:
        """Repeat a body; returns the carried values after the last trip, or the first ones if there is no trip.

        Args:
            trips: most trips, or the name of an i64 that has it; None if only `until` ends the loop.
            body: function (number of the trip, carried values) -> carried values of the next trip.
            carries: (type, first value) of each carried value.
            until: function that gives an i1 at the end of each trip, which ends the loop early if it is true.
        """
        if isinstance(trips, int) and trips < 1:
            return [first for _, first in carries]
        self._names += 1
        label, before = f"loop{self._names}", self._label
        if not isinstance(trips, str):
            self.do(f"br label %{label}")
        else:
            some = self.value(f"icmp sgt i64 {trips}, 0")
            self.do(f"br i1 {some}, label %{label}, label %{label}_after")
        self.label(label)
        place = len(self.lines)
        names = [f"%{label}_c{k}" for k in range(len(carries))]
        outs = list(body(f"%{label}_trip", names))
        stop = until() if until else "false"
        self.do(f"br label %{label}_end")
        self.label(f"{label}_end")
        phis = [f"  %{label}_trip = phi i64 [ 0, %{before} ], [ %{label}_next, %{label}_end ]"]
        for (llvm_type, first), name, out in zip(carries, names, outs, strict=True):
            phis.append(f"  {name} = phi {llvm_type} [ {first}, %{before} ], [ {out}, %{label}_end ]")
        self.lines[place:place] = phis
        self.do(f"%{label}_next = add i64 %{label}_trip, 1")
        self.do(f"%{label}_more = icmp slt i64 %{label}_next, {2**63 - 1 if trips is None else trips}")
        self.do(f"%{label}_again = select i1 {stop}, i1 false, i1 %{label}_more")
        self.do(f"br i1 %{label}_again, label %{label}, label %{label}_after")
        self.label(f"{label}_after")
        if not isinstance(trips, str):
            return outs
        return [
            self.value(f"phi {llvm_type} [ {first}, %{before} ], [ {out}, %{label}_end ]")
            for (llvm_type, first), out in zip(carries, outs, strict=True)
        ]

    def part(self) -> None:
        """Begin another basic block of straight code.

        LLVM joins blocks that always follow each other. So the one before ends with a branch that is never taken: to
        where the first parameter, a pointer, is null.
        """
        self._names += 1
        label = f"part{self._names}"
        never = self.value(f"icmp eq ptr {self.parameters[0].split()[-1]}, null")
        self.do(f"br i1 {never}, label %{label}_never, label %{label}")
        self.label(f"{label}_never")
        self.do("unreachable")  # and not a return, which LLVM would think as likely as what follows
        self.label(label)

    def any(self, words: str, lanes: int | None = None) -> str:
        """An i1 that is true if any word of an integer vector is not 0."""
        llvm_type = f"<{lanes or self.width} x i32>"
        combined = self.call("i32", f"llvm.vector.reduce.or.v{lanes or self.width}i32", (llvm_type, words))
        return self.value(f"icmp ne i32 {combined}, 0")

    def when(self, condition: str, body: Callable[[], object]) -> None:
        """Run the instructions that `body` adds only if an i1 is true."""
        self._names += 1
        label = f"when{self._names}"
        self.do(f"br i1 {condition}, label %{label}, label %{label}_after")
        self.label(label)
        body()
        self.do(f"br label %{label}_after")
        self.label(f"{label}_after")

    def most_live(self) -> int:
        """Most values that are needed at the same time, in the order of the instructions.

        Those that do not fit into registers are on the stack.
        """
        needed: set[str] = set()  # later, or in the line itself
        most = 0
        for line in reversed(self.lines):
            names = VALUE.findall(line)
            needed.update(names)
            most = max(most, len(needed))
            if line.startswith("  %v"):
                needed.discard(names[0])
        return most

    def text(self, calls: str = "noinline") -> str:
        """LLVM IR of the finished function.

        Args:
            calls: LLVM's attribute that says what becomes of calls of it: `noinline` or `alwaysinline`.
        """
        lines = [f"define internal void @{self.name}({', '.join(self.parameters)}) {calls} #0 {{", "entry:"]
        return "\n".join([*lines, *self.memory, *self.lines, "  ret void", "}", ""])


def module(functions: Sequence[FunctionBuilder], *, exact: bool = False) -> str:
    """LLVM IR of functions and of @kernel, which calls the last function; that one must be named "inside".

    Args:
        exact: whether denormal numbers are numbers meanwhile, and not zeros.
    """
    inside = functions[-1]
    assert inside.name == "inside"
    processor = inside.target.processor
    parameters = ", ".join(parameter.replace(" noalias", "") for parameter in inside.parameters)
    called = sorted({text for function in functions for text in function.declarations.values()})
    frame = KERNEL.format(
        parameters=parameters,
        arguments=parameters,
        set_mode=processor.set_mode.format(mode=processor.exact if exact else processor.zeros),
        restore_mode=processor.restore_mode,
        declarations="\n".join([processor.declarations, *called]),
        attributes=processor.attributes.format(bits=32 * inside.width),
    )
    return "\n".join([*(function.text() for function in functions), frame])
