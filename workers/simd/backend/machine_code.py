"""LLVM's compiler and loader, called in this process, without a linker or libm."""

from __future__ import annotations

from functools import cache

import llvmlite
import llvmlite.binding as llvm

from workers.simd.backend.target import Target


@cache
def _initialize(*, native: bool) -> None:
    """Have LLVM's code generators ready: that of this machine, or all."""
    if native:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
    else:
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()


def code_generator(target: Target) -> llvm.TargetMachine:
    """Code generator of LLVM for a target."""
    _initialize(native=target.triple == llvm.get_default_triple())
    return llvm.Target.from_triple(target.triple).create_target_machine(
        cpu=target.cpu, features=target.features, opt=2, reloc="pic", codemodel="small", jit=True
    )


def compile_object(text: str, target: Target) -> bytes:
    """Compile LLVM IR to an object file. LLVM's optimiser is not run, because the graph is already simplified."""
    code = code_generator(target)
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = target.triple, str(code.target_data)
    module.verify()
    return code.emit_object(module)


def load_object(code: bytes, target: Target) -> tuple[int, object]:
    """Load an object file; returns (address of `kernel`, object that must stay alive as long as it is used)."""
    # MCJIT is not used: it may place code and constants too far apart for the addresses of the small code model.
    jit = llvm.create_lljit_compiler(code_generator(target), use_jit_link=True, suppress_errors=True)
    library = llvm.JITLibraryBuilder().add_object_img(code).export_symbol("kernel").link(jit, "kernels")
    return library["kernel"], (jit, library)


def compiler_version() -> str:
    """Versions of llvmlite and LLVM, on which machine code depends besides its IR and target."""
    return f"llvmlite {llvmlite.__version__}, LLVM {'.'.join(map(str, llvm.llvm_version_info))}"
