"""A compiler from JAX functions of one environment to vector code for many: rollouts at the speed of the core.

    trace.py      jaxpr -> scalar graph    (primitives/, elementary.py, division.py; graph.py, folding.py, loops.py)
    schedule.py   which order, which loop, which products are fused with their sums
    emit.py       graph -> LLVM IR         (operations.py; code.py)
    target.py     LLVM IR -> machine code, in process
    kernel.py     all of it, with cache.py before; words.py

    noise.py      the generator, and weighted sums of it
    layout.py     where a policy's weights are
    network.py    the policy, whose members' weights are made where they are used
    episodes.py   whole episodes: these, and what the task does between, in one kernel
    rollout.py    what workers call

Each lane of a vector is one environment. Environments stay written once, in JAX; `xla` is what this is held against.
"""
