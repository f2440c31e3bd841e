"""The processor that kernels are compiled for, and how: LLVM in process, from wheels, without linker or libm."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import llvmlite
import llvmlite.binding as llvm

WIDTHS = {"avx512": 16, "avx2": 8, "four": 4}
"""Kind of code -> float32 lanes of its vectors. "four" is AVX2's code on half its vectors, for tests."""


class NoVectorsError(Exception):
    """The processor has not the vectors that code is wanted for."""


@dataclass(frozen=True)
class Target:
    """What code is made for."""

    isa: str
    """A key of WIDTHS."""
    cpu: str
    features: str
    """As LLVM writes them."""

    @property
    def width(self) -> int:
        """Lanes of a vector."""
        return WIDTHS[self.isa]

    def describe(self) -> str:
        """For people: `znver5, AVX-512, 16 lanes`."""
        names = {"avx512": "AVX-512", "avx2": "AVX2", "four": "AVX2 on half vectors"}
        return f"{self.cpu}, {names[self.isa]}, {self.width} lanes"


@cache
def _host() -> tuple[str, dict[str, bool]]:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.get_host_cpu_name(), dict(llvm.get_host_cpu_features())


def host_target(isa: str | None = None) -> Target:
    """The widest this machine has, or a narrower kind.

    Raises:
        NoVectorsError: the processor cannot run it; the message says what it lacks.
    """
    cpu, features = _host()
    lacks = [name for name in ("avx2", "fma") if not features.get(name)]
    if lacks:
        raise NoVectorsError(
            f"the processor ({cpu}) has no {' and no '.join(name.upper() for name in lacks)}, which simd needs"
        )
    has_512 = all(features.get(name) for name in ("avx512f", "avx512dq", "avx512vl", "avx512bw"))
    if isa is None:
        isa = "avx512" if has_512 else "avx2"
    if isa == "avx512" and not has_512:
        raise NoVectorsError(f"the processor ({cpu}) has no AVX-512")
    wanted = {name: on and (isa == "avx512" or not name.startswith("avx512")) for name, on in features.items()}
    return Target(isa, cpu, ",".join(f"{'+' if on else '-'}{name}" for name, on in sorted(wanted.items())))


def machine(target: Target) -> llvm.TargetMachine:
    """LLVM's code generator for a target."""
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=target.cpu, features=target.features, opt=2, reloc="pic", codemodel="small", jit=True
    )


def compile_object(text: str, target: Target) -> bytes:
    """Machine code, as an object file, of LLVM IR. No optimiser runs: the graph is one already."""
    _host()
    module = llvm.parse_assembly(text)
    code = machine(target)
    module.triple, module.data_layout = llvm.get_default_triple(), str(code.target_data)
    module.verify()
    return code.emit_object(module)


def load_object(code: bytes, target: Target) -> tuple[int, object]:
    """(address of `kernel`, what must stay alive as long as it is used)."""
    _host()
    # Not MCJIT: it may put code and constants too far from each other for the addresses in small code.
    jit = llvm.create_lljit_compiler(machine(target), use_jit_link=True, suppress_errors=True)
    library = llvm.JITLibraryBuilder().add_object_img(code).export_symbol("kernel").link(jit, "kernels")
    return library["kernel"], (jit, library)


def compiler_version() -> str:
    """What machine code depends on besides its text and target."""
    return f"llvmlite {llvmlite.__version__}, LLVM {'.'.join(map(str, llvm.llvm_version_info))}"
