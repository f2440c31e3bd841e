"""A compiler from JAX functions of one environment to vector code for many: rollouts at the speed of the core.

    frontend/    jaxpr -> scalar graph                 trace, tracer, primitives/, dtypes, digest
    graph/       the graph, and what simplifies it     graph, folding, loops; elementary, division; schedule; operations
    backend/     graph -> LLVM IR -> machine code      emit, function_builder; target; native, cache; words
    episodes/    what is compiled with them            kernel; layout, network, noise, program; rollout

A folder imports from those it needs below it: episodes from all, frontend and backend from graph, graph from none. Each
lane of a vector is one environment. Environments stay written once, in JAX; `xla` is what this is held against. The
README beside this file follows a step through all stages.
"""
