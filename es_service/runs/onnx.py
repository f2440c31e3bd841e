"""Policies of a run as ONNX models with a model card, for programs that know nothing of this service.

A model takes raw observations and gives actions, as evaluations do: normalisation, network and output are inside. A
policy with a memory also takes the memory before the step (zeros at the start of an episode) and gives that after it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from es_service.errors import ConfigError, WayOut, counted
from es_service.protocol.machine import VERSION
from es_service.runs.certified import Certified, measure_of, pairs_sentence
from es_service.runs.snapshot import Policy
from es_service.runs.view import Run
from es_service.store.reader import read_platforms

OPSET, IR_VERSION = 17, 8
"""Of ONNX 1.12 (2022), so that older runtimes load the models, too."""
OBSERVATION, ACTION = "observation", "action"
MEMORY, MEMORY_AFTER = "memory", "memory_after"


class _Graph:
    """Nodes and constants of a model, which are named as they come."""

    def __init__(self, onnx: Any) -> None:
        self.onnx, self.nodes, self.constants = onnx, [], []

    def constant(self, value: Any, dtype: Any = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def node(self, kind: str, *inputs: str, to: str = "", **attributes: Any) -> str:
        output = to or f"n{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def dense(self, x: str, layer: tuple[Any, Any]) -> str:
        weights, biases = layer
        x = self.node("MatMul", x, self.constant(weights))
        return x if biases is None else self.node("Add", x, self.constant(biases))

    def columns(self, x: str, start: int, end: int) -> str:
        return self.node("Slice", x, *(self.constant([value], np.int64) for value in (start, end, 1)))


def onnx_model(policy: Policy, about: dict[str, str] | None = None) -> Any:
    """An ONNX model of a policy: `observation` [N, O] float32 to `action` [N, A], for any number N of observations.

    With a memory, it also takes `memory` [N, H] and gives `memory_after` [N, H].

    Args:
        about: metadata of the model.

    Raises ConfigError if onnx is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        ways_out = [WayOut("install", "install it", extra="onnx")]
        raise ConfigError("models need onnx", field="to", value="onnx", ways_out=ways_out) from error
    g, spec = _Graph(onnx), policy.spec
    centred = g.node("Sub", OBSERVATION, g.constant(policy.observation_mean_O))
    x = g.node("Div", centred, g.constant(policy.observation_std_O))
    if (clip := policy.observation_clip) is not None:
        x = g.node("Clip", x, g.constant(-clip), g.constant(clip))
    layers = policy.layers
    hidden = len(spec.widths) - 2
    for layer in layers[:hidden]:
        x = g.node("Tanh" if spec.activation == "tanh" else "Relu", g.dense(x, layer))
    if spec.memory:
        x = _memory(g, layers[hidden:-1], spec.memory, x)
    x = g.dense(x, layers[-1])
    if spec.output == "tanh":
        g.node("Tanh", x, to=ACTION)
    elif spec.output in ("argmax", "categorical"):
        chosen = g.node("ArgMax", x, axis=-1, keepdims=0)  # the first of equal ones
        depth = g.constant([spec.widths[-1]], np.int64)
        g.node("OneHot", chosen, depth, g.constant([0.0, 1.0]), to=ACTION, axis=-1)
    elif spec.output == "gaussian":
        g.node("Tanh", g.columns(x, 0, spec.widths[-1]), to=ACTION)
    else:
        g.node("Identity", x, to=ACTION)
    inputs, outputs = {OBSERVATION: spec.widths[0]}, {ACTION: spec.widths[-1]}
    if spec.memory:
        inputs[MEMORY] = outputs[MEMORY_AFTER] = spec.memory
    declared = [
        [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["N", size]) for name, size in ports.items()]
        for ports in (inputs, outputs)
    ]
    graph = onnx.helper.make_graph(g.nodes, "policy", *declared, initializer=g.constants)
    opset = onnx.helper.make_opsetid("", OPSET)
    model = onnx.helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="es-service")
    model.producer_version = VERSION
    onnx.helper.set_model_props(model, about or {})
    onnx.checker.check_model(model, full_check=True)
    return model


def _memory(g: _Graph, layers: Sequence[tuple[Any, Any]], size: int, x: str) -> str:
    """The gated recurrent cell of `workers.policy`."""
    gates, candidate = layers
    both = g.node("Sigmoid", g.dense(g.node("Concat", x, MEMORY, axis=-1), gates))
    reset, keep = g.columns(both, 0, size), g.columns(both, size, 2 * size)
    kept = g.node("Mul", reset, MEMORY)
    new = g.node("Tanh", g.dense(g.node("Concat", x, kept, axis=-1), candidate))
    old_part = g.node("Mul", keep, MEMORY)
    new_part = g.node("Mul", g.node("Sub", g.constant(1.0), keep), new)
    return g.node("Add", old_part, new_part, to=MEMORY_AFTER)


