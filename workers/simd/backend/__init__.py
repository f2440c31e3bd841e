"""From a graph to machine code: LLVM IR on vectors, compiled in process; what was compiled before is kept on disk.

Needs llvmlite, and no JAX: a graph that was built by hand is compiled as well.
"""
