"""The processors that kernels are compiled for, and all that code for one of them has of its own.

PROCESSORS   by architecture: how code treats denormal numbers as zeros, and attributes of its functions
ISAS         by instruction set: vectors, registers, and the features without which its code does not run
Target       one processor with one instruction set; what the rest of this package asks about either
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import llvmlite.binding as llvm


class Processor(NamedTuple):
    """An architecture. LLVM IR that is not the same for all processors is written here."""

    triple: str
    """LLVM's triple of code that this machine need not run; that of this machine's own code is LLVM's default."""
    declarations: str
    set_mode: str
    """Lines of IR that keep the floating-point control register and then set it to {mode}."""
    restore_mode: str
    zeros: int
    """Mode of kernels: rounds to nearest, has no traps, and denormal results and operands count as zeros. XLA computes
    in the same mode, and denormal numbers would make a kernel five times slower on x86-64."""
    exact: int
    """The same without treating denormal numbers as zeros, as NumPy computes."""
    attributes: str
    """Attributes of every function, with {bits} for those of a vector of the code."""


PROCESSORS = {
    "x86_64": Processor(
        triple="x86_64-unknown-linux-gnu",
        declarations="declare void @llvm.x86.sse.stmxcsr(ptr)\ndeclare void @llvm.x86.sse.ldmxcsr(ptr)",
        set_mode="""\
  %before = alloca i32
  %during = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %before)
  store i32 {mode}, ptr %during
  call void @llvm.x86.sse.ldmxcsr(ptr %during)""",
        restore_mode="  call void @llvm.x86.sse.ldmxcsr(ptr %before)",
        zeros=0x9FC0,  # MXCSR.FZ and DAZ, all exceptions masked
        exact=0x1F80,
        attributes='nounwind "prefer-vector-width"="512" "min-legal-vector-width"="{bits}"',
    ),
    "aarch64": Processor(
        triple="aarch64-unknown-linux-gnu",
        declarations="declare i64 @llvm.aarch64.get.fpcr()\ndeclare void @llvm.aarch64.set.fpcr(i64)",
        set_mode="""\
  %before = call i64 @llvm.aarch64.get.fpcr()
  call void @llvm.aarch64.set.fpcr(i64 {mode})""",
        restore_mode="  call void @llvm.aarch64.set.fpcr(i64 %before)",
        zeros=0x1000000,  # FPCR.FZ, for operands too
        exact=0,
        attributes="nounwind",
    ),
    # A GPU, by the code of ptx.py. It has no mode: each instruction says itself that denormal numbers are zeros.
    "nvptx64": Processor(
        triple="nvptx64-nvidia-cuda",
        declarations="",
        set_mode="",
        restore_mode="",
        zeros=0,
        exact=0,
        attributes='nounwind "denormal-fp-math-f32"="preserve-sign,preserve-sign"',
    ),
}
ARCHITECTURES = {"x86_64": "x86_64", "amd64": "x86_64", "aarch64": "aarch64", "arm64": "aarch64"}
"""Architecture of code by the first part of LLVM's triple of a machine."""


class Isa(NamedTuple):
    """An instruction set, and the vectors of code for it."""

    title: str
    architecture: str
    width: int
    """Float32 lanes of a vector of the code."""
    register_bits: int
    registers: int
    """Vector registers that the instruction set has."""
    cpu: str
    """LLVM's name for any processor that has it."""
    needs: tuple[str, ...]
    """LLVM's names of the features without which its code does not run."""
    hides: tuple[str, ...] = ()
    """Features whose names begin with one of these are not used."""


