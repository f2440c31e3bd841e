"""The processor that kernels are compiled for, and LLVM's compiler, called in process without a linker or libm."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import llvmlite
import llvmlite.binding as llvm

WIDTHS = {"avx512": 16, "avx2": 8, "four": 4}
"""Float32 lanes of a vector, by instruction set (isa). "four" is AVX2 with half of each vector, for tests."""


class NoVectorsError(Exception):
    """The processor lacks vector instructions that the code needs."""


@dataclass(frozen=True)
class Target:
    """Processor and instruction set that code is compiled for."""

    isa: str
    """Instruction set, a key of WIDTHS."""
    cpu: str
    """LLVM's name of the processor."""
    features: str
    """The processor's features in LLVM's notation."""

    @property
    def width(self) -> int:
        """Number of float32 lanes of a vector."""
        return WIDTHS[self.isa]

    def describe(self) -> str:
        """Description for messages, such as `znver5, AVX-512, 16 lanes`."""
        names = {"avx512": "AVX-512", "avx2": "AVX2", "four": "AVX2 on half vectors"}
        return f"{self.cpu}, {names[self.isa]}, {self.width} lanes"


@cache
def _host() -> tuple[str, dict[str, bool]]:
    """LLVM's name of this processor and its features."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.get_host_cpu_name(), dict(llvm.get_host_cpu_features())


def host_target(isa: str | None = None) -> Target:
    """Target of this processor with a given instruction set; with its widest one if None.

    Raises:
        NoVectorsError: the processor cannot run such code; the message says what it lacks.
    """
    cpu, features = _host()
    lacks = [name for name in ("avx2", "fma") if not features.get(name)]
    if lacks:
        raise NoVectorsError(
            f"the processor ({cpu}) has no {' and no '.join(name.upper() for name in lacks)}; simd needs AVX2 and FMA"
        )
    has_512 = all(features.get(name) for name in ("avx512f", "avx512dq", "avx512vl", "avx512bw"))
    if isa is None:
        isa = "avx512" if has_512 else "avx2"
    if isa == "avx512" and not has_512:
        raise NoVectorsError(f"the processor ({cpu}) has no AVX-512, for which code was requested")
    wanted = {name: on and (isa == "avx512" or not name.startswith("avx512")) for name, on in features.items()}
    return Target(isa, cpu, ",".join(f"{'+' if on else '-'}{name}" for name, on in sorted(wanted.items())))


def machine(target: Target) -> llvm.TargetMachine:
    """Code generator of LLVM for a target."""
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=target.cpu, features=target.features, opt=2, reloc="pic", codemodel="small", jit=True
    )


def compile_object(text: str, target: Target) -> bytes:
    """Compile LLVM IR to an object file. LLVM's optimiser is not run, because the graph is already simplified."""
    _host()
    module = llvm.parse_assembly(text)
    code = machine(target)
    module.triple, module.data_layout = llvm.get_default_triple(), str(code.target_data)
    module.verify()
    return code.emit_object(module)


def load_object(code: bytes, target: Target) -> tuple[int, object]:
    """Load an object file; returns (address of `kernel`, object that must stay alive as long as it is used)."""
    _host()
    # MCJIT is not used: it may place code and constants too far apart for the addresses of the small code model.
    jit = llvm.create_lljit_compiler(machine(target), use_jit_link=True, suppress_errors=True)
    library = llvm.JITLibraryBuilder().add_object_img(code).export_symbol("kernel").link(jit, "kernels")
    return library["kernel"], (jit, library)


def compiler_version() -> str:
    """Versions of llvmlite and LLVM, on which machine code depends besides its IR and target."""
    return f"llvmlite {llvmlite.__version__}, LLVM {'.'.join(map(str, llvm.llvm_version_info))}"
