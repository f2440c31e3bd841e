"""Text of LLVM functions on vectors: names, loops and conditions, for the emitter of graphs and for code by hand.

    void kernel(...)        what is called from outside: rounds to nearest, denormal numbers are zeros
    void anything(...)      what kernels call

Floating-point instructions carry no flags: nothing is reassociated, and fused only where it says so, so the bits of a
lane do not depend on the width of the vectors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

MXCSR = 0x9FC0
"""Round to nearest, no traps, denormal results and operands are zeros: as XLA computes, and five times faster."""
SCALAR_TYPES = {"f": "float", "i": "i32", "b": "i1"}

KERNEL = """\
define void @kernel({parameters}) #0 {{
entry:
  %before = alloca i32
  %during = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %before)
  store i32 {mxcsr}, ptr %during
  call void @llvm.x86.sse.ldmxcsr(ptr %during)
  call void @inside({arguments})
  call void @llvm.x86.sse.ldmxcsr(ptr %before)
  ret void
}}

declare void @llvm.x86.sse.stmxcsr(ptr)
declare void @llvm.x86.sse.ldmxcsr(ptr)
{declarations}

attributes #0 = {{ nounwind "prefer-vector-width"="512" "min-legal-vector-width"="{bits}" }}
"""

Values = list[str]


class FunctionBuilder:
    """The body of one function, written line by line. Values are names; each is given once."""

    def __init__(self, name: str, parameters: Sequence[str], width: int) -> None:
        """Begin `void @name(parameters)`, each "type %name", for vectors of `width` lanes."""
        self.name, self.parameters, self.width = name, list(parameters), width
        self.llvm_types = {dtype: f"<{width} x {scalar}>" for dtype, scalar in SCALAR_TYPES.items()}
        self.lines: list[str] = []
        self.memory: list[str] = []
        """Lines that reserve memory on the stack, which stand first."""
        self.declarations: set[str] = set()
        self._label = "entry"
        self._names = 0

    def do(self, instruction: str) -> None:
        """Add an instruction without a value."""
        self.lines.append(f"  {instruction}")

    def value(self, instruction: str) -> str:
        """Add an instruction; returns the name of its value."""
        self._names += 1
        self.lines.append(f"  %v{self._names} = {instruction}")
        return f"%v{self._names}"

    def call(self, llvm_type: str, intrinsic: str, *arguments: tuple[str, str]) -> str:
        """Value of an intrinsic, which is declared, of (type, value)s."""
        self.declarations.add(f"declare {llvm_type} @{intrinsic}({', '.join(type_ for type_, _ in arguments)})")
        return self.value(f"call {llvm_type} @{intrinsic}({', '.join(map(' '.join, arguments))})")

    def at(self, pointer: str, index: str | int, llvm_type: str) -> str:
        """A pointer `index` elements of a type further on."""
        return self.value(f"getelementptr {llvm_type}, ptr {pointer}, i64 {index}")

    def load(self, llvm_type: str, pointer: str, index: str | int = 0) -> str:
        """Element `index` of a type in memory; vectors of 32-bit words are aligned."""
        place = self.at(pointer, index, llvm_type)
        return self.value(f"load {llvm_type}, ptr {place}, align {self._alignment(llvm_type)}")

    def store(self, llvm_type: str, value: str, pointer: str, index: str | int = 0) -> None:
        """Put a value into element `index` of a type in memory."""
        place = self.at(pointer, index, llvm_type)
        self.do(f"store {llvm_type} {value}, ptr {place}, align {self._alignment(llvm_type)}")

    def _alignment(self, llvm_type: str) -> int:
        if llvm_type == self.llvm_types["f"] or llvm_type == self.llvm_types["i"]:
            return 4 * self.width
        return 1 if llvm_type.endswith("x i8>") else 4

    def index(self, *terms: tuple[str | int, int]) -> str:
        """Sum of (i64 value, factor)."""
        total = "0"
        for value, factor in terms:
            part = str(value) if factor == 1 else self.value(f"mul i64 {value}, {factor}")
            total = part if total == "0" else self.value(f"add i64 {total}, {part}")
        return total

    def splat(self, scalar: str, dtype: str = "f") -> str:
        """A scalar in all lanes."""
        vector = self.llvm_types[dtype]
        first = self.value(f"insertelement {vector} poison, {SCALAR_TYPES[dtype]} {scalar}, i64 0")
        return self.value(f"shufflevector {vector} {first}, {vector} poison, <{self.width} x i32> zeroinitializer")

    def fma(self, a: str, b: str, c: str) -> str:
        """a * b + c of float vectors, rounded once."""
        llvm_type = self.llvm_types["f"]
        return self.call(llvm_type, f"llvm.fma.v{self.width}f32", (llvm_type, a), (llvm_type, b), (llvm_type, c))

    def label(self, name: str) -> None:
        """Begin a block; the one before has ended with a branch."""
        self.lines.append(f"{name}:")
        self._label = name

    def loop(
        self,
        trips: str | int,
        body: Callable[[str, Values], Iterable[str]],
        carries: Sequence[tuple[str, str]] = (),
        until: Callable[[], str] | None = None,
    ) -> Values:
        """Repeat, at least once: body(number of the trip, carried values) -> what they are in the next trip, or in the
        end, which is returned.

        Args:
            carries: (type, first value).
            until: asked at the end of each trip; an i1 that ends the loop early.
        """
        self._names += 1
        label, before = f"loop{self._names}", self._label
        self.do(f"br label %{label}")
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
        self.do(f"%{label}_more = icmp slt i64 %{label}_next, {trips}")
        self.do(f"%{label}_again = select i1 {stop}, i1 false, i1 %{label}_more")
        self.do(f"br i1 %{label}_again, label %{label}, label %{label}_after")
        self.label(f"{label}_after")
        return outs

    def any(self, words: str, lanes: int | None = None) -> str:
        """Whether any word of an integer vector is not 0, an i1."""
        llvm_type = f"<{lanes or self.width} x i32>"
        found = self.call("i32", f"llvm.vector.reduce.or.v{lanes or self.width}i32", (llvm_type, words))
        return self.value(f"icmp ne i32 {found}, 0")

    def when(self, condition: str, body: Callable[[], object]) -> None:
        """Do something if an i1 is true."""
        self._names += 1
        label = f"when{self._names}"
        self.do(f"br i1 {condition}, label %{label}, label %{label}_after")
        self.label(label)
        body()
        self.do(f"br label %{label}_after")
        self.label(f"{label}_after")

    def text(self) -> str:
        """The finished function."""
        lines = [f"define internal void @{self.name}({', '.join(self.parameters)}) noinline #0 {{", "entry:"]
        return "\n".join([*lines, *self.memory, *self.lines, "  ret void", "}", ""])


def module(functions: Sequence[FunctionBuilder]) -> str:
    """LLVM IR of functions and of @kernel, which calls the last of them, named "inside"."""
    inside = functions[-1]
    assert inside.name == "inside"
    parameters = [parameter.replace(" noalias", "") for parameter in inside.parameters]
    frame = KERNEL.format(
        parameters=", ".join(parameters),
        arguments=", ".join(parameters),
        mxcsr=MXCSR,
        declarations="\n".join(sorted(set().union(*(function.declarations for function in functions)))),
        bits=32 * inside.width,
    )
    return "\n".join([*(function.text() for function in functions), frame])