# fmt: off
ISAS = {
    "avx512": Isa("AVX-512", "x86_64", 16, 512, 32, "x86-64-v4",
                  ("avx2", "fma", "avx512f", "avx512dq", "avx512vl", "avx512bw")),
    "avx2": Isa("AVX2", "x86_64", 8, 256, 16, "x86-64-v3", ("avx2", "fma"), ("avx512",)),
    "four": Isa("AVX2 on half vectors", "x86_64", 4, 256, 16, "x86-64-v3", ("avx2", "fma"), ("avx512",)),
    # Every 64-bit Arm processor that runs Linux or macOS has NEON, with fused multiply-adds.
    "neon": Isa("NEON", "aarch64", 4, 128, 32, "generic", ()),
    "neon8": Isa("NEON on two registers", "aarch64", 8, 128, 32, "generic", ()),
    "neon16": Isa("NEON on four registers", "aarch64", 16, 128, 32, "generic", ()),
    # A lane is a thread, whose registers have 32 bits; sm_90 are the H100 and H200.
    "ptx": Isa("PTX", "nvptx64", 1, 32, 255, "sm_90", ()),
}
# fmt: on
"""Instruction sets by name. The first one of its architecture that a processor has is used; tests use the others."""


class NoVectorsError(Exception):
    """The processor lacks vector instructions that the code needs."""


@dataclass(frozen=True)
class Target:
    """Processor and instruction set that code is compiled for."""

    isa: str
    """Instruction set, a key of ISAS."""
    triple: str
    """LLVM's name of the architecture, operating system and object format."""
    cpu: str
    """LLVM's name of the processor."""
    features: str
    """The processor's features in LLVM's notation."""

    @property
    def width(self) -> int:
        """Number of float32 lanes of a vector."""
        return ISAS[self.isa].width

    @property
    def processor(self) -> Processor:
        return PROCESSORS[ISAS[self.isa].architecture]

    @property
    def sums_at_once(self) -> int:
        """Number of vectors of sums that are kept in half of the registers; the others are for their operands."""
        isa = ISAS[self.isa]
        return isa.registers // 2 // max(1, 32 * isa.width // isa.register_bits)

    def describe(self) -> str:
        """Description for messages, such as `znver5, AVX-512, 16 lanes`."""
        return f"{self.cpu}, {ISAS[self.isa].title}, {self.width} lanes"


@cache
def _host() -> tuple[str, str, dict[str, bool]]:
    """LLVM's triple of this machine, its name of the processor, and the processor's features."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.get_default_triple(), llvm.get_host_cpu_name(), dict(llvm.get_host_cpu_features())


def host_target(isa: str | None = None) -> Target:
    """Target of this processor with a given instruction set; with the first one that it has if None.

    Raises:
        NoVectorsError: the processor cannot run such code; the message says what it lacks.
    """
    triple, cpu, features = _host()
    machine = triple.partition("-")[0]
    of_machine = {
        name: instruction_set
        for name, instruction_set in ISAS.items()
        if instruction_set.architecture == ARCHITECTURES.get(machine)
    }
    if not of_machine:
        known = ", ".join(dict.fromkeys(ARCHITECTURES.values()))
        raise NoVectorsError(f"simd has no code for the architecture {machine}, only for {known}")
    if isa is not None and isa not in of_machine:
        raise NoVectorsError(f"{ISAS[isa].title} was requested, which {machine} does not have")
    lacks: list[str] = []
    for name in [isa] if isa else of_machine:
        lacks = [feature for feature in ISAS[name].needs if not features.get(feature)]
        if not lacks:
            wanted = {feature: on and not feature.startswith(ISAS[name].hides) for feature, on in features.items()}
            return Target(
                name, triple, cpu, ",".join(f"{'+' if on else '-'}{feature}" for feature, on in sorted(wanted.items()))
            )
    if isa:
        raise NoVectorsError(
            f"the processor ({cpu}) has no {ISAS[isa].title}, for which code was requested; it lacks {', '.join(lacks)}"
        )
    needs = " and ".join(name.upper() for name in ISAS[list(of_machine)[-1]].needs)
    raise NoVectorsError(
        f"the processor ({cpu}) has no {' and no '.join(name.upper() for name in lacks)}; simd needs {needs}"
    )


def target_of(isa: str) -> Target:
    """Target of any processor with an instruction set, for code that this machine need not be able to run."""
    instruction_set = ISAS[isa]
    features = ",".join(f"+{name}" for name in instruction_set.needs)
    return Target(isa, PROCESSORS[instruction_set.architecture].triple, instruction_set.cpu, features)
