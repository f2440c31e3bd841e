"""Third stage: a graph becomes LLVM IR, text for text, on vectors of which each lane is one environment.

    void kernel(ptr in, ptr out, i64 blocks)

Both arrays are [block, word, lane] of 32-bit words, truth as 0 or 1. A block of lanes goes through the whole graph.
What crosses the edge of a loop lives in memory; the rest is LLVM's to keep in registers. Floating-point instructions
carry no flags: nothing is reassociated, and fused only what `schedule.py` says, so the bits of a lane do not depend on
the width of the vectors.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from workers.simd.graph import Graph
from workers.simd.operations import OPERATIONS
from workers.simd.primitives.registry import UnsupportedError
from workers.simd.schedule import Region, schedule

MXCSR = 0x9FC0
"""Round to nearest, no traps, denormal results and operands are zeros: as XLA computes, and five times faster."""
MOST_SLOTS = 8192
"""Vectors in the memory of a block, which is on the stack: half a MiB."""
SCALARS = {"f": "float", "i": "i32", "b": "i1"}

FRAME = """\
define internal void @block(ptr noalias %in, ptr noalias %out) noinline #0 {{
entry:
  %slots = alloca [{slots} x <{width} x i32>], align 64
{body}
  ret void
}}

define void @kernel(ptr %in, ptr %out, i64 %blocks) #0 {{
entry:
  %before = alloca i32
  %during = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %before)
  store i32 {mxcsr}, ptr %during
  call void @llvm.x86.sse.ldmxcsr(ptr %during)
  br label %test
test:
  %block = phi i64 [ 0, %entry ], [ %next, %again ]
  %more = icmp slt i64 %block, %blocks
  br i1 %more, label %again, label %done
again:
  %in_offset = mul i64 %block, {in_bytes}
  %out_offset = mul i64 %block, {out_bytes}
  %block_in = getelementptr i8, ptr %in, i64 %in_offset
  %block_out = getelementptr i8, ptr %out, i64 %out_offset
  call void @block(ptr %block_in, ptr %block_out)
  %next = add i64 %block, 1
  br label %test
done:
  call void @llvm.x86.sse.ldmxcsr(ptr %before)
  ret void
}}

declare void @llvm.x86.sse.stmxcsr(ptr)
declare void @llvm.x86.sse.ldmxcsr(ptr)
{declarations}

