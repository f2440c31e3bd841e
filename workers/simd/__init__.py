"""A compiler from JAX functions of one environment to vector code for many: rollouts at the speed of the core.

    trace.py      jaxpr -> scalar graph    (primitives/, elementary.py; graph.py, folding.py, loops.py)
    schedule.py   which order, which loop, which products are fused with their sums
    emit.py       graph -> LLVM IR         (operations.py)
    target.py     LLVM IR -> machine code, in process
    kernel.py     all of it, with cache.py before

Each lane of a vector is one environment. Environments stay written once, in JAX; `xla` is what this is held against.
"""
