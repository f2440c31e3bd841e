"""A compiler from JAX functions of one environment to machine code that runs many environments in vector registers.

    frontend/    jaxpr -> scalar graph                 trace, tracer, primitives/
    graph/       the graph and its simplification      graph, folding, loops; elementary; schedule; operations
    backend/     graph -> LLVM IR -> machine code      emit, function_builder; target; native, cache; ptx
    episodes/    kernels and whole episodes            kernel; layout, network, noise, program; check; rollout

`episodes` imports from all other folders, `frontend` and `backend` from `graph`, and `graph` from none. Each lane of a
vector is one environment. Environments are written once, in JAX; tests compare this compiler with `xla`. The README
beside this file follows an environment step through all stages.
"""
