"""Translation of a graph to LLVM IR on vectors, in which each lane is one environment.

Words in memory are vectors of 32-bit words; a bool is 0 or 1. Values that enter or leave a loop are kept in memory, and
LLVM assigns all others to registers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Mapping, Sequence

from workers.simd.backend.function_builder import FunctionBuilder, module
from workers.simd.backend.target import Target
from workers.simd.graph.graph import Graph, UnsupportedError, refusing
from workers.simd.graph.operations import OPERATIONS
from workers.simd.graph.schedule import Region, schedule

MOST_SLOTS = 16384
"""Most vectors in the memory of a block, one MiB; this memory is on the stack."""
MOST_LIVE = 16384
"""Most values that may be needed at the same time, of which the stack holds what registers cannot: one MiB."""


def emit(graph: Graph, outputs: Sequence[int], inputs: int, target: Target) -> str:
    """LLVM IR of `void kernel(ptr in, ptr out, i64 blocks)` for a target.

    Both arrays are [block, word, lane]; a block has `inputs` input words and one output word for each of `outputs`.

    Raises:
        UnsupportedError: loops carry more values than fit on the stack.
    """
    block = graph_function("block", graph, outputs, [("in", inputs)], "out", target)
    inside = FunctionBuilder("inside", ["ptr noalias %in", "ptr noalias %out", "i64 %blocks"], target)

    def compute_block(number: str, _: list[str]) -> list[str]:
        block_in = inside.at("%in", inside.index((number, inputs)), inside.llvm_types["i"])
        block_out = inside.at("%out", inside.index((number, len(outputs))), inside.llvm_types["i"])
        inside.do(f"call void @block(ptr {block_in}, ptr {block_out})")
        return []

    inside.loop("%blocks", compute_block)
    return module([block, inside])


@refusing()
def graph_function(
    name: str,
    graph: Graph,
    outputs: Sequence[int],
    sources: Sequence[tuple[str, int]],
    out: str,
    target: Target,
    apart: Collection[str] = (),
    writes: type[Writer] | None = None,
) -> FunctionBuilder:
    """Function `void name(ptr ...)` that computes a graph from words in memory.

    Args:
        sources: (pointer, number of words read there), in the order of the graph's inputs. A pointer may occur twice.
        out: pointer to the words of `outputs`. If it is a source as well, they overwrite the words read there; all
            words are read before any is written.
        apart: pointers whose words are not neighbours but `%lanes` words apart, as in [word, lane]. If there are any,
            `i64 %lanes` is the function's last parameter.
        writes: class of the writer; `Writer` if None.

    Raises:
        UnsupportedError: more values are needed at the same time, or carried by loops, than fit on the stack.
    """
    pointers = list(dict.fromkeys([*(pointer for pointer, _ in sources), out]))
    parameters = [*(f"ptr noalias %{pointer}" for pointer in pointers), *["i64 %lanes"] * bool(apart)]
    builder = FunctionBuilder(name, parameters, target)
    input_addresses: list[tuple[str, int]] = []
    used = dict.fromkeys(pointers, 0)
    for pointer, words in sources:
        input_addresses += [(f"%{pointer}", used[pointer] + word) for word in range(words)]
        used[pointer] += words
    writer = (writes or Writer)(builder, graph, outputs, input_addresses, [f"%{pointer}" for pointer in apart])
    writer.compute_all()
    stored = [writer.in_memory(node) for node in outputs]

    def write() -> None:
        for word, (llvm_type, value) in enumerate(stored):
            builder.store(llvm_type, value, f"%{out}", writer.place(f"%{out}", word))

    writer.finish(write)
    if (live := builder.most_live()) > MOST_LIVE:
        raise UnsupportedError(f"{live:,} values are needed at the same time; simd supports at most {MOST_LIVE:,}")
    return builder


def inline(builder: FunctionBuilder, graph: Graph, outputs: Sequence[int], given: Mapping[int, str]) -> list[str]:
    """Add the instructions of a graph without loops to a function; returns the names of the outputs' values.

    `given` has the names of the inputs' values, by node.
    """
    writer = Writer(builder, graph, outputs, [])
    writer.values.update(given)
    writer.compute_all()
    return [writer.value(node) for node in outputs]


class Writer:
    """Writer of a graph's instructions, each on vectors."""

    part = 300
    """Operations of a basic block of longer straight code. LLVM chooses and schedules the instructions of a block in a
    time that grows faster than its length: an ant of MJX in parts compiles in half the time, and its code is as
    fast."""

    def __init__(
        self,
        builder: FunctionBuilder,
        graph: Graph,
        outputs: Sequence[int],
        input_addresses: Sequence[tuple[str, int]],
        apart: Collection[str] = (),
    ) -> None:
        self.builder, self.graph, self.apart = builder, graph, apart
        self.input_addresses = input_addresses
        """(pointer, word) of each input of the graph."""
        self.words = {dtype.upper(): llvm_type for dtype, llvm_type in builder.llvm_types.items()}
        self.words |= {"N": f"v{builder.width}f32", "M": f"v{builder.width}i32"}
        """Types and suffixes that replace {F}, {I}, {B}, {N} and {M} in the instructions of OPERATIONS."""
        self.schedule = schedule(graph, outputs)
        self.slots: dict[int, int] = {}
        """Slots in the memory of the block, by node: of carries and of values that loops read."""
        self.slot_count = 0
        self.memory = "%slots"
        self.values: dict[int, str] = {}
        """Names of values in the current block, by node; a loaded value is reused."""

    def compute_all(self) -> None:
        """Write all instructions, in order."""
        self.region(self.schedule.region)
        if self.slot_count > MOST_SLOTS:
            raise UnsupportedError(
                f"loops carry and read {self.slot_count:,} values; simd supports at most {MOST_SLOTS:,}"
            )
        if self.slot_count:
            self.builder.memory.append(f"  {self.memory} = alloca [{self.slot_count} x {self.words['I']}], align 64")

    def finish(self, write: Callable[[], object]) -> None:
        """Write what follows the computation; `write` writes its results to memory."""
        write()

    def region(self, region: Region) -> None:
        """Write straight code and the loops in it."""
        for number, step in enumerate(region.steps):
            if number % self.part == self.part - 1:
                self.builder.part()
            if isinstance(step, Region):
                self.loop(step)
            else:
                self.compute(step)
                if step in region.wanted_inside:
                    self.store(step, step)

    def loop(self, region: Region) -> None:
        """Write a loop; its carries are in slots from the first trip until after the loop."""
        loop, carried = region.loop, region.carried
        assert loop is not None
        for k in carried:
            self.store(loop.inits[k], loop.carries[k])
            self.slots[loop.results[k]] = self.slots[loop.carries[k]]
        before, builder = self.values, self.builder

        def trip(number: str, _: list[str]) -> list[str]:
            values = self.trip(region)
            for k, (llvm_type, value) in zip(carried, values, strict=True):
                builder.store(llvm_type, value, self.memory, self.slots[loop.carries[k]])
            return []

        if loop.active is None:
            builder.loop(loop.trips, trip)
        else:
            slot = self.slots[loop.carries[loop.active]]

            def some_active() -> str:
                return builder.any(builder.load(self.words["I"], self.memory, slot))

            def none_active() -> str:
                return builder.value(f"xor i1 {some_active()}, true")

            builder.when(some_active(), lambda: builder.loop(loop.trips, trip, until=none_active))
        self.values = before

    def trip(self, region: Region) -> list[tuple[str, str]]:
        """Write the body of a loop; returns (LLVM type, name) of what each carry becomes."""
        assert region.loop is not None
        self.values = {}
        self.region(region)
        return [self.in_memory(region.loop.outs[k]) for k in region.carried]

    def compute(self, node: int) -> None:
        """Write the instruction of an operation."""
        name, arguments = self.graph.keys[node][0], self.graph.arguments(node)
        if node in self.schedule.fused:
            name, values = "fma", self.fused_values(node)
        else:
            values = [self.value(a) for a in arguments]
        self.values[node] = self.operation(name, values)

    def fused_values(self, node: int) -> list[str]:
        """Names of the arguments of the fused operation that replaces a sum or difference."""
        name, product = self.graph.keys[node][0], self.schedule.fused[node]
        first, second = self.graph.arguments(node)
        factors = [self.value(a) for a in self.graph.arguments(product)]
        other = self.value(second if product == first else first)
        if name == "sub" and product == second:
            factors[0] = self.operation("neg", factors[:1])
        elif name == "sub":
            other = self.operation("neg", [other])
        return [*factors, other]

    def operation(self, name: str, values: Sequence[str]) -> str:
        """Write an operation on named values and return the name of its value."""
        operation, llvm_types = OPERATIONS[name], self.builder.llvm_types
        text = operation.llvm.format(*values, **self.words)
        if not text.startswith("llvm."):
            return self.builder.value(text)
        typed = [(llvm_types[dtype], value) for dtype, value in zip(operation.takes, values, strict=True)]
        return self.builder.call(llvm_types[operation.gives], text, *typed)

    def value(self, node: int) -> str:
        """Name of a node's value, which is loaded if it is in memory."""
        key = self.graph.keys[node]
        if key[0] == "const":
            return self.constant(key[1], key[2])
        if node not in self.values:
            pointer, word = self.input_addresses[key[2]] if key[0] == "input" else (self.memory, self.slots[node])
            self.values[node] = self.load(self.graph.dtypes[node], pointer, self.place(pointer, word))
        return self.values[node]

    def place(self, pointer: str, word: int) -> str | int:
        """Index of a word in the memory of a pointer."""
        return self.builder.index(("%lanes", word)) if pointer in self.apart else word

    def constant(self, dtype: str, bits: int) -> str:
        """LLVM constant with the same number in all lanes."""
        if dtype == "f":
            number = struct.unpack("<f", struct.pack("<i", bits))[0]
            return f"splat (float 0x{struct.pack('>d', number).hex().upper()})"
        return f"splat (i32 {bits})" if dtype == "i" else f"splat (i1 {str(bool(bits)).lower()})"

    def load(self, dtype: str, pointer: str, index: str | int) -> str:
        stored = self.builder.llvm_types["i" if dtype == "b" else dtype]
        loaded = self.builder.load(stored, pointer, index)
        return loaded if dtype != "b" else self.builder.value(f"icmp ne {stored} {loaded}, zeroinitializer")

    def in_memory(self, node: int) -> tuple[str, str]:
        """(LLVM type, name) of a node's value in the form in which it is stored."""
        dtype, value = self.graph.dtypes[node], self.value(node)
        if dtype != "b":
            return self.builder.llvm_types[dtype], value
        return self.words["I"], self.builder.value(f"zext {self.words['B']} {value} to {self.words['I']}")

    def store(self, node: int, home: int) -> None:
        """Store a node's value in the slot of the node `home`, which gets a new slot if it has none."""
        llvm_type, value = self.in_memory(node)
        if home not in self.slots:
            self.slots[home] = self.slot_count
            self.slot_count += 1
        self.builder.store(llvm_type, value, self.memory, self.slots[home])