def about(run: Run, certified: Certified | None) -> dict[str, str]:
    """What a model's metadata say of the run that it comes from."""
    constants = run.constants
    facts = {
        "task": str(constants["task.environment"]),
        "method": str(constants["search.algorithm"]),
        "seed": str(constants["seed"]),
        "run": run.run_id,
        "generation": str(run.generation),
    }
    if bounds := run.task.action_bounds:
        facts["action_low"], facts["action_high"] = (json.dumps(values) for values in zip(*bounds, strict=True))
    if certified is not None:
        row, measure = certified.row(), measure_of(constants["task.fitness"])
        facts["certified"] = "{} ({} to {}) in {} episodes".format(
            *(f"{row[f'{measure}_{end}']:.6g}" for end in ("mean", "low", "high")), row["episodes"]
        )
    return facts


def model_card(run: Run, files: Sequence[str], certified: Certified | None) -> str:
    """A page in Markdown about exported models: what they are, what they are worth, and how they are run."""
    constants, spec = run.constants, run.policy_spec
    measure = measure_of(constants["task.fitness"])
    normal = "with" if constants["policy.observation_normalization"] else "without"
    lines = [
        f"# {constants['search.algorithm']} on {constants['task.environment']}",
        "",
        f"Policies of a run of es-service {VERSION}, as ONNX models (opset {OPSET}).",
        "",
        "| what | value |",
        "| --- | --- |",
        f"| task | `{constants['task.environment']}`, at most {counted(constants['task.episode_steps'], 'step')} |",
        f"| method | `{constants['search.algorithm']}`, seed {constants['seed']}, generation {run.generation} |",
        f"| network | {spec.widths[0]} observations to {spec.widths[-1]} actions, {spec.parameters:,} parameters, "
        f"{normal} normalisation of observations (inside the model) |",
        *_actions(run),
        f"| run | `{run.run_id}` |",
        *(f"| {package} | {version} |" for package, version in sorted(_versions(run).items())),
        "",
        "## What they are worth",
        "",
    ]
    if certified is None:
        lines.append(
            "No policy of this run is certified. The values that a run stores for its best policies are selected, so "
            "they are too high on the average; certify a policy to know its value."
        )
    else:
        row = certified.row()
        mean, low, high = (row[f"{measure}_{end}"] for end in ("mean", "low", "high"))
        lines.append(
            f"`certified.onnx` has a mean {measure.replace('_', ' ')} of **{mean:.6g}** (95 % interval {low:.6g} to "
            f"{high:.6g}) in {row['episodes']} episodes that no choice has seen."
        )
        if row["successes"] is not None:
            lines.append(f"It succeeds in {row['successes']} of them.")
        if certified.elsewhere is not None:
            there, gap = (
                "{:.6g} (95 % interval {:.6g} to {:.6g})".format(
                    *(row[f"{prefix}_{measure}_{end}"] for end in ("mean", "low", "high"))
                )
                for prefix in ("elsewhere", "gap")
            )
            lines.append(
                f"In `{certified.elsewhere.title}`, it has {there} in {row['elsewhere_episodes']} episodes, a gap of "
                f"{gap} to the run's task, {pairs_sentence(paired=certified.elsewhere.paired)}."
            )
    memory = ""
    if spec.memory:
        memory = f"memory = np.zeros((1, {spec.memory}), np.float32)  # at the start of an episode\n"
    call = '["action"], {"observation": observation}'
    if spec.memory:
        call = '["action", "memory_after"], {"observation": observation, "memory": memory}'
    lines += [
        "",
        "## How they are run",
        "",
        f"Files: {', '.join(f'`{name}`' for name in files)}. Observations are raw; any number of them at once.",
        "",
        "```python",
        "import numpy as np",
        "import onnxruntime",
        "",
        f'session = onnxruntime.InferenceSession("{files[0]}")',
        f"observation = np.zeros((1, {spec.widths[0]}), np.float32)",
        f"{memory}action, *memory = session.run({call})",
        "```",
        "",
    ]
    return "\n".join(lines)


def _actions(run: Run) -> list[str]:
    """Row of what an action is to the environment, where it is not the model's as it is."""
    if bounds := run.task.action_bounds:
        ends = " and ".join(str([*values]) for values in zip(*bounds, strict=True))
        return [f"| actions | -1 and 1 stand for the environment's {ends}: `low + (action + 1) / 2 * (high - low)` |"]
    if run.task.discrete_actions:
        return ["| actions | 1 for the one that is chosen, 0 for the others: the environment's is `action.argmax()` |"]
    return []


def _versions(run: Run) -> dict[str, str]:
    """Package -> version with which the newest generation was computed; the processor besides."""
    platforms = read_platforms(run.folder)
    return {name: value for name, value in platforms[-1][1].items() if isinstance(value, str)} if platforms else {}
