"""Compilation of LLVM IR to machine code in memory, and the words that kernels read and write.

LLVM's compiler and loader are called in this process, without a linker or libm; code that was compiled before comes
from the cache. Kernels take arrays [lane, ...] as words [block, word, lane].
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite
import llvmlite.binding as llvm
import numpy as np
from numpy.typing import NDArray

from workers.simd.backend import cache
from workers.simd.backend.target import Target

Words = NDArray[np.uint32]
"""Array [block, word, lane] of the bits of floats and integers; a bool is 0 or 1."""
ALIGNMENT = 64
"""Alignment of arrays of words, in bytes."""


def require(condition: bool, what: str) -> None:
    """Raise ValueError unless a condition of native code is met, which would otherwise use memory that is not its own.

    An assertion would not do, because `python -O` removes it.
    """
    if not condition:
        raise ValueError(f"native code must not be called with these arrays: {what}")


def words_of(aval: Any) -> int:
    """Number of words of one lane of an array."""
    return math.prod(aval.shape)


def aligned(shape: tuple[int, ...]) -> Words:
    """Uninitialised array of words with the alignment that vectors need."""
    size = 4 * math.prod(shape)
    memory = np.empty(size + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + size].view(np.uint32).reshape(shape)


def pack(leaves: Sequence[Any], width: int) -> Words:
    """Words of arrays [lane, ...], one array after the other; the last lane is repeated to fill up the last block."""
    lanes = len(leaves[0]) if leaves else 1
    blocks = -(-lanes // width)
    columns = []
    for leaf in leaves:
        array = np.asarray(leaf)
        require(len(array) == lanes, f"an array has {len(array)} lanes and another {lanes}")
        array = array.astype(np.uint32) if array.itemsize < 4 else np.ascontiguousarray(array).view(np.uint32)
        columns.append(array.reshape(lanes, math.prod(array.shape[1:])))
    rows = columns[0] if len(columns) == 1 else np.concatenate([np.zeros((lanes, 0), np.uint32), *columns], axis=1)
    words = aligned((blocks, rows.shape[1], width))
    words[:] = filled(rows, blocks * width).reshape(blocks, width, -1).transpose(0, 2, 1)
    return words


def filled(rows: NDArray, count: int) -> NDArray:
    """Array of `count` rows; missing rows repeat the last one."""
    return rows if len(rows) == count else rows[np.minimum(np.arange(count), len(rows) - 1)]


def unpack(words: Words, avals: Sequence[Any], lanes: int) -> list[NDArray]:
    """Arrays [lane, ...] of words, as copies; `avals` are the shapes and dtypes of one lane."""
    rows = words.transpose(0, 2, 1).copy().reshape(len(words) * words.shape[2], words.shape[1])[:lanes]
    arrays, end = [], 0
    for aval in avals:
        start, end = end, end + words_of(aval)
        column = rows[:, start:end]
        array = column.astype(aval.dtype) if aval.dtype.itemsize < 4 else column.view(aval.dtype)
        arrays.append(array.reshape(lanes, *aval.shape))
    return arrays


@functools.cache
def _initialize(*, native: bool) -> None:
    """Have LLVM's code generators ready: that of this machine, or all."""
    if native:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
    else:
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()


def code_generator(target: Target) -> llvm.TargetMachine:
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


OWN_VERSION = hashlib.sha256(
    b"".join(path.read_bytes() for path in sorted(Path(__file__).parents[1].rglob("*.py")))
).hexdigest()
"""Version of this compiler: a hash of all its source files at the time of import."""


class Native(NamedTuple):
    """Machine code of a kernel in memory."""

    address: int
    alive: object
    """Object that must stay alive as long as the code is used."""
    code_bytes: int
    cached: bool
    """Whether the code came from the cache."""

    def function(self, *arguments: Any) -> Callable[..., None]:
        """The function `kernel` for arguments of these ctypes, where arrays stand for pointers to their data; the code
        lives as long as it does."""
        kernel = ctypes.CFUNCTYPE(None, *arguments)(self.address)

        def call(*given: Any) -> None:
            assert self.alive
            kernel(*[argument.ctypes.data if isinstance(argument, np.ndarray) else argument for argument in given])

        return call


def load_compiled(
    name: str,
    text: Callable[[], str],
    target: Target,
    folder: Path | None = None,
    check: Callable[[Native], object] = lambda native: None,
) -> Native:
    """Compile LLVM IR, or load the machine code from the cache.

    Args:
        name: complete description of what the code computes; code with the same name is not compiled again.
        text: function that gives the IR; called only if the code is not in the cache.
        target: processor and instruction set.
        folder: folder of the cache; the user's cache if None.
        check: function that raises an exception if new code is wrong; such code is not kept.
    """
    folder = folder or cache.cache_folder()
    if folder and not cache.trusted(folder):
        folder = None
    versions = f"{target} {compiler_version()} {OWN_VERSION}"
    key = hashlib.sha256(f"{name} {versions}".encode()).hexdigest()
    kept = cache.load(folder, key) if folder else None
    code = kept if kept is not None else compile_object(text(), target)
    native = Native(*load_object(code, target), len(code), kept is not None)
    if kept is None:
        check(native)
        if folder:
            cache.save(folder, key, code)
    return native


class WrongCodeError(Exception):
    """Machine code does not compute what it should; the message says what to do."""


def require_same(found: np.ndarray, wanted: np.ndarray, what: str, where: str = "this processor") -> None:
    """Raise WrongCodeError unless two arrays have the same bits; all NaN count as the same.

    Args:
        what: what the arrays are, for the message.
        where: what the code is for.
    """
    whole = (x.astype(np.uint32) if x.dtype.itemsize < 4 else x for x in (found, wanted))
    found, wanted = (np.ascontiguousarray(x).view(np.uint32) for x in whole)
    nan = np.isnan(found.view(np.float32)) & np.isnan(wanted.view(np.float32))
    differing = np.count_nonzero((found != wanted) & ~nan)
    if differing:
        raise WrongCodeError(
            f"simd's machine code for {where} is wrong: {differing:,} of {found.size:,} words of {what} differ "
            "from their definition. Please report this with the output of es-service doctor; until it is mended, set "
            "compute.rollout to xla"
        )
