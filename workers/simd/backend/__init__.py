"""Translation of a graph to LLVM IR on vectors and to machine code, in this process, with a cache on disk.

This package needs llvmlite but not JAX; a graph built by hand can be compiled as well.
"""