attributes #0 = {{ nounwind "prefer-vector-width"="512" "min-legal-vector-width"="{bits}" }}
"""


def emit(graph: Graph, outputs: Sequence[int], inputs: int, width: int) -> str:
    """LLVM IR of a kernel with one output word for each of `outputs`, and `inputs` words in, for vectors of `width`.

    Raises:
        UnsupportedError: loops carry more than fits on a stack.
    """
    writer = _Writer(graph, outputs, width)
    body = writer.block(outputs)
    if writer.slot_count > MOST_SLOTS:
        raise UnsupportedError(f"{writer.slot_count:,} values that loops carry and look at")
    return FRAME.format(
        body="\n".join(body),
        slots=max(1, writer.slot_count),
        width=width,
        mxcsr=MXCSR,
        in_bytes=4 * width * inputs,
        out_bytes=4 * width * len(outputs),
        declarations="\n".join(sorted(writer.declarations)),
        bits=32 * width,
    )


class _Writer:
    """Writes the instructions of one block of lanes."""

    def __init__(self, graph: Graph, outputs: Sequence[int], width: int) -> None:
        self.graph, self.width = graph, width
        self.vector = {kind: f"<{width} x {scalar}>" for kind, scalar in SCALARS.items()}
        self.words = {
            **{"F": self.vector["f"], "I": self.vector["i"], "B": self.vector["b"]},
            **{"N": f"v{width}f32", "M": f"v{width}i32"},
        }
        self.schedule = schedule(graph, outputs)
        self.absorbed = set(self.schedule.fused.values())
        self.lines: list[str] = []
        self.declarations: set[str] = set()
        self.slots: dict[int, int] = {}
        """Node -> its place in the memory of the block: carries, and what loops look at."""
        self.slot_count = 0
        self.values: dict[int, str] = {}
        """Node -> its name in the present block; what is loaded once stays known."""
        self.names = 0

    def block(self, outputs: Sequence[int]) -> list[str]:
        """All instructions, in order."""
        self.region(self.schedule.region)
        for word, node in enumerate(outputs):
            self.store(node, f"%out, i64 {word}")
        return self.lines

    def region(self, region: Region) -> None:
        """Straight code, and the loops in it."""
        for step in region.steps:
            if isinstance(step, Region):
                self.loop(step)
            elif step not in self.absorbed:
                self.compute(step)
                if step in region.wanted_inside:
                    self.store(step, self.slot(step))

    def loop(self, region: Region) -> None:
        """A loop of some trips; its carries lie in slots, from the first trip to what comes after."""
        loop, carried = region.loop, region.carried
        assert loop is not None
        for k in carried:
            self.store(loop.inits[k], self.slot(loop.carries[k]))
            self.slots[loop.results[k]] = self.slots[loop.carries[k]]
        label, before = f"loop{loop.number}", self.values
        self.values = {}
        self.lines += [f"  br label %{label}_start", f"{label}_start:", f"  br label %{label}", f"{label}:"]
        self.lines.append(f"  %{label}_trip = phi i64 [ 0, %{label}_start ], [ %{label}_next, %{label}_end ]")
        self.region(region)
        values = [(loop.carries[k], self.in_memory(loop.outs[k])) for k in carried]
        for carry, (kind, value) in values:
            self.lines.append(f"  store {kind} {value}, ptr {self.address(self.slot(carry))}, align {4 * self.width}")
        self.lines += [
            f"  br label %{label}_end",
            f"{label}_end:",
            f"  %{label}_next = add i64 %{label}_trip, 1",
            f"  %{label}_more = icmp slt i64 %{label}_next, {loop.trips}",
            f"  br i1 %{label}_more, label %{label}, label %{label}_after",
            f"{label}_after:",
        ]
        self.values = before

    def compute(self, node: int) -> None:
        """Write the instruction of an operation."""
        name, arguments = self.graph.keys[node][0], self.graph.arguments(node)
        if node in self.schedule.fused:
            name, values = "fma", self.fused_values(node)
        else:
            values = [self.value(a) for a in arguments]
        self.values[node] = self.write(self.form(name, values))

    def fused_values(self, node: int) -> list[str]:
        """Arguments of the fused operation that a sum or difference becomes."""
        name, product = self.graph.keys[node][0], self.schedule.fused[node]
        first, second = self.graph.arguments(node)
        factors = [self.value(a) for a in self.graph.arguments(product)]
        other = self.value(second if product == first else first)
        if name == "sub" and product == second:
            factors[0] = self.write(self.form("neg", factors[:1]))
        elif name == "sub":
            other = self.write(self.form("neg", [other]))
        return [*factors, other]

    def form(self, name: str, values: Sequence[str]) -> str:
        """The text of an operation; what it calls is declared."""
        text = OPERATIONS[name].llvm.format(*values, **self.words)
        if text.startswith("call"):
            intrinsic = text[text.index("@") : text.index("(")]
            kinds = ", ".join(self.vector[kind] for kind in OPERATIONS[name].takes)
            self.declarations.add(f"declare {self.vector[OPERATIONS[name].gives]} {intrinsic}({kinds})")
        return text

    def write(self, instruction: str) -> str:
        """Add an instruction; returns the name of its value."""
        self.names += 1
        self.lines.append(f"  %v{self.names} = {instruction}")
        return f"%v{self.names}"

    def value(self, node: int) -> str:
        """Name of a node's value, which is loaded where it lies in memory."""
        key = self.graph.keys[node]
        if key[0] == "const":
            return self.constant(key[1], key[2])
        if node not in self.values:
            home = f"%in, i64 {key[2]}" if key[0] == "input" else f"%slots, i64 {self.slots[node]}"
            self.values[node] = self.load(self.graph.kinds[node], home)
        return self.values[node]

    def constant(self, kind: str, bits: int) -> str:
        """The same number in all lanes."""
        if kind == "f":
            number = struct.unpack("<f", struct.pack("<i", bits))[0]
            return f"splat (float 0x{struct.pack('>d', number).hex().upper()})"
        return f"splat (i32 {bits})" if kind == "i" else f"splat (i1 {str(bool(bits)).lower()})"

    def load(self, kind: str, home: str) -> str:
        """Name of what lies in a place."""
        stored = self.vector["i" if kind == "b" else kind]
        loaded = self.write(f"load {stored}, ptr {self.address(home)}, align {4 * self.width}")
        return loaded if kind != "b" else self.write(f"icmp ne {stored} {loaded}, zeroinitializer")

    def in_memory(self, node: int) -> tuple[str, str]:
        """(type, name) of a node's value as it is stored."""
        kind, value = self.graph.kinds[node], self.value(node)
        if kind != "b":
            return self.vector[kind], value
        return self.vector["i"], self.write(f"zext {self.vector['b']} {value} to {self.vector['i']}")

    def store(self, node: int, home: str) -> None:
        """Put a node's value into a place."""
        kind, value = self.in_memory(node)
        self.lines.append(f"  store {kind} {value}, ptr {self.address(home)}, align {4 * self.width}")

    def address(self, home: str) -> str:
        """A pointer to a place (base, number of a vector)."""
        return self.write(f"getelementptr {self.vector['i']}, ptr {home}")

    def slot(self, node: int) -> str:
        """The place of a node in the memory of the block; a new one if it has none."""
        if node not in self.slots:
            self.slots[node] = self.slot_count
            self.slot_count += 1
        return f"%slots, i64 {self.slots[node]}"
